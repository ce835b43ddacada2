"""One rigid body by Lagrange's equations in a minimal attitude, and in quasi-velocities.

`Lagrange`: q = (p, x) with three attitude parameters x, and kinetic energy T(q, q') of the twist

    V = A(q) q' = (E_b(x) x', R(x)^T p')

M, C and g are computed by differentiation (`lagrange`). If E_b is singular, M is singular.

`QuasiLagrange`: the velocities are nu = A(q) q', which is the body twist, with q' = B(q) nu.
Boltzmann's and Hamel's equations (Olguin Diaz, 7.2; Hamel, 1904)

    d/dt dT/dnu + B^T (A'^T - (d(A q')/dq)^T) dT/dnu - B^T dT/dq = B^T Q

hold for redundant attitudes too, because B^T removes their constraint forces. They are never
singular with a quaternion.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.body import lagrange
from rbjax.body.body import (
    Body,
    Situation,
    kinetic_energy,
    potential_energy,
    split,
    total_wrench,
)
from rbjax.body.formulation_types import BodyState, Formulation
from rbjax.errors import InputError
from rbjax.lanes import matvec
from rbjax.rotations import se3

#: the distance (rad) from a singularity below which the equations have no correct digits
SINGULAR = 1e-8


class _InCoordinates(Formulation):
    """A formulation in coordinates q = (p, x), with the attitude x in any representation."""

    def pose(self, body: Body, y: BodyState) -> jax.Array:
        return self._pose(y.q)

    def _pose(self, q: jax.Array) -> jax.Array:
        return se3.pose(self.attitude.to_matrix(q[3:]), q[:3])

    def _coordinates(self, T: jax.Array) -> jax.Array:
        return jnp.concatenate([T[:3, 3], self.attitude.from_matrix(T[:3, :3])])

    def _twist(self, q: jax.Array, qd: jax.Array) -> jax.Array:
        """Compute the body twist A(q) q'."""
        omega = matvec(self.attitude.body_rate_matrix(q[3:]), qd[3:])
        return jnp.concatenate([omega, matvec(self.attitude.to_matrix(q[3:]).T, qd[:3])])

    def _rates(self, q: jax.Array, V: jax.Array) -> jax.Array:
        """Compute the rates q' = B(q) V."""
        turning = matvec(self.attitude.inverse_body_rate_matrix(q[3:]), V[:3])
        return jnp.concatenate([matvec(self.attitude.to_matrix(q[3:]), V[3:]), turning])


class Lagrange(_InCoordinates):
    """Lagrange's equations in a representation of attitude with three parameters; v is q'."""

    def __init__(self, attitude: str):
        super().__init__(attitude)
        if self.attitude.size != 3:
            raise InputError(
                f"Lagrange: {attitude!r} has {self.attitude.size} parameters, expected a minimal "
                f"representation, with 3; QuasiLagrange takes any"
            )

    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> BodyState:
        """Return the state of a body with pose T (4, 4) and body twist V (6,).

        At a singularity, raise `InputError`, or return very large rates if T is traced.
        """
        q = self._coordinates(T)
        distance = self.attitude.singularity_distance(q[3:])
        if not isinstance(distance, jax.core.Tracer) and distance < SINGULAR:
            raise InputError(
                f"Lagrange: T is {float(distance):.1e} rad from where {self.attitude.name} is "
                f"singular ({self.attitude.singular_set}), expected an attitude away from there; "
                f"take another representation, or QuasiLagrange('unit_quaternion')"
            )
        return BodyState(q, self._rates(q, V))

    def rate(self, t: Any, y: BodyState, args: Situation) -> BodyState:
        _, rest = split(args)
        F = total_wrench(rest, t, self._pose(y.q), self.twist(args[0], y))
        _, work = jax.vjp(lambda qd: self._twist(y.q, qd), y.v)
        return BodyState(y.v, lagrange.acceleration(self.system(args), y.q, y.v, work(F)[0]))

    def twist(self, body: Body, y: BodyState) -> jax.Array:
        return self._twist(y.q, y.v)

    def system(self, args: Situation) -> lagrange.System:
        """Return the kinetic and potential energy in q, for functions of `lagrange`."""
        body = args[0]
        return lagrange.System(
            lambda q, qd: kinetic_energy(body, self._twist(q, qd)),
            lambda q: potential_energy(args, self._pose(q)),
        )


class QuasiLagrange(_InCoordinates):
    """Quasi-Lagrangian equations in any representation of attitude; v is the body twist."""

    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> BodyState:
        return BodyState(self._coordinates(T), V)

    def rate(self, t: Any, y: BodyState, args: Situation) -> BodyState:
        q, V = y
        body, (_, rest) = args[0], split(args)
        F = total_wrench(rest, t, self._pose(q), V)
        slope = jax.grad(lambda q: potential_energy(args, self._pose(q)))(q)
        _, virtual = jax.vjp(lambda V: self._rates(q, V), V)
        return BodyState(
            self._rates(q, V),
            hamel_acceleration(
                lambda q, V: kinetic_energy(body, V), self._twist, self._rates, q, V,
                F - virtual(slope)[0],
            ),
        )  # fmt: skip

    def twist(self, body: Body, y: BodyState) -> jax.Array:
        return y.v


def hamel_acceleration(
    kinetic: Callable[[jax.Array, jax.Array], jax.Array],
    velocities: Callable[[jax.Array, jax.Array], jax.Array],
    rates: Callable[[jax.Array, jax.Array], jax.Array],
    q: jax.Array,
    nu: jax.Array,
    N: jax.Array,
) -> jax.Array:
    """Compute the rates nu' (m,) of quasi-velocities by Hamel's equations.

    Args:
        kinetic: function (q (n,), nu (m,)) -> kinetic energy (), J.
        velocities: function (q, q') -> nu = A(q) q'.
        rates: function (q, nu) -> q' = B(q) nu.
        q: (n,), coordinates in their units.
        nu: (m,), quasi-velocities.
        N: (m,), forces B^T Q, whose power is N . nu, W.

    Returns:
        nu' (m,), in the unit of nu per second.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.body import hamel_acceleration
        >>> polar = hamel_acceleration(  # a unit mass; nu = (r", r phi")
        ...     lambda q, nu: nu @ nu / 2,
        ...     lambda q, qd: jnp.stack([qd[0], q[0] * qd[1]]),
        ...     lambda q, nu: jnp.stack([nu[0], nu[1] / q[0]]),
        ...     jnp.array([2.0, 0.0]), jnp.array([1.0, 4.0]), jnp.zeros(2))
        >>> polar.tolist()
        [8.0, -2.0]
    """
    qd = rates(q, nu)
    p = jax.grad(kinetic, 1)(q, nu)
    _, carried = jax.vjp(lambda q: velocities(q, qd), q)

    def momentum(q: jax.Array) -> jax.Array:
        """Compute A^T p, the momentum conjugate to q', with p held constant."""
        return jax.vjp(lambda qd: velocities(q, qd), qd)[1](p)[0]

    _, swept = jax.jvp(momentum, (q,), (qd,))
    _, virtual = jax.vjp(lambda nu: rates(q, nu), nu)
    force = N + virtual(carried(p)[0] - swept + jax.grad(kinetic)(q, nu))[0]
    M = jax.hessian(kinetic, 1)(q, nu)
    _, drift = jax.jvp(lambda q: jax.grad(kinetic, 1)(q, nu), (q,), (qd,))
    return jnp.linalg.solve(M, force - drift)
