"""The simulation error: sensors of simulated motions less what was recorded, with its Jacobian.

    r(p, s) = weights (reading(motion(p, start (+) s)) (-) recorded)
for all runs as one batch. p is shared; each run has its own correction s of its start where that
is sought. The Jacobian is in forward mode, every direction a sample of the batch; a direction may
hold a number of each part of a robot that moves by itself (`islands`).
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import get_lapack_funcs

from rbjax.dynamics.algorithms.manifold import integrate
from rbjax.model import State
from rbjax.rank_tolerances import rank_tolerance
from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.parameters.unknowns import Unknowns
from rbjax.sysid.simulation.islands import Directions, directions
from rbjax.sysid.simulation.programs import kept
from rbjax.sysid.simulation.runs import Run
from rbjax.sysid.simulation.segments import segments
from rbjax.sysid.simulation.setup import Grid, Path, Setup, reading
from rbjax.sysid.simulation.side_by_side import equal_parts, motion_of_parts

#: with loss="huber" residuals above this many sigma count by their size, not by its square
HUBER = 1.345
#: columns that LAPACK's QR takes at a time
BLOCK = 64


class Programs(NamedTuple):
    """What is simulated: of one run, traced, `path` (x, run) -> set-up, motion and `compared`
    (set-up, motion, run) -> residual; of a batch, compiled, `readings`, `residuals`, `slopes`. The
    slopes are those along `directions`, of the sensors that a run has; None: along each number."""

    path: Callable[[jax.Array, Run], tuple[Setup, Path]]
    compared: Callable[[Setup, Path, Run], jax.Array]
    readings: Callable[[jax.Array, Run], dict[str, jax.Array]]
    residuals: Callable[[jax.Array, Run], jax.Array]
    slopes: Callable[[jax.Array, Run], tuple[jax.Array, jax.Array]]
    directions: Callable[[frozenset[str]], Directions | None]


def programs(
    setup: Setup, unknowns: Unknowns, grid: Grid, own: int, loss: str, keep: int | None = None
) -> Programs:
    """The programs of a set-up, with `own` corrections of each run's start; keep as in `motion`."""
    n, parts = sum(unknowns.sizes), equal_parts(setup)

    def path(x: jax.Array, run: Run, count: int = 1) -> tuple[Setup, Path]:
        """The set-up with the numbers, and its motion, in so many segments side by side."""
        p, s = x[:n], x[n:]
        made = functools.partial(unknowns.write, setup)
        now = made(p)
        start = began(now, run.start, "v" in run.values)
        start = jax.tree.map(lambda a, b: jnp.where(run.exact > 0, a, b), run.start, start)
        if own:
            dq, dv = jnp.split(jnp.where(run.known > 0, 0.0, s), 2)
            start = State(integrate(setup.model, start.q, dq), start.v + dv, start.x)
        return now, motion_of_parts(
            parts, made, p, start, run.commands, grid, keep=keep, count=count
        )

    def read(now: Setup, path: Path, run: Run) -> dict[str, jax.Array]:
        return {k: reading(now, path, grid, k, run.times[k]) for k in run.values}

    def compared(now: Setup, path: Path, run: Run) -> jax.Array:
        """The residual of one run."""
        parts = []
        for kind, seen in read(now, path, run).items():
            columns = setup.columns(kind)
            off = jax.vmap(columns.minus)(seen, run.values[kind])
            weights = columns.weights(run.weights[kind])
            # a value that was not measured may have diverged
            parts.append(jnp.where(weights > 0, weights * off, 0.0).ravel())
        r = jnp.concatenate(parts)
        if loss == "huber":
            size = jnp.maximum(jnp.abs(r), HUBER)
            r = jnp.where(jnp.abs(r) < HUBER, r, jnp.sign(r) * jnp.sqrt(HUBER * (2 * size - HUBER)))
        return r

    def simulated(x: jax.Array, runs: Run) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Residuals and readings, for which one program is enough."""

        def each(x: jax.Array, run: Run) -> tuple[jax.Array, dict[str, jax.Array]]:
            now, path_ = path(x, run, count_of(runs, 1))
            return compared(now, path_, run), read(now, path_, run)

        return jax.vmap(each)(x, runs)

    def sloped(x: jax.Array, runs: Run) -> tuple[jax.Array, jax.Array]:
        some = along_which(frozenset(runs.values))
        seeds = np.eye(n + own) if some is None else some.seeds
        count = count_of(runs, len(seeds))

        def each(x: jax.Array, run: Run) -> tuple[jax.Array, jax.Array]:
            def along(e: jax.Array) -> tuple[jax.Array, jax.Array]:
                return jax.jvp(lambda x: compared(*path(x, run, count), run), (x,), (e,))

            return jax.vmap(along, out_axes=(None, 1))(jnp.asarray(seeds, x.dtype))

        return jax.vmap(each)(x, runs)

    def count_of(runs: Run, each: int) -> int:
        """Segments of the motions of runs, each along so many directions."""
        runs_, periods = runs.commands.shape[:2]
        return segments(periods, runs_ * each * len(parts or [0]))

    @functools.cache
    def along_which(sensors: frozenset[str]) -> Directions | None:
        return directions(setup, unknowns, own, sensors)

    both, along_all = jax.jit(simulated), jax.jit(sloped)

    def slopes(x: jax.Array, runs: Run) -> tuple[jax.Array, jax.Array]:
        along_which(frozenset(runs.values))  # before the trace, where it takes a tenth of the time
        found: tuple[jax.Array, jax.Array] = along_all(x, runs)
        return found

    return Programs(
        path, compared, lambda *x: both(*x)[1], lambda *x: both(*x)[0], slopes, along_which
    )


class SimulationError:
    """The residual of a batch of runs.

    x (n + runs l,) holds the numbers p of the unknowns (n,) and, where starts are sought, l = 2 nv
    corrections for each run.
    """

    def __init__(
        self, setup: Setup, unknowns: Unknowns, runs: Run, grid: Grid, *,
        starts: bool | None = None, loss: str = "squares",
    ):  # fmt: skip
        self.setup, self.unknowns, self.grid, self.loss = setup, unknowns, grid, loss
        self.count = runs.commands.shape[0]
        self.shared = sum(unknowns.sizes)
        self.all_starts = starts is True  # even initial states that the recordings give
        self.runs = self._opened(runs)
        if starts is None:
            starts = not np.asarray(runs.known).all()
        self.own = 2 * setup.model.nv if starts else 0
        self.programs: Programs = kept(programs, setup, unknowns, grid, self.own, loss)

    @property
    def size(self) -> int:
        """Numbers of x."""
        return self.shared + self.count * self.own

    def by_run(self, x: Any) -> Any:
        """x as (runs, n + l), in numpy where x is: no program to compile."""
        xp: Any = np if isinstance(x, np.ndarray) else jnp
        own = xp.reshape(x[self.shared :], (self.count, self.own))
        p = xp.broadcast_to(xp.asarray(x[: self.shared]), (self.count, self.shared))
        return xp.concatenate([p, own], -1)

    def divergence(self, x: np.ndarray, x0: np.ndarray) -> Divergence:
        """That of the unknowns, and of the starts' corrections as free numbers."""
        n = self.shared
        first = self.unknowns.divergence(x[:n], x0[:n])
        return Divergence.joined([first, Divergence.free(x[n:], x0[n:], 1.0)])

    def on(self, runs: Run) -> SimulationError:
        """The simulation error of other runs."""
        other = copy.copy(self)
        other.runs, other.count = self._opened(runs), runs.commands.shape[0]
        return other

    def _opened(self, runs: Run) -> Run:
        known = jnp.zeros_like(runs.known) if self.all_starts else runs.known
        shape = runs.commands.shape[:1]  # of a run made by hand, one number for all
        return runs._replace(
            known=jnp.broadcast_to(known, shape), exact=jnp.broadcast_to(runs.exact, shape)
        )

    def readings(self, x: np.ndarray) -> dict[str, jax.Array]:
        """By sensor (runs, T, n)."""
        return self.programs.readings(self.by_run(x), self.runs)

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """(runs, rows)"""
        return np.asarray(self.programs.residuals(self.by_run(x), self.runs))

    def cost(self, x: np.ndarray) -> float:
        """|r|^2."""
        return sum_of_squares(self.residuals(x))

    @property
    def directions(self) -> Directions | None:
        """Those of the programs' slopes."""
        return self.programs.directions(frozenset(self.runs.values))

    def slopes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """r (runs, rows) and J (runs, rows, n + l), the sensors' rows in the order of their
        names."""
        r, J = map(np.asarray, self.programs.slopes(self.by_run(x), self.runs))
        some = self.directions
        return r, J if some is None else some.whole(J, self._times)

    @property
    def _times(self) -> dict[str, int]:
        """How many times each sensor is read."""
        return {k: values.shape[1] for k, values in self.runs.values.items()}

    def unmoved(self, x: np.ndarray) -> tuple[str, ...]:
        """The sensors that no unknown moves."""
        J = np.abs(self.slopes(x)[1][:, :, : self.shared])
        found, at = [], 0
        for sensor in sorted(self.runs.values):
            T, n = self.runs.values[sensor].shape[1:]
            rows = T * (n - len(self.setup.columns(sensor).turns))
            least = rank_tolerance("unknown without effect", J.dtype) * J.max()
            if not J[:, at : at + rows].max() > least:
                found.append(sensor)
            at += rows
        return tuple(found)

    def triangle(self, x: np.ndarray) -> np.ndarray:
        """R (size + 1, size + 1) with R^T R = [J r]^T [J r]."""
        return self.assembled(*self.programs.slopes(self.by_run(x), self.runs))

    def assembled(self, r: Any, J: Any) -> np.ndarray:
        """R of the residuals (runs, rows) and their slopes along the programs' directions."""
        n, some = self.shared + self.own, self.directions
        both = np.concatenate([np.asarray(J), np.asarray(r)[..., None]], -1)
        parts: list[tuple[Any, np.ndarray]] = [(slice(None), np.arange(n))]
        weights = np.eye(n)
        if some is not None:
            parts, weights = some.parts(self._times), some.weights
        blocks = []
        for rows, which in parts:  # a run's own numbers must not be mixed with another's
            by = weights[:, which]
            used = np.flatnonzero(by.any(1))
            each_run: Any = range(self.count) if self.own else [slice(None)]
            for k in each_run:
                # `take` copies several times faster than an index does
                those = both[k] if isinstance(rows, slice) else np.take(both[k], rows, -2)
                if len(used) < len(weights):
                    those = np.take(those, np.append(used, len(weights)), -1)
                R = triangle_of(those.reshape(-1, those.shape[-1]))
                wide = np.zeros((R.shape[0], n + 1), R.dtype)
                wide[:, which], wide[:, -1] = R[:, :-1] @ by[used], R[:, -1]
                blocks.append(self.widened(wide, k) if self.own else wide)
        one = len(blocks) == 1 and len(blocks[0]) == self.size + 1
        return blocks[0] if one else triangle_of(np.concatenate(blocks))

    def widened(self, rows: np.ndarray, k: int) -> np.ndarray:
        """Rows [J r] of run k by its own numbers, as rows by all of x."""
        p, l = self.shared, self.own
        wide = np.zeros((rows.shape[0], self.size + 1), rows.dtype)
        wide[:, :p], wide[:, -1] = rows[:, :p], rows[:, -1]
        wide[:, p + k * l : p + (k + 1) * l] = rows[:, p:-1]
        return wide


def began(setup: Setup, first: State, v_was_read: bool) -> State:
    """The state of which the first readings are; a v that was not read is the slope of q's."""
    q, v = setup.sensors["q"], setup.sensors["v"]
    speed = first.v
    if v_was_read:
        speed = (first.v - v.bias) / v.scale
    elif first.v.shape == q.scale.shape:  # with attitudes v is read, or the state is known
        speed = first.v / q.scale
    return State((first.q - q.bias) / q.scale, speed, first.x)


def sum_of_squares(r: np.ndarray) -> float:
    """|r|^2, inf where it is not finite: a motion that went to infinity."""
    r = np.asarray(r).ravel()
    with np.errstate(over="ignore"):
        total = float(r @ r)
    return total if np.isfinite(total) else np.inf


def triangle_of(rows: np.ndarray) -> np.ndarray:
    """R of rows [J r], nan where one is not finite."""
    n = rows.shape[1]
    if not np.isfinite(rows).all():
        return np.full((n, n), np.nan, rows.dtype)
    (factorised,) = get_lapack_funcs(("geqrf",), (rows,))
    # LAPACK's columns and block size: half of the time of `np.linalg.qr`
    columns, _, _, _ = factorised(np.array(rows, order="F"), lwork=BLOCK * n, overwrite_a=True)
    R: Any = np.triu(columns[:n])
    missing = n - R.shape[0]
    return R if missing <= 0 else np.pad(R, ((0, missing), (0, 0)))
