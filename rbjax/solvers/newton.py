"""Roots of implicit steps: optimistix' Newton and chord iterations, stopped by their corrections.

optimistix stops where the residual is below a tolerance, or where the corrections shrink at a
steady rate. In a step neither can be trusted: the residual of a stiff step is all rounding, and
at an equilibrium the corrections are. So a wrapper stops where the correction, or what the rate of
the corrections leaves of the next, is rounding beside the state. A chord's corrections shrink at
a rate that stays: where they shrank fast and then grow, that is rounding too, however large an
ill-conditioned mass matrix makes it. A root that is not reached is a value: `ok` is false, and with
it the step's result.
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

from rbjax.errors import InputError
from rbjax.lanes import matvec

MAX_STEPS = 100  # a chord's are cheap, and slow where a stiff spring shakes a heavy arm
ROUNDING = 4  # units in the last place of the state
LOST = 0.2  # of the digits, to conditioning: so large, corrections that stay are rounding
FAST = 0.1  # rate after which corrections that grow are rounding, below sqrt(eps) of the state


class Settled(optx.AbstractRootFinder):
    """optimistix' `Newton` or `Chord`, or diffrax' `VeryChord`, stopped by the size of corrections.

    The option `scale` is the size of the state; without it 1. Two options are functions
    (y, args) -> (value, None) from which a matrix is taken instead of the residual's: `near` by a
    chord, `slope` by Newton's iteration as well. The state: the inner one, the size of the last
    correction but one, and what it would be had each shrunk by `FAST`.
    Fields: inner; the others are what optimistix and diffrax expect of a root finder, and not used.
    """

    rtol: float = 1.0
    atol: float = 1.0
    norm: Callable[[Any], jax.Array] = optx.max_norm
    inner: Any = eqx.field(default_factory=lambda: _made(optx.Chord, Inverse()))

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        if "init_state" in options:  # diffrax begins the iteration of a whole step at once
            return options["init_state"]
        fn = options.get("near", options.get("slope", fn))
        inner = self.inner.init(fn, y, args, {}, f_struct, aux_struct, tags)
        infinite = jnp.full((), jnp.inf, _dtype(y))
        return inner, infinite, infinite

    def step(self, fn, y, args, options, state, tags):
        inner, _, pace = state
        before = _largest(inner.diff)
        if isinstance(self.inner, optx.Newton):
            fn = options.get("slope", fn)
        y, inner, aux = self.inner.step(fn, y, args, {}, inner, tags)
        pace = jnp.where(inner.step == 1, _largest(inner.diff), FAST * pace)
        return y, (inner, before, pace), aux

    def terminate(self, fn, y, args, options, state, tags):
        inner, before, pace = state
        dtype = _dtype(y)
        scale = jnp.maximum(jnp.asarray(options.get("scale", 1.0), dtype), _largest(y))
        eps = jnp.finfo(dtype).eps
        near = ROUNDING * eps * scale
        now = _largest(inner.diff)
        rate = now / jnp.where(before > 0, before, 1.0)
        falling = (inner.step >= 2) & (rate < 0.9)
        next_ = jnp.where(falling, rate / (1 - jnp.where(falling, rate, 0.0)) * now, now)
        small = (FAST * before <= pace) & (now <= jnp.sqrt(eps) * scale)
        grown = (inner.step >= 3) & (rate >= 1) & small
        stalled = (inner.step >= 2) & (rate > 0.5) & (now <= eps**-LOST * near)
        broken = ~jnp.isfinite(now) & (inner.step >= 1)
        done = (inner.step >= 1) & ((next_ <= near) | (now == 0) | stalled | grown)
        failed = optx.RESULTS.where(
            broken, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        return done | broken, failed

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def newton(linear_solver: lx.AbstractLinearSolver | None = None) -> Settled:
    """Full Newton: the Jacobian anew in each iteration. `lineax.GMRES` does without its matrix."""
    return Settled(inner=_made(optx.Newton, linear_solver or lx.AutoLinearSolver(well_posed=None)))


def chord(linear_solver: lx.AbstractLinearSolver | None = None) -> Settled:
    """Simplified Newton: one Jacobian a step, at the first guess.

    Raises:
        InputError: a linear solver that goes by products alone: there is nothing to hold.
    """
    if linear_solver is not None and iterative(linear_solver):
        name = type(linear_solver).__name__
        raise InputError(
            f"chord: got lineax.{name}, expected a linear solver of the matrix that a chord holds; "
            f"newton({name}(...)) does without one"
        )
    return Settled(inner=_made(optx.Chord, linear_solver or Inverse()))


def very_chord() -> Settled:
    """diffrax' own, for its diagonally implicit methods: one Jacobian for all stages."""
    return Settled(inner=diffrax.VeryChord(1.0, 1.0))


class Inverse(lx.AbstractLinearSolver):
    """By the inverse matrix, for chords: they solve often, and a correction mends the last one's
    rounding."""

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


def _made(method: Any, linear_solver: lx.AbstractLinearSolver) -> Any:
    return method(1.0, 1.0, linear_solver=linear_solver, cauchy_termination=False)


def linear_solver(finder: Any) -> lx.AbstractLinearSolver:
    """The one that a root finder solves its corrections with."""
    return getattr(getattr(finder, "inner", finder), "linear_solver", lx.LU())


def matrix_free(finder: Any) -> bool:
    """Whether that asks for products alone, and for no matrix."""
    return iterative(linear_solver(finder))


def iterative(solver: lx.AbstractLinearSolver) -> bool:
    """Whether a linear solver goes by products alone."""
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
    """The root of `residual` beside `guess`, and whether it was found; y0 sets the scale.

    `near` has a cheaper derivative, for chords; `slope` the residual's value at the guess, its
    roots, and a derivative that leads there sooner. The root's own derivatives are those of the
    implicit function, in both directions.
    """
    options: dict[str, Any] = {"scale": _largest(y0)}
    for name, f in (("near", near), ("slope", slope)):
        if f is not None:  # what it closes over becomes leaves, which `stopped` stops
            options[name] = eqx.filter_closure_convert(f, guess, None)
    solution: Any = optx.root_find(
        lambda x, _: residual(x),
        finder,
        jax.lax.stop_gradient(guess),
        options=stopped(options),
        max_steps=max_steps,
        throw=False,
    )
    return solution.value, solution.result == optx.RESULTS.successful


def verdict(ok: jax.Array) -> Any:
    """diffrax' result of a step with roots."""
    results = diffrax.RESULTS
    return results.where(ok, results.successful, results.nonlinear_divergence)


def refused(ok: jax.Array, error: Any) -> Any:
    """The error estimate, infinite where a root failed: an adaptive step is then tried shorter."""
    return jax.tree.map(lambda x: jnp.where(ok, x, jnp.inf), error)


def stopped(tree: Any) -> Any:
    """The same without derivatives; what is no array, as the functions in the state of a linear
    solver without a matrix, stays as it is."""
    numbers, rest = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.lax.stop_gradient(numbers), rest)


def _largest(tree: Any) -> jax.Array:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(x)) for x in jax.tree.leaves(tree) if x.size]))


def _dtype(tree: Any) -> Any:
    return jnp.result_type(*jax.tree.leaves(tree))
