"""Measurements on one step of a solver: growth factors, dissipation, period elongation.

    y' = lambda y:  as two real equations, z = h lambda
    q'' + 2 xi omega q' + omega^2 q = 0:  (q, v / omega), Omega = h omega
A step is linear in the state and in the solver's memory. One step from each unit vector gives its
matrix, whose eigenvalues are the growth factors of the code. The exact factors are exp(z) and
exp(+-i Omega). A factor exp(Omega' (-xi' +- i)) is a vibration with frequency Omega' / h and
damping ratio xi'.
(Hughes, *The Finite Element Method*, 9.3; Chung & Hulbert, *J. Applied Mechanics* 60, 1993.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from rbjax.arguments import real_array, real_number
from rbjax.errors import InputError
from rbjax.solvers import Adams, GeneralizedAlpha
from rbjax.solvers.multistep import AbstractMultistep
from rbjax.stability.methods import fixed_step_solver
from rbjax.stability.theory.multistep_roots import Method, Theory, characteristic

NEEDS_PAST = (diffrax.LeapfrogMidpoint, diffrax.ReversibleHeun)  # solvers that need past states


def _scalar(t: Any, y: Any, z: jax.Array) -> jax.Array:
    """Return the rate z y, for the real and imaginary part of y."""
    a, b = z
    return jnp.stack([a * y[0] - b * y[1], b * y[0] + a * y[1]])


def _oscillator(t: Any, y: Any, stiffness_damping: jax.Array) -> tuple[jax.Array, jax.Array]:
    k, d = stiffness_damping
    q, v = y
    return v, -k * q - d * v


def _pair(t: Any, y: Any, stiffness_damping: jax.Array) -> tuple[jax.Array, jax.Array]:
    K, D = stiffness_damping
    q, v = y
    return v, K @ q + D @ v


def _memory_of(solver: Any, state: Any) -> tuple[Any, Callable[[Any], Any]]:
    """Return the numbers in a solver's state, and the function that rebuilds the state."""
    if isinstance(solver, AbstractMultistep):
        full = state.ts.shape[0]
        return state.values, lambda old: state._replace(values=old, filled=jnp.array(full))
    if isinstance(solver, GeneralizedAlpha):
        return state[0], lambda carried: (carried, jnp.array(False))
    return (), lambda nothing: state


@eqx.filter_jit
def _matrices(field: Any, solver: Any, like: Any, args: jax.Array, omega: Any) -> jax.Array:
    """Return the matrices (m, k, k) that map state and memory of a solver across a step of length
    one, for rows of arguments (m, ...) of a linear field. Units are powers of omega (m,)."""
    term = diffrax.ODETerm(field)
    t0, t1 = jnp.array(0.0), jnp.array(1.0)

    def matrix(args, omega):
        memory, _ = _memory_of(solver, solver.init(term, t0, t1, like, args))
        flat, unravel = ravel_pytree((like, memory))
        scale = omega ** _powers(solver, flat.size)

        def step(x):
            y, memory = unravel(x)
            before = solver.init(term, t0, t1, y, args)
            before = _memory_of(solver, before)[1](memory)
            y1, _, _, after, _ = solver.step(term, t0, t1, y, args, before, made_jump=False)
            return ravel_pytree((y1, _memory_of(solver, after)[0]))[0]

        return jax.vmap(step)(jnp.diag(scale)).T / scale[:, None]

    return jax.vmap(matrix)(args, omega)


def _powers(solver: Any, n: int) -> np.ndarray:
    """Return the powers of omega that scale q, v and the solver's memory to similar size."""
    if isinstance(solver, GeneralizedAlpha):
        return np.array([0, 1, 2])[np.minimum(np.arange(n) * 3 // n, 2)]
    past = (n - 2) // 2
    rates = int(isinstance(solver, Adams))
    return np.array([0, 1] + [rates] * past + [1 + rates] * past)


def step_matrices(
    solver: Any, field: Any, like: Any, args: np.ndarray, omega: np.ndarray | None = None
) -> np.ndarray:
    """Compute the matrices of one step (`_matrices`) in f64, whatever the caller's precision.

    The constants of a solver become arrays, so all solvers of a class share one compiled program.
    """
    one = fixed_step_solver(solver)
    if isinstance(one, NEEDS_PAST) or one.term_structure is not diffrax.AbstractTerm:
        raise InputError(
            f"stability: {type(one).__name__} does not step a linear equation from only a "
            "state, expected a solver of vector fields, or of q' = v, v' = a"
        )
    one = jax.tree.map(lambda x: np.asarray(x) if isinstance(x, float) else x, one)
    omega = np.ones(len(args)) if omega is None else omega
    with jax.enable_x64(True):
        return np.asarray(_matrices(field, one, like, jnp.asarray(args), jnp.asarray(omega)))


def matrices_of_pair(solver: Any, K: np.ndarray, D: np.ndarray) -> np.ndarray:
    """Return the matrices (m, k, k) of one step of length one on q' = v, v' = K q + D v. K and D
    are (m, n, n)."""
    n = K.shape[-1]
    return step_matrices(solver, _pair, (np.zeros(n), np.zeros(n)), np.stack([K, D], 1))


def growth_factors(solver: Method, z: Any) -> np.ndarray:
    """Measure the growth factors of y in one step of a solver on y' = lambda y, z = h lambda.

    Args:
        solver: a name of `rb.solvers.all()`, a solver, a tableau, or a result of
            `stability_function` or `characteristic`.
        z: (...), complex, no unit.

    Returns:
        (..., k) complex: R(z) of a one-step method; all roots, largest first, of a multistep
            method.

    Raises:
        InputError: a solver of other equations.

    Example:
        >>> import rbjax as rb
        >>> factor = rb.stability.growth_factors("euler", -0.5)
        >>> float(factor[0].real)
        0.5
    """
    z = real_array("growth_factors", "z", z, "finite numbers h lambda", complex_numbers=True)
    if isinstance(solver, Theory):
        return _sorted(characteristic(solver).roots(z))
    if not z.size:
        raise InputError(f"growth_factors: z has shape {z.shape}, expected at least one number")
    rows = np.stack([z.real.ravel(), z.imag.ravel()], -1)
    real = step_matrices(solver, _scalar, np.zeros(2), rows)
    # a complex factor is a block [[a, -b], [b, a]], whose first column is a + i b
    matrix = real[:, ::2, ::2] + 1j * real[:, 1::2, ::2]
    return _sorted(np.linalg.eigvals(matrix)).reshape(*z.shape, -1)


def frequencies(h_omega: Any) -> np.ndarray:
    """Return the values of h omega (...) as an array."""
    expected = "numbers, the step times the angular frequency"
    return real_array("stability", "h_omega", h_omega, expected, finite=False)


def oscillator_factors(solver: Method, h_omega: Any, damping_ratio: float = 0.0) -> np.ndarray:
    """Measure the growth factors of an oscillation in one step of a solver's code, largest first.

    Args:
        solver: a name of `rb.solvers.all()`, a diffrax solver of vector fields or of q' = v,
            v' = a, or any argument of `growth_factors`.
        h_omega: (...) Omega = h omega, step times natural angular frequency, positive.
        damping_ratio: xi of q'' + 2 xi omega q' + omega^2 q = 0.

    Returns:
        (..., k) complex, with k = 2 plus the size of the solver's memory.

    Raises:
        InputError: a solver of other equations, or an h_omega that is not positive.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> factors = rb.stability.oscillator_factors("stoermer_verlet", np.sqrt(2.0))
        >>> bool(abs(factors - [1j, -1j]).max() < 1e-6)
        True
    """
    omega = frequencies(h_omega)
    if not omega.size:
        raise InputError("oscillator_factors: h_omega is empty, expected at least one number")
    wrong = ~((omega > 0) & np.isfinite(omega))
    if wrong.any():
        raise InputError(
            f"oscillator_factors: h_omega has {omega[wrong][0]}, expected h times omega, positive "
            "and finite; at zero nothing oscillates"
        )
    real_number("oscillator_factors", "damping_ratio", damping_ratio, traced=True)
    if isinstance(solver, Theory):  # the oscillator as two scalar equations
        pair = -damping_ratio + np.array([1j, -1j]) * np.emath.sqrt(1 - damping_ratio**2)
        roots = characteristic(solver).roots(omega[..., None] * pair)
        return _sorted(roots.reshape(*omega.shape, -1))
    w = omega.ravel()
    rows = np.stack([w**2, 2 * damping_ratio * w], -1)
    matrix = step_matrices(solver, _oscillator, (np.zeros(()), np.zeros(())), rows, w)
    return _sorted(np.linalg.eigvals(matrix)).reshape(*omega.shape, -1)


def _sorted(factors: np.ndarray) -> np.ndarray:
    return np.take_along_axis(factors, np.argsort(-np.abs(factors), axis=-1, kind="stable"), -1)


def spectral_radius(solver: Method, h_omega: Any, damping_ratio: float = 0.0) -> np.ndarray:
    """Measure the modulus of the largest growth factor on an oscillation with h omega (...).

    Args:
        solver: a name of `rb.solvers.all()`, a solver, a tableau, or a result of
            `stability_function` or `characteristic`.
        h_omega: (...), h omega, rad.
        damping_ratio: damping over critical damping, no unit.

    Returns:
        (...), no unit.

    Example:
        >>> import rbjax as rb
        >>> solver = rb.solvers.generalized_alpha(0.8)
        >>> round(float(rb.stability.spectral_radius(solver, 1e4)), 2)
        0.8
    """
    return np.abs(oscillator_factors(solver, h_omega, damping_ratio)).max(-1)


def _principal(solver: Method, h_omega: Any) -> np.ndarray:
    """Return the growth factor that approximates exp(i h omega); nan if no factor oscillates."""
    factors = oscillator_factors(solver, h_omega)
    distance = np.abs(factors - np.exp(1j * frequencies(h_omega))[..., None])
    factor = np.take_along_axis(factors, distance.argmin(-1)[..., None], -1)[..., 0]
    return np.where(factor.imag > 0, factor, np.nan)


def dissipation(solver: Method, h_omega: Any) -> np.ndarray:
    """Measure the numerical damping ratio xi' of one step of a solver on an undamped oscillation.

    xi' = -ln |zeta| / arg zeta, with the factor zeta that approximates exp(i Omega).

    Args:
        solver: a name of `rb.solvers.all()`, a solver, a tableau, or a result of
            `stability_function` or `characteristic`.
        h_omega: (...), h omega, rad; below pi, because larger steps do not resolve the oscillation.

    Returns:
        (...) damping ratio; negative if the method adds energy, nan if no factor oscillates.

    Source: Hughes, *The Finite Element Method*, 9.3.

    Example:
        >>> import rbjax as rb
        >>> abs(float(rb.stability.dissipation("newmark", 0.5))) < 1e-12
        True
    """
    factor = _principal(solver, h_omega)
    return -np.log(np.abs(factor)) / np.angle(factor)


def period_elongation(solver: Method, h_omega: Any) -> np.ndarray:
    """Measure the period elongation (T' - T) / T of one step on an undamped oscillation.

    (T' - T) / T = Omega / arg zeta - 1. Newmark's average acceleration has Omega^2 / 12.

    Args:
        solver: a name of `rb.solvers.all()`, a solver, a tableau, or a result of
            `stability_function` or `characteristic`.
        h_omega: (...), h omega, rad; below pi, because larger steps do not resolve the oscillation.

    Returns:
        (...), no unit; nan if no factor oscillates.

    Example:
        >>> import rbjax as rb
        >>> round(float(rb.stability.period_elongation("newmark", 0.1)) * 12e2, 2)
        1.0
    """
    return frequencies(h_omega) / np.angle(_principal(solver, h_omega)) - 1
