"""Swing-up of the cart-pole and the acrobot from hanging, for many starts, controls in bounds.

Starts are drawn evenly: angles within 0.5 rad of hanging, the cart within 0.5 m, velocities
within 1 rad/s or 1 m/s. A start is solved where the motion obeys the dynamics (gap <= 1e-8), the
controls are within their bounds (10 N, 10 N m), and each number of the last state (m, rad, m/s,
rad/s; angles modulo a turn) is within 0.01 of upright at rest.

A try is 20 rounds of 512 MPPI samples from the start, and DDP from there. Starts that are left are
tried again with other seeds, up to 8 times; where fewer are left than are solved side by side, each
is tried with several seeds at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb

NEAR, GAP, GAP_F32 = 0.01, 1e-8, 1e-4
ATTEMPTS = 8
ITERATIONS = 300  # of DDP
C = rb.control
METHOD = C.Sampling("mppi", samples=512, points=12, cooling=0.93, ddp_after=20)
COLUMNS = ("what", "task", "precision", "starts", "solved", "after each attempt", "median cost")
COLUMNS += ("seconds", "first call")


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
        return jnp.stack([jnp.sin(a), 1 + jnp.cos(a), jnp.sin(b), 1 - jnp.cos(b), *(0.3 * state.v)])

    problem = C.Problem(
        model, 200, 0.025, running=[C.Cost(C.Control(), 1e-3)], terminal=[C.Cost(end, 300.0)],
        bounds=(-10.0, 10.0),
    )  # fmt: skip
    return Task("acrobot", problem, model.keyframe("down").q, model.keyframe("up").q, (True, True))


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


def solver(task: Task) -> Callable:
    """(starts, seeds) -> distance from upright, gap, what the controls exceed, cost, iterations;
    each (B,)."""

    def one(state: Any, seed: Any) -> tuple:
        found = rb.control.solve(
            task.problem, state, method=METHOD, iterations=ITERATIONS, tolerance=1e-7, seed=seed
        )
        last = jax.tree.map(lambda x: x[-1], found.states)
        low, high = task.problem.low, task.problem.high
        over = jnp.maximum(low - found.ctrl, found.ctrl - high).max()
        return distance(task, last), found.gap, over, found.cost, found.iterations

    return jax.jit(jax.vmap(one))


def run(task: Task, count: int, chunk: int, attempts: int = ATTEMPTS) -> dict:
    """All starts, tried up to `attempts` times: a row of figures, the failures in it."""
    begin = time.perf_counter()
    states, solve = starts(task, count), solver(task)
    left = np.arange(count)
    tried, best = [], np.full(count, np.inf)
    costs = np.full(count, np.nan)
    first_call, seed = None, 0
    gap_held = GAP if states.q.dtype == jnp.float64 else GAP_F32
    for attempt in range(attempts):
        # whole chunks, one program: where few are left, each is tried with several seeds
        tries = np.resize(left, -(-len(left) // chunk) * chunk)
        solved = np.zeros(count, bool)
        for at in range(0, len(tries), chunk):
            some = tries[at : at + chunk]
            picked = jax.tree.map(lambda x, some=some: x[some], states)
            found = jax.block_until_ready(solve(picked, jnp.asarray(seed + np.arange(chunk))))
            seed += chunk
            if first_call is None:
                first_call = time.perf_counter() - begin
            far, gap, over, cost, _ = (np.asarray(x) for x in found)
            np.fmin.at(best, some, far)
            ok = (far <= NEAR) & (gap <= gap_held) & (over <= 0)
            np.fmin.at(costs, some[ok], cost[ok])
            solved[some[ok]] = True
        left = left[~solved[left]]
        tried.append(int(count - len(left)))
        print(f"{task.name}: {tried[-1]} of {count} after {attempt + 1} attempts, "
              f"{time.perf_counter() - begin:.1f} s", flush=True)  # fmt: skip
        if not len(left):
            break
    q, v = np.asarray(states.q), np.asarray(states.v)
    return {
        "what": "swing-up from hanging", "task": task.name,
        "precision": str(states.q.dtype), "starts": count,
        "solved": tried[-1] / count, "after each attempt": tried,
        "seconds": time.perf_counter() - begin, "first call": first_call,
        "median cost": float(np.nanmedian(costs)),
        "failures": [
            {"q": q[i].tolist(), "v": v[i].tolist(), "nearest": float(best[i])} for i in left
        ],
    }  # fmt: skip
