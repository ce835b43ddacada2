"""Multiple shooting: a long motion as pieces with starts of their own, each tied to the next.

    min  sum_k |r_k(p, s_k)|^2 + tie^2 sum_k |end_k(p, s_k) (-) start_(k+1)(p, s_(k+1))|^2
r_k is the simulation error of piece k. A simulation from one start over a long time forgets what
was recorded: a poor guess loses it, and chaos loses it from a good one. Then the error has many
minima. Pieces are short, and their starts are sought near what was recorded. Loose ties let a poor
guess follow the recording; as ties get stiffer, the pieces become one motion.

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
from rbjax.sysid.parameters.unknowns import Unknowns
from rbjax.sysid.simulation.programs import kept
from rbjax.sysid.simulation.runs import Run, batch
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError, sum_of_squares, triangle_of
from rbjax.sysid.simulation.simulation_error import programs as pieces_programs

#: ties, one after the other: at 1 a gap counts as much as a piece that is off by it throughout
TIES = (0.1, 1.0, 10.0)


def programs(
    setup: Setup, unknowns: Unknowns, grid: Grid, own: int, loss: str,
    before: tuple[int, ...], seconds: float,
) -> tuple[Any, Any]:  # fmt: skip
    """Compiled: residual and gaps, and their slopes, of pieces of which `before` have a next one;
    the last argument weighs gaps."""
    model, one = setup.model, kept(pieces_programs, setup, unknowns, grid, own, loss)
    last_ones, next_ones = np.array(before, int), np.array(before, int) + 1

    def pick(states: Any, which: Any) -> Any:
        return jax.tree.map(lambda a: a[which], states)

    def ends(x: jax.Array, run: Run) -> tuple[jax.Array, State, State]:
        now, path = one.path(x, run)
        return one.compared(now, path, run), pick(path, 0), pick(path, -1)

    def gap(last: State, first: State, weight: jax.Array) -> jax.Array:
        dq = difference(model, first.q, last.q)
        return weight * jnp.concatenate([dq, seconds * (last.v - first.v)])

    every = jax.vmap(ends)

    def shot(x: jax.Array, runs: Run, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
        r, first, last = every(x, runs)
        gaps = jax.vmap(gap, (0, 0, None))(pick(last, last_ones), pick(first, next_ones), weight)
        return r, gaps

    def sloped(
        x: jax.Array, runs: Run, weight: jax.Array
    ) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]:
        """r and gaps, and by each number of a piece the slopes of r, of the gaps after the
        pieces and of those before them."""
        gaps = jax.vmap(functools.partial(gap, weight=weight))

        def along(e: jax.Array) -> tuple[jax.Array, ...]:
            move = (jnp.broadcast_to(e, x.shape),)
            (_, *moving), (dr, *moved) = jax.jvp(lambda x: every(x, runs), (x,), move)
            (first, last), (dfirst, dlast) = moving, moved
            at = pick(last, last_ones), pick(first, next_ones)
            by = pick(dlast, last_ones), pick(dfirst, next_ones)
            still = jax.tree.map(jnp.zeros_like, by)
            after = jax.jvp(gaps, at, (by[0], still[1]))[1]
            return dr, after, jax.jvp(gaps, at, (still[0], by[1]))[1]

        return shot(x, runs, weight), jax.vmap(along, out_axes=-1)(jnp.eye(x.shape[-1]))

    return jax.jit(shot), jax.jit(sloped)


class Shooting:
    """The residual of runs that are cut into pieces, x as in `SimulationError` of the pieces.

    Fields: pieces, their simulation error; firsts (runs,), which piece begins each run; tie, which
    may be changed.
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
                f"identify: shooting is {seconds} s, expected the length of pieces, above 0 and "
                f"shorter than the longest recording ({longest:g} s)"
            )
        if model.nx or grid.longest_delay:
            raise InputError(
                "identify: shooting, with force elements that have states or with delayed commands "
                "expected neither: a piece would need what was before it; use pieces instead"
            )
        cut = [_cut(model, run, grid, periods) for run in runs]
        counts = np.array([len(part) for part in cut])
        self.firsts = np.append(0, np.cumsum(counts)[:-1])
        whole = batch([piece for part in cut for piece in part])
        before = np.setdiff1d(np.arange(counts.sum()), np.cumsum(counts) - 1)
        self.pieces = of = SimulationError(setup, unknowns, whole, grid, starts=True, loss=loss)
        self.tie, self._before = TIES[0], before
        # as many readings as a piece has, each with the mean weight
        weight = jnp.sqrt((whole.weights["q"] ** 2).sum() / whole.weights["q"].shape[-1] / of.count)

        self.weight = weight
        how = (grid, of.own, loss, tuple(map(int, before)), seconds)
        self._shot, self._slopes = kept(programs, setup, unknowns, *how)

    @property
    def size(self) -> int:
        """Numbers of x."""
        return self.pieces.size

    def divergence(self, x: np.ndarray, x0: np.ndarray) -> Divergence:
        """That of the pieces."""
        return self.pieces.divergence(x, x0)

    def gaps(self, x: np.ndarray) -> np.ndarray:
        """(ties, 2 nv), weighted for a tie of 1."""
        return np.asarray(self._shot(self.pieces.by_run(x), self.pieces.runs, self.weight)[1])

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """(rows,)"""
        r, gaps = self._shot(self.pieces.by_run(x), self.pieces.runs, self.weight)
        return np.concatenate([np.ravel(r), self.tie * np.ravel(gaps)])

    def cost(self, x: np.ndarray) -> float:
        """|r|^2."""
        return sum_of_squares(self.residuals(x))

    def triangle(self, x: np.ndarray) -> np.ndarray:
        """R (size + 1, size + 1) with R^T R = [J r]^T [J r]."""
        of = self.pieces
        found = self._slopes(of.by_run(x), of.runs, self.weight)
        (r, gaps), (J, after, ahead) = jax.tree.map(np.asarray, found)
        blocks, n, l = [], of.shared, of.own
        for k in range(of.count):
            R = triangle_of(np.concatenate([J[k], r[k][:, None]], 1))
            blocks.append(of.widened(R, k))
        for k, A, B, off in zip(self._before, after, ahead, gaps, strict=True):
            rows = np.concatenate([A[:, :n] + B[:, :n], A[:, n:], off[:, None]], 1)
            wide = of.widened(rows, k)
            wide[:, n + (k + 1) * l : n + (k + 2) * l] = B[:, n:]
            blocks.append(self.tie * wide)
        return triangle_of(np.concatenate(blocks))

    def began(self, x: np.ndarray) -> np.ndarray:
        """x of whole runs: the numbers, and the corrections of each run's first start."""
        n = self.pieces.shared
        own = x[n:].reshape(-1, self.pieces.own)
        return np.append(x[:n], own[self.firsts])


def _cut(model: Model, run: Run, grid: Grid, periods: int) -> list[Run]:
    """A run as pieces of some periods and perhaps a shorter one; a sample belongs to one piece."""
    found, T = [], grid.period
    for k in range(0, run.commands.shape[0], periods):
        begin, end = (k - 1e-6) * T, (k + periods - 1e-6) * T
        end = end if k + periods < run.commands.shape[0] else np.inf
        inside = {s: (begin <= np.asarray(t)) & (np.asarray(t) < end) for s, t in run.times.items()}
        if not all(there.any() for there in inside.values()):
            if end == np.inf:  # nothing was recorded in the rest
                break
            raise InputError(
                f"identify: shooting cuts pieces of {periods * T:g} s, the one from {k * T:g} s "
                "has no samples, expected longer pieces"
            )
        first = run.start if k == 0 else _near(model, run, k * T, periods * T)
        values, weights = ({s: x[s][inside[s]] for s in x} for x in (run.values, run.weights))
        times = {s: t[inside[s]] - k * T for s, t in run.times.items()}
        known, exact = (x if k == 0 else jnp.zeros_like(x) for x in (run.known, run.exact))
        commands = run.commands[k : k + periods]
        found.append(Run(first, commands, times, values, weights, known, exact))
    return found


def _near(model: Model, run: Run, t: float, seconds: float) -> State:
    """About what is read at a time: the nearest sample of q, moved by a mean speed. A v that was
    hardly recorded is the slope of q over a tenth of a piece."""
    clock, there = np.asarray(run.times["q"]), np.asarray(run.weights["q"] > 0).all(1)
    q, at = run.values["q"][there], clock[there]
    if len(at) < 2:
        raise InputError(
            f"identify: shooting, with {len(at)} samples of q expected at least 2: pieces begin "
            "near what was recorded; use shooting=None, or record q"
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
