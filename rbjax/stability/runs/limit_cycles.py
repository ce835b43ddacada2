"""Limit cycles: fixed points of a return map, and the eigenvalues of its Jacobian.

    y* = P(y*),   dy+ = P'(y*) dy
A cycle is stable if all eigenvalues of P' lie inside the unit circle. A return map that integrates
a motion with `rb.solvers.integrate_until`, or with `rb.simulate_impacts`, has the derivatives of
its event times and impacts in P'.

Source: Guckenheimer & Holmes, *Nonlinear Oscillations, Dynamical Systems, and Bifurcations of
Vector Fields*, 1.5; McGeer, *Passive dynamic walking*, 1990.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import flag, floating_array, integer, real_number
from rbjax.compiling import compiled
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_takes
from rbjax.errors import InputError

#: largest number of halvings of a Newton step
HALVINGS = 12


@displayed
class LimitCycle(NamedTuple):
    """A fixed point of a return map.

    Fields:
        state: (n,) the fixed point y*.
        eigenvalues: (n,) of the Jacobian of the return map, complex, the largest modulus first.
        jacobian: (n, n) of the return map at y*.
        residual: largest absolute entry of P(y*) - y*.
        steps: number of Newton steps.
        success: whether the residual is within the tolerance.
    """

    state: jax.Array
    eigenvalues: np.ndarray
    jacobian: np.ndarray
    residual: float
    steps: int
    success: bool

    @property
    def stable(self) -> bool:
        """Whether the cycle was found and all eigenvalues lie inside the unit circle."""
        return self.success and bool((np.abs(self.eigenvalues) < 1).all())


def limit_cycle(
    return_map: Callable[[jax.Array], jax.Array],
    guess: Any,
    *,
    tolerance: float | None = None,
    max_steps: int = 50,
    throw: bool = True,
) -> LimitCycle:
    """Find a fixed point of a return map by Newton's method, and its eigenvalues. Not traceable.

    Use it for gaits and bouncing motions: the map of the state after one footfall to the state
    after the next. Solve (P'(y) - 1) dy = y - P(y), y <- y + dy.

    Args:
        return_map: function (n,) -> (n,) with forward derivatives. Units are the caller's.
        guess: (n,) start of Newton's method.
        tolerance: largest allowed residual; 1e-10 in f64 and 1e-4 in f32 if None.
        max_steps: largest number of Newton steps.
        throw: raise if no fixed point is found. If False, `success` is False instead.

    Returns:
        `LimitCycle`.

    Raises:
        InputError: no fixed point near the guess; the message contains the residual.

    Source: Guckenheimer & Holmes, *Nonlinear Oscillations*, 1.5.

    Example: Newton's iteration for the square root of two, whose eigenvalue is zero
        >>> import rbjax as rb
        >>> found = rb.stability.limit_cycle(lambda y: (y + 2 / y) / 2, [1.0], tolerance=1e-5)
        >>> round(float(found.state[0]), 4), bool(abs(found.eigenvalues[0]) < 1e-3)
        (1.4142, True)
    """
    check_takes("limit_cycle", "return_map", return_map, "y")
    y = floating_array("limit_cycle", "guess", guess, lambda s: len(s) == 1 and s[0] > 0, "(n,)")
    integer("limit_cycle", "max_steps", max_steps, least=1)
    flag("limit_cycle", "throw", throw)
    if tolerance is None:
        tolerance = 1e-10 if y.dtype == jnp.float64 else 1e-4
    real_number("limit_cycle", "tolerance", tolerance, "a number above zero", above=0.0)
    shape = jax.eval_shape(return_map, y)
    if getattr(shape, "shape", None) != y.shape:
        raise InputError(f"limit_cycle: return_map returned {shape}, expected shape {y.shape}")

    evaluate = compiled(functools.partial(_value_and_jacobian, return_map))
    y, after, jacobian, steps = _newton(evaluate, y, tolerance, max_steps)
    residual = float(np.abs(after - np.asarray(y, float)).max())
    success = bool(residual <= tolerance and np.isfinite(jacobian).all())
    if throw and not success:
        raise InputError(
            f"limit_cycle: no fixed point near the guess; after {steps} Newton steps the "
            f"residual is {residual:.2g}. Start nearer, for example after some cycles of the "
            "motion, or throw=False to look at the result"
        )
    eigenvalues = np.linalg.eigvals(jacobian) if success else np.full(len(y), np.nan + 0j)
    order = np.argsort(-np.abs(eigenvalues), kind="stable")
    return LimitCycle(y, eigenvalues[order], jacobian, residual, steps, success)


def _value_and_jacobian(return_map: Callable, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return P(y) and P'(y), in one program: a return map with impacts is slow to compile."""
    after, push = jax.linearize(return_map, y)
    return after, jax.vmap(push, out_axes=1)(jnp.eye(len(y), dtype=y.dtype))


def _newton(
    evaluate: Callable, y: jax.Array, tolerance: float, max_steps: int
) -> tuple[jax.Array, np.ndarray, np.ndarray, int]:
    """Return the last iterate, P and P' there, and the number of steps. A step is halved until the
    residual decreases; after the tolerance is met, one step more removes the error of the last."""
    after, J = (np.asarray(x, float) for x in evaluate(y))
    off = after - np.asarray(y, float)
    for steps in range(max_steps):
        if not (np.isfinite(off).all() and np.isfinite(J).all()):
            return y, after, J, steps
        met = np.abs(off).max() <= tolerance
        step = np.linalg.lstsq(np.eye(len(off)) - J, off, rcond=None)[0]
        for _ in range(1 if met else HALVINGS):
            new = y + jnp.asarray(step, y.dtype)
            later, new_J = (np.asarray(x, float) for x in evaluate(new))
            new_off = later - np.asarray(new, float)
            if np.abs(new_off).max() < np.abs(off).max():
                break
            step = step / 2
        else:
            return y, after, J, steps
        y, after, J, off = new, later, new_J, new_off
        if met:
            return y, after, J, steps + 1
    return y, after, J, max_steps
