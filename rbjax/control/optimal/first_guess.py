"""Knots and controls from which a search starts.

The solution of a similar problem is rolled out from the new start with its feedback,

    u_k = us_k - K_k (x_k (-) xs_k),  within the bounds,      x_{k+1} = f(x_k, u_k)

Controls without states are rolled out without feedback. On an unstable plant this motion may
diverge, so it is used only if it costs no more than a constant state. With contacts it is always
used if it is finite: a contact that the first guess never makes has no gradient.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import instance
from rbjax.compiler import threads
from rbjax.control.optimal.objective import (
    PENALTY,
    ConstraintMultipliers,
    merit,
    over_knots,
    roll_out,
    row_count,
)
from rbjax.control.optimal.problem import BODY, Knot, Problem, take
from rbjax.control.optimal.solution import Solution
from rbjax.control.products import product
from rbjax.errors import InputError
from rbjax.lanes.arrays import select


class Guess(NamedTuple):
    """A first guess; None is the default of each field."""

    states: Any = None  # (N + 1, ...)
    ctrl: Any = None  # (N, nu)
    parameters: Any = None  # (p,)
    K: Any = None  # (N, nu, n), the gains of a solution
    multipliers: ConstraintMultipliers | None = None  # the multipliers of a solution


def guess_of(problem: Problem, guess: Any, states: Any, ctrl: Any, parameters: Any) -> Guess:
    """Build the guess from the arguments of `solve`."""
    if guess is None:
        return Guess(states, None if ctrl is None else jnp.asarray(ctrl), parameters)
    public = "the Solution of a similar problem; give arrays as states= and ctrl="
    instance("solve", "guess", guess, Solution, public)
    given = {"states": states, "ctrl": ctrl, "parameters": parameters}
    twice = [name for name, x in given.items() if x is not None]
    if twice:
        raise InputError(f"solve: got guess and {twice}, expected one of them: a Solution has both")
    sizes = tuple(row_count(problem, where) for where in ("path", "end"))
    path, end = guess.multipliers
    multipliers = None
    if sum(sizes) and (path.shape, end.shape) == ((problem.horizon, sizes[0]), (sizes[1],)):
        multipliers = ConstraintMultipliers(path, end, guess.penalty)
    return Guess(guess.states, guess.ctrl, guess.parameters, guess.K, multipliers)


def first_guess(
    problem: Problem, start: Any, states: Any = None, ctrl: Any = None, parameters: Any = None,
    K: Any = None,
) -> tuple[Knot, jax.Array]:  # fmt: skip
    """Check the first guess and return the knots and controls from which a search starts."""
    N, dtype = problem.horizon, problem.dt.dtype
    one = problem.system.checked("solve", start)
    alone = states is None
    if alone:
        states = jax.tree.map(lambda x: jnp.broadcast_to(x, (N + 1, *x.shape)), one)
    else:
        due = jax.tree.map(lambda x: (N + 1, *x.shape), one)
        got = jax.tree.map(jnp.shape, states)
        if got != due:
            raise InputError(f"solve: states has shapes {got}, expected {due}: one a knot")
        states = jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), states, one)
    us = jnp.zeros((N, problem.nu), dtype) if ctrl is None else jnp.asarray(ctrl, dtype)
    if us.shape != (N, problem.nu):
        raise InputError(f"solve: ctrl has shape {us.shape}, expected ({N}, {problem.nu})")
    p = problem.first_parameters(dtype) if parameters is None else jnp.asarray(parameters, dtype)
    if p.shape != (problem.parameter_count,):
        due = (problem.parameter_count,)
        raise InputError(f"solve: parameters has shape {p.shape}, expected {due}")
    knots = Knot(states, jnp.broadcast_to(p, (N + 1, *p.shape)))
    if ctrl is None or not (alone or K is not None):
        return knots, us
    gains = jnp.zeros((N, problem.nu, problem.n), dtype) if K is None else jnp.asarray(K, dtype)
    if gains.shape != (N, problem.nu, problem.n):
        due = (N, problem.nu, problem.n)
        raise InputError(f"solve: the gains of guess have shape {gains.shape}, expected {due}")
    found = threads(functools.partial(follow, problem))(one, knots, us, gains)
    whole = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(found)]).all()
    both = jax.tree.map(lambda *x: jnp.stack(x), found, (knots, us))
    cost, standing = jax.vmap(functools.partial(_penalised_cost, problem))(*both)
    good = whole & jnp.isfinite(cost)
    if K is not None:
        good &= (gains != 0).any()
    elif not problem.system.touches:
        good &= cost <= standing
    return select(good, found, (knots, us))


def follow(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, K: jax.Array
) -> tuple[Knot, jax.Array]:
    """Roll out the controls from the start, with feedback K on the deviation from the knots."""
    first = take(knots, 0)
    away = problem.system.minus(first.state, start)
    away = jnp.where(jnp.asarray(problem.free), away, 0.0)
    first = first._replace(state=problem.system.plus(start, away))

    def policy(k: jax.Array, now: Knot, given: tuple) -> jax.Array:
        knot, ctrl, K = given
        return problem.within_bounds(ctrl - product(K, problem.minus(now, knot)))

    return roll_out(problem, first, policy, (take(knots, BODY), ctrls, K))


def _penalised_cost(problem: Problem, knots: Knot, ctrls: jax.Array) -> jax.Array:
    """Return the cost () of a motion, with penalties for violated constraints."""
    mu = jnp.asarray(PENALTY, ctrls.dtype)

    def at(where: str, k: Any, knot: Knot, ctrl: jax.Array) -> jax.Array:
        rows = jnp.zeros(row_count(problem, where), ctrl.dtype)
        return merit(problem, where, k, knot, ctrl, rows, mu)

    path, end = over_knots(at, problem, knots, ctrls)
    return path.sum() + end
