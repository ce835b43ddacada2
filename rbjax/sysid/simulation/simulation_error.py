"""The simulation error: readings of simulated motions minus recorded values, with its Jacobian.

    r(p, s) = weights (reading(motion(p, start (+) s)) (-) recorded)
All runs are one batch. The unknowns p are common to all runs. Each run has a correction s of its
initial state, if that is estimated. The Jacobian is computed in forward mode, with one sample of
the batch for each direction (`jacobian_colouring`).
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.algorithms.manifold import integrate
from rbjax.errors import InputError
from rbjax.lanes.arrays import select
from rbjax.model import State
from rbjax.rank_tolerances import rank_tolerance
from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation.equal_parts import equal_parts, simulate_parts
from rbjax.sysid.simulation.jacobian_colouring import ALL, Colouring, colour_jacobian
from rbjax.sysid.simulation.parallel_in_time import count_windows
from rbjax.sysid.simulation.programs import get_cached
from rbjax.sysid.simulation.runs import Run
from rbjax.sysid.simulation.setup import Grid, Setup, SimulatedPath, read_sensor
from rbjax.sysid.statistics.fit_statistics import FitColumn, FitRows
from rbjax.sysid.statistics.rank import triangle_of

#: with loss="huber", the cost grows linearly above this residual in sigma
HUBER = 1.345


class Programs(NamedTuple):
    """The programs of a set-up.

    Fields:
        simulate: (x, run) -> set-up and motion of one run, traced.
        compare: (set-up, motion, run) -> residual of one run, traced.
        readings: compiled readings of a batch, by sensor.
        residuals: compiled residuals of a batch.
        slopes: compiled residuals of a batch, and derivatives along the seeds of `colour`, or along
            each unknown.
        colour: sensors of the runs -> `Colouring`, or None.
    """

    simulate: Callable[[jax.Array, Run], tuple[Setup, SimulatedPath]]
    compare: Callable[[Setup, SimulatedPath, Run], jax.Array]
    readings: Callable[[jax.Array, Run], dict[str, jax.Array]]
    residuals: Callable[[jax.Array, Run], jax.Array]
    slopes: Callable[[jax.Array, Run], tuple[jax.Array, jax.Array]]
    colour: Callable[[frozenset[str]], Colouring | None]


def make_programs(
    setup: Setup, unknowns: Unknowns, grid: Grid, own: int, loss: str, keep: int | None = None
) -> Programs:
    """Create the programs of a set-up with `own` corrections of each initial state.

    `keep` is the argument of `simulate_motion`.
    """
    n, parts = sum(unknowns.sizes), equal_parts(setup)

    def simulate(x: jax.Array, run: Run, count: int = 1) -> tuple[Setup, SimulatedPath]:
        p, s = x[:n], x[n:]
        made = functools.partial(unknowns.write, setup)
        now = made(p)
        start = state_of_readings(now, run.start, "v" in run.values)
        start = select(run.exact > 0, run.start, start)
        if own:
            dq, dv = jnp.split(jnp.where(run.known > 0, 0.0, s), 2)
            start = State(integrate(setup.model, start.q, dq), start.v + dv, start.x)
        path = simulate_parts(parts, made, p, start, run.commands, grid, keep=keep, count=count)
        return now, path

    def read(now: Setup, path: SimulatedPath, run: Run) -> dict[str, jax.Array]:
        return {k: read_sensor(now, path, grid, k, run.times[k]) for k in run.values}

    def compare(now: Setup, path: SimulatedPath, run: Run) -> jax.Array:
        parts = []
        for kind, seen in read(now, path, run).items():
            columns = setup.columns(kind)
            off = jax.vmap(columns.minus)(seen, run.values[kind])
            weights = columns.weights(run.weights[kind])
            # the simulation of a missing value may have diverged
            parts.append(jnp.where(weights > 0, weights * off, 0.0).ravel())
        r = jnp.concatenate(parts)
        if loss == "huber":
            size = jnp.maximum(jnp.abs(r), HUBER)
            r = jnp.where(jnp.abs(r) < HUBER, r, jnp.sign(r) * jnp.sqrt(HUBER * (2 * size - HUBER)))
        return r

    def simulated(x: jax.Array, runs: Run) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Compute residuals and readings in one program."""

        def each(x: jax.Array, run: Run) -> tuple[jax.Array, dict[str, jax.Array]]:
            now, path = simulate(x, run, windows_of(runs, 1))
            return compare(now, path, run), read(now, path, run)

        return jax.vmap(each)(x, runs)

    def sloped(x: jax.Array, runs: Run) -> tuple[jax.Array, jax.Array]:
        coloured = colour(frozenset(runs.values))
        seeds = np.eye(n + own) if coloured is None else coloured.seeds
        count = windows_of(runs, len(seeds))

        def each(x: jax.Array, run: Run) -> tuple[jax.Array, jax.Array]:
            def along(e: jax.Array) -> tuple[jax.Array, jax.Array]:
                return jax.jvp(lambda x: compare(*simulate(x, run, count), run), (x,), (e,))

            found, slopes = jax.vmap(along, out_axes=(0, 1))(jnp.asarray(seeds, x.dtype))
            return found[0], slopes  # the residuals are those of any direction

        return jax.vmap(each)(x, runs)

    def windows_of(runs: Run, directions: int) -> int:
        batch, periods = runs.commands.shape[:2]
        return count_windows(periods, batch * directions * len(parts or [0]))

    @functools.cache
    def colour(sensors: frozenset[str]) -> Colouring | None:
        return colour_jacobian(setup, unknowns, own, sensors)

    both, along_all = jax.jit(simulated), jax.jit(sloped)

    def slopes(x: jax.Array, runs: Run) -> Any:
        colour(frozenset(runs.values))  # ten times slower during a trace
        return along_all(x, runs)

    return Programs(
        simulate, compare, lambda *x: both(*x)[1], lambda *x: both(*x)[0], slopes, colour
    )


class SimulationError:
    """The residual of a batch of runs as a function of x.

    x (n + runs l,) contains the unknowns p (n,) and l corrections of each initial state. l is 2 nv,
    or 0 if initial states are not estimated.

    With a `difference_step` h the slopes are central differences. The steps have the length h in
    the metric of the divergence: h times a positive parameter.
    """

    def __init__(
        self, setup: Setup, unknowns: Unknowns, runs: Run, grid: Grid, *,
        estimate_initial_state: bool | None = None, loss: str = "squares",
        difference_step: float | None = None,
    ):  # fmt: skip
        self.setup, self.unknowns, self.grid, self.loss = setup, unknowns, grid, loss
        self.difference_step = difference_step
        self.count = runs.commands.shape[0]
        self.shared = sum(unknowns.sizes)
        self.all_starts = estimate_initial_state is True  # also the known initial states
        self.runs = self._mark_known(runs)
        if estimate_initial_state is None:
            estimate_initial_state = not np.asarray(runs.known).all()
        self.own = 2 * setup.model.nv if estimate_initial_state else 0
        if self.own and difference_step is not None:
            raise InputError(
                "identify: difference_step with initial states that are estimated, expected known "
                "ones; give estimate_initial_state=False, or the first q and v of recordings"
            )
        self.programs: Programs = get_cached(make_programs, setup, unknowns, grid, self.own, loss)
        self._last: tuple[np.ndarray, Any] | None = None

    @property
    def size(self) -> int:
        """The number of entries of x."""
        return self.shared + self.count * self.own

    @property
    def samples(self) -> int:
        """The number of residuals with a nonzero weight. An attitude has three."""
        weights = jax.tree.map(np.asarray, self.runs.weights)
        return sum(int((self.setup.columns(s).weights(w) > 0).sum()) for s, w in weights.items())

    def by_run(self, x: Any) -> Any:
        """Arrange x as (runs, n + l), in numpy if x is a numpy array, which avoids compilation."""
        xp: Any = np if isinstance(x, np.ndarray) else jnp
        own = xp.reshape(x[self.shared :], (self.count, self.own))
        p = xp.broadcast_to(xp.asarray(x[: self.shared]), (self.count, self.shared))
        return xp.concatenate([p, own], -1)

    def divergence(self, x: np.ndarray, x0: np.ndarray) -> Divergence:
        """Compute the divergence of the unknowns, with the corrections as free parameters."""
        n = self.shared
        first = self.unknowns.divergence(x[:n], x0[:n])
        return Divergence.joined([first, Divergence.free(x[n:], x0[n:], 1.0)])

    def on(self, runs: Run) -> SimulationError:
        """Return the simulation error of other runs, with the same programs."""
        other = copy.copy(self)
        other.runs, other.count, other._last = self._mark_known(runs), runs.commands.shape[0], None
        return other

    def _mark_known(self, runs: Run) -> Run:
        known = jnp.zeros_like(runs.known) if self.all_starts else runs.known
        shape = runs.commands.shape[:1]  # a manually created batch may have one number for all
        return runs._replace(
            known=jnp.broadcast_to(known, shape), exact=jnp.broadcast_to(runs.exact, shape)
        )

    def readings(self, x: np.ndarray) -> dict[str, jax.Array]:
        """Compute the simulated readings (runs, T, n), by sensor."""
        return self.programs.readings(self.by_run(x), self.runs)

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Compute the residuals r (runs, rows)."""
        return np.asarray(self.programs.residuals(self.by_run(x), self.runs))

    def cost(self, x: np.ndarray) -> float:
        """Compute the sum of squared residuals, including the normal priors."""
        priors = self.unknowns.prior_rows(x[: self.shared])[:, -1]
        return sum_of_squares(self.residuals(x)) + float(priors @ priors)

    @property
    def colouring(self) -> Colouring | None:
        """The colouring of the Jacobian. Differences are along each unknown."""
        if self.difference_step is not None:
            return None
        return self.programs.colour(frozenset(self.runs.values))

    def _seeded_slopes(self, x: np.ndarray) -> Any:
        """Compute r (runs, rows) and its derivatives along the seeds of `colouring`.

        The last result is cached: the statistics of a fit use the derivatives of its last step.
        """
        if self._last is None or not np.array_equal(self._last[0], x):
            if self.difference_step is None:
                found: Any = self.programs.slopes(self.by_run(x), self.runs)
            else:
                found = self._differences(x, self.difference_step)
            self._last = np.array(x), jax.tree.map(np.asarray, found)
        return self._last[1]

    def _differences(self, x: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
        """Compute the residuals r (runs, rows) and their central differences (runs, rows, n)."""
        moves = self.divergence(x, x).moves(h)
        columns = [(self.residuals(x + d) - self.residuals(x - d)) / (2 * d.sum()) for d in moves]
        return self.residuals(x), np.stack(columns, -1)

    def slopes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the residuals r (runs, rows) and the Jacobian J (runs, rows, n + l), by sorted
        sensors."""
        r, J = self._seeded_slopes(x)
        coloured = self.colouring
        return r, J if coloured is None else coloured.expand(J, self._times)

    @property
    def _times(self) -> dict[str, int]:
        """The number of samples of each sensor."""
        return {k: values.shape[1] for k, values in self.runs.values.items()}

    def rows_of(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Split residuals (runs, rows, ...) by sensor into (runs, samples, columns, ...)."""
        found, at = {}, 0
        for sensor in sorted(self.runs.values):
            T, n = self.runs.values[sensor].shape[1:]
            d = n - len(self.setup.columns(sensor).turns)  # a quaternion has three residuals
            found[sensor] = rows[:, at : at + T * d].reshape(len(rows), T, d, *rows.shape[2:])
            at += T * d
        return found

    def insensitive(self, x: np.ndarray) -> tuple[str, ...]:
        """Find the sensors with readings that depend on no unknown."""
        J = np.abs(self.slopes(x)[1][:, :, : self.shared])
        least = rank_tolerance("unknown without effect", J.dtype) * J.max()
        return tuple(s for s, rows in self.rows_of(J).items() if not rows.max() > least)

    def columns(self, x: np.ndarray, stated: Collection[str]) -> list[FitColumn]:
        """Compute residuals and Jacobian at x by column, as input of `fit_statistics`.

        `stated` are the sensors with stated noise.
        """
        residuals, slopes = map(self.rows_of, self._seeded_slopes(x))
        bases, n, l = self._bases(), self.shared, self.own
        which = [np.r_[0:n, n + k * l : n + (k + 1) * l] for k in range(self.count)]
        clocks = {s: np.asarray(t) for s, t in self.runs.times.items()}
        step = min(_median_step(t) for t in clocks.values())
        found = []
        for sensor, r in residuals.items():
            weights: Any = np.asarray(self.runs.weights[sensor])
            measured = np.asarray(self.setup.columns(sensor).weights(weights)) > 0
            place = np.rint(clocks[sensor] / step).astype(int)
            for c in range(r.shape[2]):
                runs = []
                for k in range(self.count):
                    # a slice does not copy the derivatives
                    rows = slice(None) if measured[k, :, c].all() else measured[k, :, c]
                    off, J = r[k, rows, c], slopes[sensor][k, rows, c]
                    psi, inside = off, np.ones(len(off), bool)
                    if self.loss == "huber":  # a large residual is sign sqrt(2 rho)
                        inside = np.abs(off) < HUBER
                        psi = np.where(inside, off, HUBER * np.sign(off))
                        J = J * np.where(inside, 1.0, np.abs(off) / HUBER)[:, None]
                    runs.append(FitRows(J, psi, inside, place[k][rows], which[k], bases[sensor][c]))
                if any(len(rows.psi) for rows in runs):
                    found.append(FitColumn(f"{sensor}[{c}]", runs, sensor in stated))
        priors, none = self.unknowns.prior_rows(x[:n]), np.zeros(0, int)
        if len(priors):
            J, ones = np.pad(priors[:, :n], ((0, 0), (0, l))), np.ones(len(priors))
            rest = [FitRows(J[:0], none, none, none, at) for at in which[1:]]
            first = FitRows(J, priors[:, -1], ones, np.arange(len(priors)), which[0])
            found.append(FitColumn("prior", [first, *rest], True))
        return found

    def _bases(self) -> dict[str, list[np.ndarray | None]]:
        """Return the matrix from derivatives along the seeds to derivatives by x, by sensor and
        column. Equal matrices are one object."""
        coloured = self.colouring
        found: dict[str, list[np.ndarray | None]] = {}
        by_part: dict[int, np.ndarray] = {}
        for sensor, values in self.runs.values.items():
            size = values.shape[-1]
            found[sensor] = [None] * size
            if coloured is not None:
                parts = [ALL] * size
                if coloured.part_of_column is not None:
                    parts = [int(part) for part in coloured.part_of_column[sensor]]
                for part in parts:
                    by_part.setdefault(part, coloured.basis(part))
                found[sensor] = [by_part[part] for part in parts]
        return found

    def triangle(self, x: np.ndarray) -> np.ndarray:
        """Compute R (size + 1, size + 1) with R^T R = [J r]^T [J r], including the priors."""
        R, n = self.assemble(*self._seeded_slopes(x)), self.shared
        priors = self.unknowns.prior_rows(x[:n])
        if not len(priors):
            return R
        wide = np.zeros((len(priors), self.size + 1))
        wide[:, :n], wide[:, -1] = priors[:, :n], priors[:, -1]
        return triangle_of(np.concatenate([R, wide]))

    def assemble(self, r: Any, J: Any) -> np.ndarray:
        """Compute R with R^T R = [J r]^T [J r] from the residuals r (runs, rows) and their
        derivatives J along the seeds of `colouring`."""
        n, coloured = self.shared + self.own, self.colouring
        both = np.concatenate([np.asarray(J), np.asarray(r)[..., None]], -1)
        parts: list[tuple[Any, np.ndarray]] = [(slice(None), np.arange(n))]
        weights = np.eye(n)
        if coloured is not None:
            parts, weights = coloured.blocks(self._times), coloured.weights
        blocks = []
        for rows, which in parts:
            by = weights[:, which]
            used = np.flatnonzero(by.any(1))
            each_run: Any = range(self.count) if self.own else [slice(None)]
            for k in each_run:  # corrections of different runs have different columns
                # `take` copies several times faster than indexing
                those = both[k] if isinstance(rows, slice) else np.take(both[k], rows, -2)
                if len(used) < len(weights):
                    those = np.take(those, np.append(used, len(weights)), -1)
                R = triangle_of(those.reshape(-1, those.shape[-1]))
                wide = np.zeros((R.shape[0], n + 1), R.dtype)
                wide[:, which], wide[:, -1] = R[:, :-1] @ by[used], R[:, -1]
                blocks.append(self.widen(wide, k) if self.own else wide)
        one = len(blocks) == 1 and len(blocks[0]) == self.size + 1
        return blocks[0] if one else triangle_of(np.concatenate(blocks))

    def widen(self, rows: np.ndarray, k: int) -> np.ndarray:
        """Expand the columns of rows [J r] of run k to all unknowns and all corrections of x.
        Columns of the corrections of other runs are zero."""
        p, l = self.shared, self.own
        wide = np.zeros((rows.shape[0], self.size + 1), rows.dtype)
        wide[:, :p], wide[:, -1] = rows[:, :p], rows[:, -1]
        wide[:, p + k * l : p + (k + 1) * l] = rows[:, p:-1]
        return wide


def state_of_readings(setup: Setup, first: State, v_was_read: bool) -> State:
    """Compute the state from its readings. Without a channel v, first.v is the slope of q."""
    q, v = setup.sensors["q"], setup.sensors["v"]
    speed = first.v
    if v_was_read:
        speed = (first.v - v.bias) / v.scale
    elif first.v.shape == q.scale.shape:  # with attitudes v is measured, or the state is known
        speed = first.v / q.scale
    return State((first.q - q.bias) / q.scale, speed, first.x)


def sum_of_squares(r: np.ndarray) -> float:
    """Compute |r|^2, or inf if it is not finite, as for a motion that diverges."""
    r = np.asarray(r).ravel()
    with np.errstate(over="ignore"):
        total = float(r @ r)
    return total if np.isfinite(total) else np.inf


def _median_step(times: np.ndarray) -> float:
    """Compute the median step of clocks (runs, T), which are padded with their last time."""
    steps = np.diff(times, axis=-1)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else np.inf
