"""Trajectories: states at times, the loop over fixed steps, and checks of both."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer
from rbjax.display import Display, displayed, field_rows, host, shape, value_text
from rbjax.dynamics.arguments import shape_of
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.svg import curves

#: trajectories of more numbers are not drawn in a notebook
MOST_DRAWN = 1_000_000


@displayed
class Trajectory(eqx.Module):
    """States of a motion at increasing times.

    ts: (T,) times, s.
    q, v: (T, nq) and (T, nv), or (B, T, nq) and (B, T, nv) for a batch.
    success: () or (B,), whether every value is finite.
    result: result of the diffrax solver; None for `rollout`.
    stats: counts of steps.
    x: (T, nx) or (B, T, nx), states of force elements; None if no element has a state.
    memory: (T, m) or (B, T, m), memory of the dynamics; None if it has none.
    report: (T, 2) or (B, T, 2), of the solver of a contact law: number of steps up to each time
        that did not converge, and their largest error. `simulate` gives one row, of the end. None
        if the law has no solver.
    """

    ts: jax.Array
    q: jax.Array
    v: jax.Array
    success: jax.Array
    result: Any = None
    stats: Any = None
    x: jax.Array | None = None
    memory: jax.Array | None = None
    report: jax.Array | None = None

    @property
    def unconverged(self) -> jax.Array:
        """The number () or (B,) of steps whose solver of contacts did not converge."""
        if self.report is None:
            return jnp.zeros_like(self.success, jnp.int32)
        return self.report[..., -1, 0].astype(jnp.int32)

    @property
    def worst_error(self) -> jax.Array:
        """The largest error () or (B,) of the solver of contacts in a step, in the units of its
        tolerance. `simulate` counts only steps that did not converge."""
        if self.report is None:
            return jnp.zeros_like(self.success, self.q.dtype)
        return self.report[..., -1, 1]

    def summary(self) -> str:
        """Return the outcome in a sentence: finite values, and convergence of the solver of
        contacts."""
        ok = np.atleast_1d(np.asarray(self.success))
        left = np.atleast_1d(np.asarray(self.unconverged))
        few = f"{int((~ok).sum())} of {ok.size} motions have values that are not finite"
        out = f"{float(self.ts[-1] - self.ts[0]):.4g} s: {'finite' if ok.all() else few}"
        if self.report is None:
            return out
        failed = f"did not converge in {int(left.sum())} steps of {int((left > 0).sum())} motions"
        worst = float(np.max(np.asarray(self.worst_error)))
        return (
            f"{out}; the solver of contacts {failed if left.any() else 'converged in all steps'}, "
            f"largest error {worst:.2g}"
        )

    def _display_(self) -> Display:
        ts, ok, batch = host(self.ts), host(self.success), shape(self.q)[:-2]
        title = f"Trajectory{f' [batch {batch}]' if batch else ''}: "
        title += f"{(shape(self.ts) or ('?',))[-1]} states"
        if ts is not None and ts.ndim == 1:
            title += f" from {ts[0]:.4g} to {ts[-1]:.4g} s"
        if ok is not None:
            title += ", finite" if ok.all() else f", {int((~ok).sum())} of {ok.size} not finite"
        rows = field_rows(self, ["ts", "q", "v", "x", "memory", "report", "result"])
        counts = self.stats.items() if isinstance(self.stats, dict) else ()
        rows += [(name, value_text(x)) for name, x in counts if x is not None]
        return Display(title, rows, picture=self._chart if ts is not None else None)

    def _chart(self) -> str:
        """Draw the coordinates of the first sample."""
        ts, q = host(self.ts), host(self.q, most=MOST_DRAWN)
        if ts is None or q is None or not q.size:
            return ""
        return curves(ts, q.reshape(-1, *q.shape[-2:])[0, :, :8], "q")

    def state(self, i: int) -> State:
        """Return the state at ts[i], for each sample of a batch. It has no report: the next motion
        begins its own."""
        states = State(self.q, self.v, self.x, self.memory)
        return jax.tree.map(lambda x: x[..., i, :], states)

    def __len__(self) -> int:
        return self.ts.shape[0]


def scan_steps(step: Callable[[Any, jax.Array], Any], state: Any, count: int, every: int) -> Any:
    """Run state = step(state, i) for `count` steps. Return the states after each `every` steps.
    The reverse gradient keeps these states, and computes the steps between them again."""

    def once(state: Any, i: jax.Array) -> tuple[Any, None]:
        return step(state, i), None

    def segment(state: Any, first: jax.Array) -> tuple[Any, Any]:
        if every == 1:
            state = step(state, first)
        else:
            state, _ = jax.lax.scan(jax.checkpoint(once), state, first + jnp.arange(every))
        return state, state

    return jax.lax.scan(jax.checkpoint(segment), state, jnp.arange(0, count, every))[1]


def check_save_every(where: str, save_every: Any, steps: int) -> int:
    """Return the number of steps between saved states, a divisor of the number of steps."""
    found = integer(
        where, "save_every", save_every, least=1, why=f", a divisor of the {steps} steps"
    )
    if steps % found:
        raise InputError(f"{where}: save_every is {found}, expected a divisor of the {steps} steps")
    return found


def check_times(where: str, ts: Any, dtype: Any) -> tuple[jax.Array, jax.Array]:
    """Check the times; return them and the times since the first, subtracted before rounding."""
    known = not isinstance(ts, jax.core.Tracer)
    shape_of(where, "ts", ts)
    ts = np.asarray(ts) if known else ts
    if ts.ndim != 1 or ts.shape[0] < 2:
        raise InputError(f"{where}: ts has shape {ts.shape}, expected (T,) with at least 2 times")
    if ts.dtype.kind not in "iuf":
        raise InputError(f"{where}: ts has dtype {ts.dtype}, expected times in seconds")
    elapsed = (ts - ts[0]).astype(dtype)
    if known and not (np.isfinite(elapsed).all() and (np.diff(elapsed) > 0).all()):
        raise InputError(f"{where}: ts must increase from the first to the last, and be finite")
    return jnp.asarray(ts, dtype), jnp.asarray(elapsed)


def all_finite(states: State) -> jax.Array:
    """Check that all values of a trajectory are finite, per sample."""
    finite = [jnp.isfinite(x).all((-2, -1)) for x in jax.tree.leaves(states)]
    return functools.reduce(jnp.logical_and, finite)
