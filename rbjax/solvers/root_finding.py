"""Roots of implicit steps: Newton and chord iterations of optimistix with their own stopping rule.

The residual of a stiff step is mostly rounding, so its size is not a test of convergence. The
iteration stops if a correction is rounding relative to the state, or if the convergence rate
predicts this for the next correction. A failure does not raise: `ok` is False, and the step's
result reports it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.flatten_util import ravel_pytree

from rbjax._jax_compat import FIRST_STATE, correction, corrections
from rbjax.errors import InputError
from rbjax.lanes import matvec

MAX_STEPS = 100  # chord iterations are cheap, and a stiff spring on a heavy arm needs many
ROUNDING = 4  # units in the last place of the state
LOST = 0.2  # share of digits lost to conditioning; constant corrections of this size are rounding
FAST = 0.1  # after this convergence rate, growing corrections below sqrt(eps) are rounding


class RootFinder(optx.AbstractRootFinder):
    """`optx.Newton`, `optx.Chord` or diffrax's `VeryChord`, stopped by the size of the corrections.

    Options:
        scale: size of the state, 1 by default.
        near: function (y, args) -> (value, None) whose Jacobian replaces that of the residual in
            chord iterations.
        slope: function like `near`, used in chord and Newton iterations.

    Fields:
        inner: the wrapped root finder.
        rtol, atol, norm: required by optimistix and diffrax, and not used.
    """

    rtol: float = 1.0
    atol: float = 1.0
    norm: Callable[[Any], jax.Array] = optx.max_norm
    inner: Any = eqx.field(default_factory=lambda: _make(optx.Chord, Inverse()))

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        if FIRST_STATE in options:  # diffrax shares one initial state between all stages of a step
            return options[FIRST_STATE]
        fn = options.get("near", options.get("slope", fn))
        inner = self.inner.init(fn, y, args, {}, f_struct, aux_struct, tags)
        infinite = jnp.full((), jnp.inf, _dtype(y))
        return inner, infinite, infinite

    def step(self, fn, y, args, options, state, tags):
        inner, _, pace = state  # pace: size of the correction if each one had shrunk by FAST
        before = _max_abs(correction(inner))
        if isinstance(self.inner, optx.Newton):
            fn = options.get("slope", fn)
        y, inner, aux = self.inner.step(fn, y, args, {}, inner, tags)
        pace = jnp.where(corrections(inner) == 1, _max_abs(correction(inner)), FAST * pace)
        return y, (inner, before, pace), aux

    def terminate(self, fn, y, args, options, state, tags):
        inner, before, pace = state
        dtype = _dtype(y)
        scale = jnp.maximum(jnp.asarray(options.get("scale", 1.0), dtype), _max_abs(y))
        eps = jnp.finfo(dtype).eps
        near = ROUNDING * eps * scale
        now = _max_abs(correction(inner))
        rate = now / jnp.where(before > 0, before, 1.0)
        falling = (corrections(inner) >= 2) & (rate < 0.9)
        next_ = jnp.where(falling, rate / (1 - jnp.where(falling, rate, 0.0)) * now, now)
        small = (FAST * before <= pace) & (now <= jnp.sqrt(eps) * scale)
        grown = (corrections(inner) >= 3) & (rate >= 1) & small
        stalled = (corrections(inner) >= 2) & (rate > 0.5) & (now <= eps**-LOST * near)
        broken = ~jnp.isfinite(now) & (corrections(inner) >= 1)
        done = (corrections(inner) >= 1) & ((next_ <= near) | (now == 0) | stalled | grown)
        failed = optx.RESULTS.where(
            broken, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        return done | broken, failed

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def newton(linear_solver: lx.AbstractLinearSolver | None = None) -> RootFinder:
    """Return a full Newton iteration, with a new Jacobian in each step.

    Args:
        linear_solver: of lineax; None for `AutoLinearSolver`. GMRES needs no matrix.

    Example:
        >>> import rbjax as rb
        >>> solver = rb.solvers.radau_iia(3, root_finder=rb.solvers.newton())
    """
    return RootFinder(
        inner=_make(optx.Newton, linear_solver or lx.AutoLinearSolver(well_posed=None))
    )


def chord(linear_solver: lx.AbstractLinearSolver | None = None) -> RootFinder:
    """Return a simplified Newton iteration, with one Jacobian per step at the initial guess.

    Args:
        linear_solver: of lineax; None for the inverse.

    Raises:
        InputError: the linear solver uses only matrix-vector products, so it cannot reuse a matrix.

    See `newton` for an example.
    """
    if linear_solver is not None and iterative(linear_solver):
        name = type(linear_solver).__name__
        raise InputError(
            f"chord: got lineax.{name}, expected a linear solver that uses the matrix of a chord; "
            f"newton({name}(...)) needs none"
        )
    return RootFinder(inner=_make(optx.Chord, linear_solver or Inverse()))


def very_chord() -> RootFinder:
    """Return diffrax's iteration for diagonally implicit methods: one Jacobian for all stages.

    See `newton` for an example.
    """
    return RootFinder(inner=diffrax.VeryChord(1.0, 1.0))


class Inverse(lx.AbstractLinearSolver):
    """Linear solver by the inverse matrix, for chord iterations, which reuse one matrix often."""

    def init(self, operator, options):
        return jnp.linalg.inv(operator.as_matrix())

    def compute(self, state, vector, options):
        flat, unravel = ravel_pytree(vector)
        return unravel(matvec(state, flat)), lx.RESULTS.successful, {}

    def transpose(self, state, options):
        return state.T, options

    def conj(self, state, options):
        return state.conj(), options

    def assume_full_rank(self):
        return True


def _make(method: Any, linear_solver: lx.AbstractLinearSolver) -> Any:
    return method(1.0, 1.0, linear_solver=linear_solver, cauchy_termination=False)


def linear_solver(finder: Any) -> lx.AbstractLinearSolver:
    """Return the linear solver of a root finder."""
    return getattr(getattr(finder, "inner", finder), "linear_solver", lx.LU())


def matrix_free(finder: Any) -> bool:
    """Return whether the linear solver of a root finder uses only matrix-vector products."""
    return iterative(linear_solver(finder))


def iterative(solver: lx.AbstractLinearSolver) -> bool:
    """Return whether a linear solver uses only matrix-vector products."""
    return isinstance(solver, (lx.GMRES, lx.BiCGStab, lx.CG, lx.Normal))


def root(
    residual: Callable[[Any], Any],
    finder: Any,
    guess: Any,
    y0: Any,
    max_steps: int,
    near: Any = None,
    slope: Any = None,
) -> tuple[Any, jax.Array]:
    """Find the root of `residual` near `guess`. Return it and whether the iteration converged.

    The root is differentiated by the implicit function theorem.

    Args:
        y0: state whose size is the scale of the convergence test.
        near: function with a cheaper Jacobian than `residual`, for chord iterations; None to omit.
        slope: function with the same roots, whose Jacobian makes Newton's method converge from
            farther away; None to omit.
    """
    options: dict[str, Any] = {"scale": _max_abs(y0)}
    for name, f in (("near", near), ("slope", slope)):
        if f is not None:  # closed-over values become leaves, which `stop_gradient` reaches
            options[name] = eqx.filter_closure_convert(f, guess, None)
    solution: Any = optx.root_find(
        lambda x, _: residual(x),
        finder,
        jax.lax.stop_gradient(guess),
        options=stop_gradient(options),
        max_steps=max_steps,
        throw=False,
    )
    return solution.value, solution.result == optx.RESULTS.successful


def step_result(ok: jax.Array) -> Any:
    """Return the diffrax result of a step, from whether its roots were found."""
    results = diffrax.RESULTS
    return results.where(ok, results.successful, results.nonlinear_divergence)


def mark_failed(ok: jax.Array, error: Any) -> Any:
    """Return the error estimate, or infinity if a root failed, so that the step is shortened."""
    return jax.tree.map(lambda x: jnp.where(ok, x, jnp.inf), error)


def stop_gradient(tree: Any) -> Any:
    """Stop the derivatives of a pytree that may contain leaves other than arrays."""
    numbers, rest = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.lax.stop_gradient(numbers), rest)


def _max_abs(tree: Any) -> jax.Array:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(x)) for x in jax.tree.leaves(tree) if x.size]))


def _dtype(tree: Any) -> Any:
    return jnp.result_type(*jax.tree.leaves(tree))
