"""Swing-up of the cart-pole and the acrobot from hanging, for many starts, controls in bounds.

Starts are drawn evenly: angles within 0.5 rad of hanging, the cart within 0.5 m, velocities
within 1 rad/s or 1 m/s. A start is solved where the motion obeys the dynamics (gap <= 1e-8), the
controls are within their bounds, and each number of the last state (m, rad, m/s, rad/s; angles
modulo a turn) is within 0.01 of upright at rest. Unsolved starts are tried again with other seeds.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb

NEAR, GAP = 0.01, 1e-8
ATTEMPTS = 6


class Task(NamedTuple):
    """A swing-up: problem, the keyframe of hanging, the angles' goal, and the spread of starts."""

    name: str
    problem: Any
    hanging: Any
    upright: Any
    angles: tuple[bool, ...]


def tasks() -> dict[str, Task]:
    """Both swing-ups."""
    return {"cart_pole": _cart_pole(), "acrobot": _acrobot()}


def _cart_pole() -> Task:
    model = rb.load("cart_pole")

    def end(t: Any, state: Any, ctrl: Any) -> Any:
        x, angle = state.q
        return jnp.stack([x, jnp.sin(angle), 1 - jnp.cos(angle), *(0.3 * state.v)])

    C = rb.control
    problem = C.Problem(
        model, 120, 0.025, running=[C.Cost(C.Control(), 1e-3)], terminal=[C.Cost(end, 300.0)],
        bounds=(-10.0, 10.0),
    )  # fmt: skip
    return Task(
        "cart_pole", problem, model.keyframe("down").q, model.keyframe("up").q, (False, True)
    )


def _acrobot() -> Task:
    model = rb.load("acrobot")

    def end(t: Any, state: Any, ctrl: Any) -> Any:
        a, b = state.q
        return jnp.stack(
            [jnp.sin(a), 1 + jnp.cos(a), jnp.sin(b), 1 - jnp.cos(b), *(0.3 * state.v)]
        )

    C = rb.control
    problem = C.Problem(
        model, 160, 0.025, running=[C.Cost(C.Control(), 1e-3)], terminal=[C.Cost(end, 300.0)],
        bounds=(-10.0, 10.0),
    )  # fmt: skip
    return Task(
        "acrobot", problem, model.keyframe("down").q, model.keyframe("up").q, (True, True)
    )


def starts(task: Task, count: int, seed: int = 0) -> Any:
    """`State`s (count, ...) about hanging."""
    one, two = jax.random.split(jax.random.key(seed))
    q = task.hanging + jax.random.uniform(one, (count, 2), minval=-0.5, maxval=0.5)
    return rb.State(q, jax.random.uniform(two, (count, 2), minval=-1.0, maxval=1.0))


def distance(task: Task, state: Any) -> Any:
    """The largest number of a state less upright at rest."""
    off = state.q - task.upright
    turn = 2 * jnp.pi
    off = jnp.where(jnp.asarray(task.angles), off - turn * jnp.round(off / turn), off)
    return jnp.abs(jnp.concatenate([off, state.v])).max()


def solver(task: Task, method: Any, iterations: int) -> Callable:
    """(starts, seeds) -> distance from upright, gap, what the controls exceed, cost, iterations;
    each (B,)."""

    def one(state: Any, seed: Any) -> tuple:
        found = rb.control.solve(
            task.problem, state, method=method, iterations=iterations, tolerance=1e-7, seed=seed
        )
        last = jax.tree.map(lambda x: x[-1], found.states)
        low, high = task.problem.low, task.problem.high
        over = jnp.maximum(low - found.ctrls, found.ctrls - high).max()
        return distance(task, last), found.gap, over, found.cost, found.iterations

    return jax.jit(jax.vmap(one))


def run(
    task: Task, count: int, chunk: int, method: Any, iterations: int, attempts: int = ATTEMPTS
) -> dict:
    """All starts, tried up to `attempts` times: a row of figures, the failures in it."""
    begin = time.perf_counter()
    states, solve = starts(task, count), solver(task, method, iterations)
    left = np.arange(count)
    tried, best = [], np.full(count, np.inf)
    costs = np.full(count, np.nan)
    first_call = None
    for attempt in range(attempts):
        solved = []
        for at in range(0, len(left), chunk):
            some = left[at : at + chunk]
            padded = np.resize(some, chunk)  # one shape, one program
            picked = jax.tree.map(lambda x, p=padded: x[p], states)
            found = jax.block_until_ready(solve(picked, jnp.asarray(padded + count * attempt)))
            if first_call is None:
                first_call = time.perf_counter() - begin
            far, gap, over, cost, _ = (np.asarray(x)[: len(some)] for x in found)
            best[some] = np.fmin(best[some], far)
            ok = (far <= NEAR) & (gap <= GAP) & (over <= 0)
            costs[some[ok]] = cost[ok]
            solved.append(some[ok])
        done = np.concatenate(solved)
        left = np.setdiff1d(left, done)
        tried.append(int(count - len(left)))
        print(f"{task.name}: {tried[-1]} of {count} after {attempt + 1} attempts, "
              f"{time.perf_counter() - begin:.1f} s", flush=True)  # fmt: skip
        if not len(left):
            break
    q, v = np.asarray(states.q), np.asarray(states.v)
    return {
        "what": "swing-up from hanging", "task": task.name, "starts": count,
        "solved": tried[-1] / count, "after each attempt": tried,
        "seconds": time.perf_counter() - begin, "first call": first_call,
        "median cost": float(np.nanmedian(costs)),
        "failures": [
            {"q": q[i].tolist(), "v": v[i].tolist(), "nearest": float(best[i])} for i in left
        ],
    }  # fmt: skip
