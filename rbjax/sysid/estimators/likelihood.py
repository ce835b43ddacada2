"""Likelihood of recordings of a motion with process noise, with gradient and information.

    l(p) = sum over samples of  z^T S^-1 z + log det 2 pi S         (twice the negative logarithm)
z are the innovations of an extended Kalman filter (`rb.estimation`), and S their covariance.
With S = L L^T, l has the gradient and Fisher information of a least-squares problem with the rows

    J = [L^-1 dz;  L^-1 dS L^-T / sqrt 2],      r = [L^-1 z;  (1 - L^-1 z z^T L^-T) / sqrt 2],
    dl = 2 J^T r,    F = J^T J
Thus a Gauss-Newton method is Fisher scoring. Ljung, *System Identification*, 2nd ed., 7.4; Astrom,
Automatica 16(5), 1980; Gupta & Mehra, IEEE T-AC 19(6), 1974 (scoring).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular

from rbjax.dynamics.algorithms.manifold import difference
from rbjax.errors import InputError
from rbjax.estimation.kalman import KalmanFiltered, kalman_filter
from rbjax.estimation.state_space import StateSpace
from rbjax.forces.inputs import Inputs
from rbjax.model import State
from rbjax.motion.field import Field, dynamics_of, free_motion
from rbjax.motion.integrators import advance_state, integrator_of
from rbjax.motion.linearise import box_minus, box_plus
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation.runs import make_run
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import state_of_readings
from rbjax.sysid.statistics.fit_statistics import FitColumn, FitRows
from rbjax.sysid.statistics.rank import triangle_of

#: largest allowed distance of a sample from an instant of the grid, in periods
OFF = 1e-2
DRIVES = ("torque", "acceleration")


class Series(NamedTuple):
    """One run, or a batch of runs, at the instants of a grid.

    Fields:
        start: first readings as a state.
        speed: (nv,) standard deviation of the first velocity if it was not measured.
        commands: (N, n) commands.
        readings: "q" (N + 1, nq) and optional "v" (N + 1, nv).
        arrived: (N + 1, rows) mask of the readings that are not missing.
    """

    start: State
    speed: jax.Array
    commands: jax.Array
    readings: dict[str, Any]
    arrived: Any


class NoiseLevels(NamedTuple):
    """Standard deviations of process and measurement noise.

    Fields:
        drive: (nv,) torque in N m, or acceleration in rad/s^2, constant over a period.
        reading: (rows,) readings of the sensors, in rad and rad/s.
    """

    drive: Any
    reading: Any


class Likelihood:
    """Twice the negative log likelihood l(x) of a batch of runs.

    x (n + levels,) contains the unknowns and the logarithms of the unknown noise levels. The masks
    `drives` (nv,) and `reads` (rows,) are True for process noise and for sensor noise of unknown
    level.
    """

    def __init__(
        self, setup: Setup, unknowns: Unknowns, series: Series, grid: Grid, *, levels: NoiseLevels,
        drives: np.ndarray, reads: np.ndarray, drive: str = "torque",
    ):  # fmt: skip
        self.unknowns, self.series = unknowns, series
        self.shared = n = sum(unknowns.sizes)
        self.drives, self.reads = (np.flatnonzero(x) for x in (drives, reads))
        self.size = n + self.drives.size + self.reads.size
        self.levels = levels
        at, model = "prediction_error", setup.model
        dynamics = dynamics_of(at, model, free_motion, None)
        integrator = integrator_of(at, grid.integrator_of(model), dynamics, model)

        def space(now: Setup) -> StateSpace:
            model, T, count = now.model, grid.period, grid.substeps

            def read(x: State) -> State:
                q, v = now.sensors["q"], now.sensors["v"]
                return State(q.scale * x.q + q.bias, v.scale * x.v + v.bias)

            def move(x: State, u: Any, w: jax.Array) -> State:
                t, ctrl = u
                if now.controller is not None:
                    ctrl = now.controller(t, read(x), ctrl)
                h = jnp.asarray(T / count, x.q.dtype)
                inputs = Inputs(ctrl, w if drive == "torque" else None)

                def once(i: Any, x: State) -> State:
                    return advance_state(
                        integrator, Field(model, dynamics, h), t + i * h, x, inputs, h
                    )

                # a loop of constant length is differentiable in both modes
                x = once(0, x)
                if count > 1:
                    x = jax.lax.scan(lambda x, i: (once(i, x), None), x, jnp.arange(1, count))[0]
                if drive == "torque":
                    return x
                still = jnp.zeros(model.nx, w.dtype)
                return box_plus(model, x, jnp.concatenate([w * T**2 / 2, w * T, still]))

            def innovation(x: State, y: dict[str, Any]) -> jax.Array:
                seen = read(x)
                rows = [difference(model, seen.q, y["q"])]
                return jnp.concatenate([*rows, y["v"] - seen.v] if "v" in y else rows)

            return StateSpace(
                move,
                innovation,
                functools.partial(box_plus, model),
                functools.partial(box_minus, model),
            )

        def filtered(x: jax.Array, s: Series) -> KalmanFiltered:
            now, level, nv = unknowns.write(setup, x[:n]), self.levels_of(x), setup.model.nv
            R = level.reading**2
            start = state_of_readings(now, s.start, "v" in s.readings)
            hinges = setup.model.nq == nv
            P = [R[:nv] / now.sensors["q"].scale ** 2 if hinges else R[:nv], s.speed**2]
            if "v" in s.readings:
                read = s.arrived[0, nv:]
                P[1] = jnp.where(read, R[nv:] / now.sensors["v"].scale ** 2, P[1])
            P.append(jnp.zeros(setup.model.nx, R.dtype))
            # the first readings define the initial state, and are not used again
            there = s.arrived.at[0].set(False)
            times = grid.period * jnp.arange(s.commands.shape[0])
            inputs = (times.astype(R.dtype), s.commands)
            return kalman_filter(
                space(now), start, jnp.concatenate(P), inputs, s.readings, level.drive**2, R,
                arrived=there,
            )  # fmt: skip

        def rows(x: jax.Array, s: Series) -> tuple[jax.Array, jax.Array]:
            def pair(x: jax.Array) -> tuple[jax.Array, jax.Array]:
                f = filtered(x, s)
                return f.innovation, f.innovation_covariance

            def along(e: jax.Array) -> tuple[Any, Any]:
                return jax.jvp(pair, (x,), (e,))

            (z, S), slopes = jax.vmap(along, out_axes=(None, 0))(jnp.eye(x.size, dtype=x.dtype))
            found = jax.vmap(_score_rows, (0, 0, 1, 1))(z, S, *slopes)
            return tuple(a.reshape(-1, *a.shape[2:]) for a in found)  # type: ignore[return-value]

        def value(x: jax.Array, s: Series) -> jax.Array:
            return -2 * filtered(x, s).log_likelihood

        self.space, self.value, self.rows = space, value, rows  # traced functions of one run
        self._filtered = jax.jit(jax.vmap(filtered, (None, 0)))
        self._values = jax.jit(jax.vmap(value, (None, 0)))
        self._rows = jax.jit(jax.vmap(rows, (None, 0)))

    def levels_of(self, x: Any) -> NoiseLevels:
        """Compute the noise levels at x."""
        n, k = self.shared, self.drives.size
        drive, reading = (jnp.asarray(a) for a in self.levels)
        return NoiseLevels(
            drive.at[self.drives].set(jnp.exp(x[n : n + k])),
            reading.at[self.reads].set(jnp.exp(x[n + k :])),
        )

    def cost(self, x: np.ndarray) -> float:
        """Compute l, twice the negative log likelihood, or inf if it is not finite."""
        found = float(np.sum(self._values(jnp.asarray(x), self.series)))
        return found if np.isfinite(found) else np.inf

    def triangle(self, x: np.ndarray) -> np.ndarray:
        """Compute R (size + 1, size + 1) with R^T R = [J r]^T [J r]."""
        J, r = (np.asarray(a) for a in self._rows(jnp.asarray(x), self.series))
        return triangle_of(np.concatenate([J.reshape(-1, self.size), r.reshape(-1, 1)], 1))

    def columns(self, x: np.ndarray, scale: np.ndarray) -> list[FitColumn]:
        """Compute the rows of the score by column, as input of `fit_statistics`.

        x is in units of `scale`. The equal rows (i, j) and (j, i) of the covariance are merged into
        one row.
        """
        J, r = (np.asarray(a) for a in self._rows(jnp.asarray(x), self.series))
        runs = J.shape[0]
        arrived = np.array(self.series.arrived)
        arrived[:, 0] = False  # the initial state
        times, m = arrived.shape[1:]
        J, r = J.reshape(runs, times, -1, self.size) / scale, r.reshape(runs, times, -1)
        place, which = np.arange(times), np.arange(self.size)
        found = []

        def rows(k: int, c: int, double: float, at: np.ndarray) -> FitRows:
            ones = np.ones(int(at.sum()))
            return FitRows(double * J[k, at, c], double * r[k, at, c], ones, place[at], which)

        for c in range(m + m * m):
            i, j = divmod(c - m, m) if c >= m else (c, c)
            if i > j:
                continue
            double = np.sqrt(2.0) if i < j else 1.0
            both = arrived[:, :, i] & arrived[:, :, j]
            found.append(FitColumn(
                f"row {i}" if c < m else f"variance {i},{j}",
                [rows(k, c, double, both[k]) for k in range(runs)], True,
            ))  # fmt: skip
        return found

    def filtered(self, x: np.ndarray, series: Series | None = None) -> KalmanFiltered:
        """Run the Kalman filter on each run."""
        return self._filtered(jnp.asarray(x), self.series if series is None else series)

    def divergence(self, x: np.ndarray, x0: np.ndarray) -> Divergence:
        """Compute the divergence of the unknowns, with the logarithms as free parameters."""
        n = self.shared
        first = self.unknowns.divergence(x[:n], x0[:n])
        return Divergence.joined([first, Divergence.free(x[n:], x0[n:], 1.0)])


def _score_rows(
    z: jax.Array, S: jax.Array, dz: jax.Array, dS: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Compute the rows J (m + m m, n) and r (m + m m,) of one sample.

    z, S: innovation (m,) and its covariance. dz, dS: their derivatives (n, m) and (n, m, m).
    """
    L = jnp.linalg.cholesky(S)
    half = functools.partial(solve_triangular, L, lower=True)
    e = half(z)
    turned = jax.vmap(lambda d: half(half(d).T))(dS).reshape(dS.shape[0], -1)
    off = (jnp.eye(z.size, dtype=z.dtype) - jnp.outer(e, e)).ravel()
    J = jnp.concatenate([half(dz.T), turned.T / jnp.sqrt(2.0)])
    return J, jnp.concatenate([e, off / jnp.sqrt(2.0)])


def make_series(setup: Setup, recordings: Sequence[Recording], grid: Grid) -> Series:
    """Convert recordings to readings at the instants of a grid, padded to the longest.

    Raises:
        InputError: samples between the instants, or different channels in the recordings.
    """
    found = [_series_of_run(setup, run, grid) for run in recordings]
    longest = max(s.commands.shape[0] for s in found)

    def filled(a: Any, length: int) -> Any:
        rows = [(0, length - a.shape[0])] + [(0, 0)] * (a.ndim - 1)
        return np.pad(a, rows, mode="edge")

    each = [
        s._replace(
            commands=filled(s.commands, longest),
            readings={k: filled(y, longest + 1) for k, y in s.readings.items()},
            arrived=np.pad(s.arrived, ((0, longest + 1 - len(s.arrived)), (0, 0))),
        )
        for s in found
    ]
    if len({tuple(sorted(s.readings)) for s in each}) > 1:
        raise InputError(
            "prediction_error: some recordings have a channel v and some have none, expected the "
            "same of all; leave out what only some have"
        )
    return jax.tree.map(lambda *a: jnp.stack([jnp.asarray(x) for x in a]), *each)


def _series_of_run(setup: Setup, recording: Recording, grid: Grid) -> Series:
    run, model = make_run(setup, recording, grid), setup.model
    count, T = run.commands.shape[0], grid.period
    readings, arrived = {}, []
    for sensor, first in (("q", run.start.q), ("v", run.start.v)):
        if sensor not in run.values:
            continue
        t = np.asarray(run.times[sensor]) / T
        k = np.rint(t).astype(int)
        there: Any = np.asarray(run.weights[sensor]) > 0
        off = np.where(there.any(1), np.abs(t - k), 0.0)
        if off.max() > OFF or len(set(k)) < len(k):
            i = int(off.argmax())
            raise InputError(
                f"prediction_error: recording {recording.name} has a sample of {sensor} at "
                f"{t[i] * T:.6g} s after its start, between instants that are {T:g} s apart; "
                "expected samples at the instants of the grid: a grid with the period of the "
                "fastest sensor, or recordings put on one clock by `Recording.on_clock`"
            )
        values = np.tile(np.asarray(first, float), (count + 1, 1))
        seen = np.zeros((count + 1, model.nv), bool)
        if there.shape[1] != model.nv:  # an attitude is complete or missing
            there = np.repeat(there.all(1)[:, None], model.nv, 1)
            values[k[there[:, 0]]] = np.asarray(run.values[sensor])[there[:, 0]]
        else:
            values[k] = np.where(there, np.asarray(run.values[sensor]), values[k])
        seen[k] = there
        readings[sensor] = values.astype(np.asarray(run.start.q).dtype)
        arrived.append(seen)
    speed = _largest_speeds(setup, readings["q"], arrived[0], T)
    return Series(
        run.start, jnp.asarray(speed, run.start.q.dtype),
        run.commands, readings, np.concatenate(arrived, 1),
    )  # fmt: skip


def _largest_speeds(setup: Setup, q: np.ndarray, there: np.ndarray, T: float) -> np.ndarray:
    """Compute the largest speeds (nv,) between two successive samples of q."""
    at = np.flatnonzero(there.all(1))
    if len(at) < 2:
        return np.ones(setup.model.nv)
    minus: Any = jax.vmap(functools.partial(difference, setup.model))
    speed = np.abs(np.asarray(minus(q[at[:-1]], q[at[1:]]))) / (T * np.diff(at)[:, None])
    return np.maximum(speed.max(0), 1e-3 * max(speed.max(), 1e-3))
