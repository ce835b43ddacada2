"""Lagrange's equations from energies in any coordinates (Olguin Diaz, 7; Cai, 4).

    d/dt dT/dq' - dT/dq + dV/dq + dD/dq' = Q

T(q, q') is the kinetic energy, V(q) the potential, D(q, q') the dissipation function and Q (n,) the
generalized forces. Derivatives are computed with JAX. If T = q' . M(q) q' / 2 this is

    M(q) q'' + C(q, q') q' + g(q) + dD/dq' = Q

with C from Christoffel symbols, so that M' - 2C is skew-symmetric. `acceleration` accepts any T,
also with terms of order one (gyroscopic) or zero in q'.

    >>> cart = System(lambda q, v: v @ v, lambda q: 8 * q @ q)
    >>> acceleration(cart, jnp.array([1.0]), jnp.array([0.0])).tolist()
    [-8.0]
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp

from rbjax.body.body import coordinate_vector
from rbjax.errors import InputError
from rbjax.rotations.arguments import checked

Energy = Callable[..., jax.Array]


def _nothing(*_: Any) -> Any:
    return 0.0


class System(NamedTuple):
    """The functions T(q, v), V(q) and D(q, v) of a system, which return scalars."""

    kinetic: Energy
    potential: Energy = _nothing
    dissipation: Energy = _nothing


def mass_matrix(system: System, q: jax.Array, v: jax.Array | None = None) -> jax.Array:
    """Compute the mass matrix (n, n) d^2 T / dq'^2, by default at q' = 0.

    >>> mass_matrix(System(lambda q, v: (1 + q[0] ** 2) * v @ v), jnp.array([2.0])).tolist()
    [[10.0]]
    """
    q = _position("mass_matrix", system, q)
    v = jnp.zeros_like(q) if v is None else _like("mass_matrix", "v", v, q)
    return jax.hessian(system.kinetic, 1)(q, v)


def christoffel_symbols(system: System, q: jax.Array) -> jax.Array:
    """Compute the Christoffel symbols (n, n, n) of the first kind.

    Gamma_ijk = (dM_ij/dq_k + dM_ik/dq_j - dM_jk/dq_i) / 2
    """
    q = _position("christoffel_symbols", system, q)
    dM = jax.jacfwd(lambda q: mass_matrix(system, q))(q)
    return (dM + dM.transpose(0, 2, 1) - dM.transpose(2, 0, 1)) / 2


def coriolis_matrix(system: System, q: jax.Array, v: jax.Array) -> jax.Array:
    """Compute the Coriolis matrix C = Gamma . q' (n, n), with M' - 2C skew-symmetric.

    >>> M = System(lambda q, v: (1 + q[0] ** 2) * v @ v)
    >>> coriolis_matrix(M, jnp.array([2.0]), jnp.array([3.0])).tolist()
    [[12.0]]
    """
    q, v = _state("coriolis_matrix", system, q, v)
    return (christoffel_symbols(system, q) * v).sum(-1)


def gravity_forces(system: System, q: jax.Array) -> jax.Array:
    """Compute the gravity forces dV/dq (n,)."""
    q = _position("gravity_forces", system, q)
    return jax.grad(_scalar(system.potential))(q)


def damping_forces(system: System, q: jax.Array, v: jax.Array) -> jax.Array:
    """Compute the damping forces dD/dq' (n,)."""
    q, v = _state("damping_forces", system, q, v)
    return jax.grad(_scalar(system.dissipation), 1)(q, v)


def bias_forces(system: System, q: jax.Array, v: jax.Array) -> jax.Array:
    """Compute the forces at q'' = 0: (dp/dq) q' - dT/dq + dV/dq + dD/dq', with p = dT/dq'."""
    q, v = _state("bias_forces", system, q, v)
    T = _scalar(system.kinetic)
    _, swept = jax.jvp(lambda q: jax.grad(T, 1)(q, v), (q,), (v,))
    bias = swept - jax.grad(T)(q, v)
    return bias + gravity_forces(system, q) + damping_forces(system, q, v)


def acceleration(
    system: System, q: jax.Array, v: jax.Array, Q: jax.Array | float = 0.0
) -> jax.Array:
    """Compute the acceleration q'' (n,) under generalized forces Q (n,)."""
    q, v = _state("acceleration", system, q, v)
    if not isinstance(Q, (int, float)):
        Q = checked("acceleration", "Q", Q, "scalar")
        Q = _like("acceleration", "Q", Q, q) if Q.ndim else Q
    return jnp.linalg.solve(mass_matrix(system, q, v), Q - bias_forces(system, q, v))


def generalized_forces(system: System, q: jax.Array, v: jax.Array, a: jax.Array) -> jax.Array:
    """Compute the generalized forces Q (n,) for the acceleration a (n,): inverse dynamics."""
    q, v = _state("generalized_forces", system, q, v)
    a = _like("generalized_forces", "a", a, q)
    return (mass_matrix(system, q, v) * a).sum(-1) + bias_forces(system, q, v)


def energy(system: System, q: jax.Array, v: jax.Array) -> jax.Array:
    """Compute the energy dT/dq' . q' - T + V, which is constant if Q and D are zero."""
    q, v = _state("energy", system, q, v)
    T = _scalar(system.kinetic)
    return jax.grad(T, 1)(q, v) @ v - T(q, v) + _scalar(system.potential)(q)


def term(system: System) -> diffrax.ODETerm:
    """Return the term for diffrax with y = (q, v), and args = Q: (n,), f(t, q, v), or None."""

    def rate(t: Any, y: tuple[jax.Array, jax.Array], args: Any) -> tuple[jax.Array, jax.Array]:
        q, v = y
        Q = args(t, q, v) if callable(args) else (0.0 if args is None else args)
        return v, acceleration(system, q, v, Q)

    return diffrax.ODETerm(rate)


def _scalar(energy: Energy) -> Energy:
    """Convert the result of an energy to an array of shape () with the dtype of q."""

    def value(q: jax.Array, *v: jax.Array) -> jax.Array:
        x = jnp.asarray(energy(q, *v), q.dtype)
        if x.shape != ():
            raise InputError(f"an energy has shape {x.shape}, expected a scalar ()")
        return x

    return value


def _position(where: str, system: Any, q: Any) -> jax.Array:
    if not isinstance(system, System) or not all(callable(f) for f in system):
        raise InputError(
            f"{where}: system is {type(system).__name__}, expected lagrange.System(kinetic, "
            "potential, dissipation) of functions"
        )
    return coordinate_vector(where, "q", q)


def _state(where: str, system: Any, q: Any, v: Any) -> tuple[jax.Array, jax.Array]:
    q = _position(where, system, q)
    return q, _like(where, "v", v, q)


def _like(where: str, name: str, value: Any, q: jax.Array) -> jax.Array:
    """Check that an argument is an array with the shape of q."""
    x = coordinate_vector(where, name, value)
    if x.shape != q.shape:
        raise InputError(f"{where}: {name} has shape {x.shape}, expected the shape of q, {q.shape}")
    return x
