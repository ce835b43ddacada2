"""The knots and controls from which a search starts.

A solution that is the guess is rolled out from the new start with its feedback,

    u_k = us_k - K_k (x_k (-) xs_k),  within the bounds,      x_{k+1} = f(x_k, u_k)

so that the motion stays near the solution on an unstable plant. Controls without states are rolled
out without feedback. The result is used if it costs less than standing at the start: on an unstable
plant the motion may diverge.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.compiler import threads
from rbjax.control.optimal.objective import PENALTY, Multipliers, merit, row_count
from rbjax.control.optimal.problem import Knot, Problem
from rbjax.control.optimal.solution import Solution
from rbjax.control.products import product
from rbjax.errors import InputError


class Guess(NamedTuple):
    """A first guess; None is the default of each field.

    states: (N + 1, ...).
    ctrls: (N, nu).
    numbers: (p,).
    K: (N, nu, n), the gains of a solution.
    multipliers: the multipliers of a solution.
    """

    states: Any = None
    ctrls: Any = None
    parameters: Any = None
    K: Any = None
    multipliers: Multipliers | None = None


def guess_of(problem: Problem, guess: Any, states: Any, ctrls: Any, parameters: Any) -> Guess:
    """The guess that a caller of `solve` gives."""
    if guess is None:
        return Guess(states, None if ctrls is None else jnp.asarray(ctrls), parameters)
    if not isinstance(guess, Solution):
        raise InputError(
            f"solve: guess is {type(guess).__name__}, expected the Solution of a similar problem; "
            "give arrays as states= and ctrls="
        )
    given = {"states": states, "ctrls": ctrls, "numbers": parameters}
    twice = [name for name, x in given.items() if x is not None]
    if twice:
        raise InputError(f"solve: got guess and {twice}, expected one of them: a Solution has both")
    sizes = tuple(row_count(problem, where) for where in ("path", "end"))
    path, end = guess.multipliers
    multipliers = None
    if sum(sizes) and (path.shape, end.shape) == ((problem.horizon, sizes[0]), (sizes[1],)):
        multipliers = Multipliers(path, end, guess.penalty)
    return Guess(guess.states, guess.ctrls, guess.parameters, guess.K, multipliers)


def first_guess(
    problem: Problem, start: Any, states: Any = None, ctrls: Any = None, parameters: Any = None,
    K: Any = None,
) -> tuple[Knot, jax.Array]:  # fmt: skip
    """The checked knots and controls from which a search starts."""
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
    us = jnp.zeros((N, problem.nu), dtype) if ctrls is None else jnp.asarray(ctrls, dtype)
    if us.shape != (N, problem.nu):
        raise InputError(f"solve: ctrls has shape {us.shape}, expected ({N}, {problem.nu})")
    p = problem.first_parameters(dtype) if parameters is None else jnp.asarray(parameters, dtype)
    if p.shape != (problem.parameter_count,):
        due = (problem.parameter_count,)
        raise InputError(f"solve: parameters has shape {p.shape}, expected {due}")
    knots = Knot(states, jnp.broadcast_to(p, (N + 1, *p.shape)))
    if ctrls is None or not (alone or K is not None):
        return knots, us
    gains = jnp.zeros((N, problem.nu, problem.n), dtype) if K is None else jnp.asarray(K, dtype)
    if gains.shape != (N, problem.nu, problem.n):
        due = (N, problem.nu, problem.n)
        raise InputError(f"solve: the gains of guess have shape {gains.shape}, expected {due}")
    found, cost, standing = threads(functools.partial(_rolled, problem))(one, knots, us, gains)
    good = jnp.isfinite(cost)
    good &= (cost <= standing) if K is None else (gains != 0).any()
    return jax.tree.map(lambda x, y: jnp.where(good, x, y), found, (knots, us))


def _rolled(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, K: jax.Array
) -> tuple[tuple[Knot, jax.Array], jax.Array, jax.Array]:
    """The motion from the start with feedback about knots, its cost, and the cost of the knots."""
    N, dtype = problem.horizon, ctrls.dtype
    mu, none = jnp.asarray(PENALTY, dtype), jnp.zeros(problem.nu, dtype)
    rows = {at: jnp.zeros(row_count(problem, at), dtype) for at in ("path", "end")}
    first = jax.tree.map(lambda x: x[0], knots)
    away = problem.system.minus(first.state, start)
    away = jnp.where(jnp.asarray(problem.free), away, 0.0)
    first = first._replace(state=problem.system.plus(start, away))

    def forth(carry: tuple, x: tuple) -> tuple:
        now, cost, standing = carry
        k, knot, ctrl, K = x
        u = problem.within_bounds(ctrl - product(K, problem.minus(now, knot)))
        cost = cost + merit(problem, k, now, u, rows["path"], mu, "path")
        standing = standing + merit(problem, k, knot, ctrl, rows["path"], mu, "path")
        return (problem.step(k, now, u), cost, standing), (now, u)

    zero, ks = jnp.zeros((), dtype), jnp.arange(N, dtype=dtype)
    body = jax.tree.map(lambda x: x[:-1], knots)
    found: Any = jax.lax.scan(forth, (first, zero, zero), (ks, body, ctrls, K))
    (last, cost, standing), (before, us) = found
    end = jax.tree.map(lambda x: x[-1], knots)
    cost = cost + merit(problem, N, last, none, rows["end"], mu, "end")
    standing = standing + merit(problem, N, end, none, rows["end"], mu, "end")
    motion = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), before, last)
    whole = jax.tree.map(lambda x: jnp.isfinite(x).all(), jax.tree.leaves((motion, us)))
    return (motion, us), jnp.where(jnp.stack(whole).all(), cost, jnp.inf), standing
