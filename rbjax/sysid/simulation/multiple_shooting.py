"""Multiple shooting: a long motion as segments with separate initial states.

    min  sum_k |r_k(p, s_k)|^2 + w^2 sum_k |end_k(p, s_k) (-) start_(k+1)(p, s_(k+1))|^2
r_k is the simulation error of segment k. A long simulation from one initial state is very sensitive
to the parameters, so its error has many minima. Segments are short, with initial states near the
recording. The continuity weight w increases in stages, until the segments are one motion.

Source: Bock, *Numerical treatment of inverse problems in chemical reaction kinetics*, 1981;
Voss, Timmer & Kurths, Int. J. Bifurcation and Chaos 14(6), 2004 (chaotic motion).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.algorithms.manifold import difference, integrate
from rbjax.errors import InputError
from rbjax.model import Model, State
from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation import simulation_error
from rbjax.sysid.simulation.programs import get_cached
from rbjax.sysid.simulation.runs import Run, stack_runs
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError, sum_of_squares
from rbjax.sysid.statistics.rank import triangle_of

#: successive continuity weights; at 1 a gap counts as much as the same error of a whole segment
CONTINUITY_WEIGHTS = (0.1, 1.0, 10.0)


def make_programs(
    setup: Setup, unknowns: Unknowns, grid: Grid, own: int, loss: str,
    before: tuple[int, ...], seconds: float,
) -> tuple[Any, Any]:  # fmt: skip
    """Compile the residual with gaps, and its derivatives.

    `before` are the indices of the segments that have a next one. The last argument of both
    programs is the weight of the gaps.
    """
    make = simulation_error.make_programs
    model, one = setup.model, get_cached(make, setup, unknowns, grid, own, loss)
    last_ones, next_ones = np.array(before, int), np.array(before, int) + 1

    def pick(states: Any, which: Any) -> Any:
        return jax.tree.map(lambda a: a[which], states)

    def ends(x: jax.Array, run: Run) -> tuple[jax.Array, State, State]:
        now, path = one.simulate(x, run)
        return one.compare(now, path, run), pick(path, 0), pick(path, -1)

    def gap(last: State, first: State, weight: jax.Array) -> jax.Array:
        dq = difference(model, first.q, last.q)
        return weight * jnp.concatenate([dq, seconds * (last.v - first.v)])

    every = jax.vmap(ends)

    def residual(x: jax.Array, runs: Run, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
        r, first, last = every(x, runs)
        gaps = jax.vmap(gap, (0, 0, None))(pick(last, last_ones), pick(first, next_ones), weight)
        return r, gaps

    def slopes(
        x: jax.Array, runs: Run, weight: jax.Array
    ) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]:
        """Compute r and the gaps, and their derivatives by each entry of the segments' x.

        The derivatives of a gap by the segment before it and by the segment after it are separate
        arrays.
        """
        gaps = jax.vmap(functools.partial(gap, weight=weight))

        def along(e: jax.Array) -> tuple[jax.Array, ...]:
            move = (jnp.broadcast_to(e, x.shape),)
            (_, *states), (dr, *dstates) = jax.jvp(lambda x: every(x, runs), (x,), move)
            (first, last), (dfirst, dlast) = states, dstates
            at = pick(last, last_ones), pick(first, next_ones)
            by = pick(dlast, last_ones), pick(dfirst, next_ones)
            zero = jax.tree.map(jnp.zeros_like, by)
            after = jax.jvp(gaps, at, (by[0], zero[1]))[1]
            return dr, after, jax.jvp(gaps, at, (zero[0], by[1]))[1]

        return residual(x, runs, weight), jax.vmap(along, out_axes=-1)(jnp.eye(x.shape[-1]))

    return jax.jit(residual), jax.jit(slopes)


class MultipleShooting:
    """The residual of runs that are cut into segments, as a function of x of the segments.

    Fields:
        segments: `SimulationError` of the segments, which defines x.
        firsts: (runs,) index of each run's first segment.
        continuity_weight: weight of the gaps, which may be changed.
    """

    def __init__(
        self, setup: Setup, unknowns: Unknowns, runs: Sequence[Run], grid: Grid, seconds: float,
        *, loss: str = "squares",
    ):  # fmt: skip
        model = setup.model
        periods = max(1, round(seconds / grid.period)) if seconds > 0 else 0
        if not periods or all(run.commands.shape[0] <= periods for run in runs):
            longest = max(run.commands.shape[0] for run in runs) * grid.period
            raise InputError(
                f"identify: multiple_shooting is {seconds} s, expected the length of segments, "
                f"above 0 and shorter than the longest recording ({longest:g} s)"
            )
        if model.nx or grid.longest_delay:
            raise InputError(
                "identify: multiple_shooting with force elements that have states, or with delayed "
                "commands, expected neither, since a segment would need the time before it; use "
                "segments instead"
            )
        cut = [cut_run(model, run, grid, periods) for run in runs]
        counts = np.array([len(part) for part in cut])
        self.firsts = np.append(0, np.cumsum(counts)[:-1])
        whole = stack_runs([segment for part in cut for segment in part])
        self._before = np.setdiff1d(np.arange(counts.sum()), np.cumsum(counts) - 1)
        self.segments = of = SimulationError(
            setup, unknowns, whole, grid, estimate_initial_state=True, loss=loss
        )
        self.continuity_weight = CONTINUITY_WEIGHTS[0]
        # a gap has the total weight of the readings of an average segment
        weight = jnp.sqrt((whole.weights["q"] ** 2).sum() / whole.weights["q"].shape[-1] / of.count)
        self.weight = weight
        how = (grid, of.own, loss, tuple(map(int, self._before)), seconds)
        self._residual, self._slopes = get_cached(make_programs, setup, unknowns, *how)

    @property
    def size(self) -> int:
        """The number of entries of x."""
        return self.segments.size

    def divergence(self, x: np.ndarray, x0: np.ndarray) -> Divergence:
        """Compute the divergence of x from x0."""
        return self.segments.divergence(x, x0)

    def gaps(self, x: np.ndarray) -> np.ndarray:
        """Compute the gaps (.., 2 nv), with a continuity weight of 1."""
        of = self.segments
        return np.asarray(self._residual(of.by_run(x), of.runs, self.weight)[1])

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Compute r (rows,), including the weighted gaps."""
        r, gaps = self._residual(self.segments.by_run(x), self.segments.runs, self.weight)
        return np.concatenate([np.ravel(r), self.continuity_weight * np.ravel(gaps)])

    def cost(self, x: np.ndarray) -> float:
        """Compute the sum of squared residuals, including the weighted gaps."""
        return sum_of_squares(self.residuals(x))

    def triangle(self, x: np.ndarray) -> np.ndarray:
        """Compute R (size + 1, size + 1) with R^T R = [J r]^T [J r]."""
        of = self.segments
        found = self._slopes(of.by_run(x), of.runs, self.weight)
        (r, gaps), (J, after, ahead) = jax.tree.map(np.asarray, found)
        blocks, n, l = [], of.shared, of.own
        for k in range(of.count):
            R = triangle_of(np.concatenate([J[k], r[k][:, None]], 1))
            blocks.append(of.widen(R, k))
        for k, A, B, off in zip(self._before, after, ahead, gaps, strict=True):
            rows = np.concatenate([A[:, :n] + B[:, :n], A[:, n:], off[:, None]], 1)
            wide = of.widen(rows, k)
            wide[:, n + (k + 1) * l : n + (k + 2) * l] = B[:, n:]
            blocks.append(self.continuity_weight * wide)
        return triangle_of(np.concatenate(blocks))

    def merge(self, x: np.ndarray) -> np.ndarray:
        """Convert x of the segments to x of the whole runs.

        It keeps the unknowns, and the initial state corrections of the first segment of each run.
        """
        n = self.segments.shared
        own = x[n:].reshape(-1, self.segments.own)
        return np.append(x[:n], own[self.firsts])


def cut_run(model: Model, run: Run, grid: Grid, periods: int) -> list[Run]:
    """Cut a run into segments of `periods` periods, with an optional shorter last one."""
    found, T = [], grid.period
    for k in range(0, run.commands.shape[0], periods):
        begin, end = (k - 1e-6) * T, (k + periods - 1e-6) * T
        end = end if k + periods < run.commands.shape[0] else np.inf
        inside = {s: (begin <= np.asarray(t)) & (np.asarray(t) < end) for s, t in run.times.items()}
        if not all(x.any() for x in inside.values()):
            if end == np.inf:  # the rest has no samples
                break
            raise InputError(
                f"identify: multiple_shooting cuts segments of {periods * T:g} s, the one from "
                f"{k * T:g} s has no samples, expected longer segments"
            )
        first = run.start if k == 0 else _state_near(model, run, k * T, periods * T)
        values, weights = ({s: x[s][inside[s]] for s in x} for x in (run.values, run.weights))
        times = {s: t[inside[s]] - k * T for s, t in run.times.items()}
        known, exact = (x if k == 0 else jnp.zeros_like(x) for x in (run.known, run.exact))
        commands = run.commands[k : k + periods]
        found.append(Run(first, commands, times, values, weights, known, exact))
    return found


def _state_near(model: Model, run: Run, t: float, seconds: float) -> State:
    """Estimate the readings at time t from the nearest sample of q and a mean velocity.

    If less than half of v was measured, v is the slope of q over a tenth of a segment.
    """
    clock, measured = np.asarray(run.times["q"]), np.asarray(run.weights["q"] > 0).all(1)
    q, at = run.values["q"][measured], clock[measured]
    if len(at) < 2:
        raise InputError(
            f"identify: multiple_shooting with {len(at)} samples of q, expected at least 2, since "
            "segments begin near the recording; use multiple_shooting=None, or record q"
        )
    i = int(np.abs(at - t).argmin())
    near = np.flatnonzero(np.abs(at - t) <= 0.05 * seconds)
    a, b = (near[0], near[-1]) if len(near) > 1 else (max(i - 1, 0), min(i + 1, len(at) - 1))
    v = difference(model, q[a], q[b]) / max(at[b] - at[a], 1e-9)
    if "v" in run.values:
        arrived = np.asarray(run.weights["v"] > 0).all(1)
        if arrived.mean() > 0.5:
            v = run.values["v"][arrived][np.abs(np.asarray(run.times["v"])[arrived] - t).argmin()]
    return State(integrate(model, q[i], v * (t - at[i])), v, run.start.x)
