"""Trial runs of constrained motion: gaps, errors, costs, and the rank of the rows along the way."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import compiler_options
from rbjax.constraints import formulations, jacobian, residual
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.model import Model, State
from rbjax.motion.step import step
from rbjax.recommend.request import fastest

MOST_SECONDS = 2.0
MOST_LOOKS = 64  # times at which motions are compared, gaps measured, ranks counted
INDEPENDENT = 1e-7  # a singular value of scaled rows above this counts
#: a position is singular where the least one is below this, against its median on the run
SINGULAR = 0.05
RESTORING = ("baumgarte", "projected")  # the rows: gaps do not grow


class Trial(NamedTuple):
    """A candidate, over the horizon. Fields: name; dt in seconds; gap, the largest residual of a
    row or of its rate; error, the largest deviation of a configuration coordinate; step_us,
    microseconds of a step; ok, whether gap and error are as requested."""

    name: str
    dt: float
    gap: float
    error: float
    step_us: float
    ok: bool

    @property
    def cost(self) -> float:
        """Microseconds per second of motion."""
        return self.step_us / self.dt


class Rank(NamedTuple):
    """Of the rows along a run. Fields: rows, how many there are; redundant, how many of them
    are redundant; closest, the least singular value of the scaled others; at, its time in seconds;
    median, of the least singular values along the way."""

    rows: int
    redundant: int
    closest: float
    at: float
    median: float

    @property
    def singular(self) -> bool:
        return self.closest < SINGULAR * self.median


class Runs:
    """Trial runs of a model from a state, with steps dt / 2^halvings."""

    def __init__(
        self, model: Model, state: State, horizon: float, dt: float, integrator: str, control: Any
    ):
        self.model, self.state, self._dt = model, state, dt
        self._integrator, self._control = integrator, control
        seconds = min(horizon, MOST_SECONDS)
        self.looks = min(MOST_LOOKS, math.ceil(seconds / dt))
        self._each = max(1, int(seconds / self.looks / dt * (1 + 1e-9)))  # steps between two looks
        self.seconds = self.looks * self._each * dt
        self.longer = max(1.0, horizon / self.seconds)
        self._programs: dict[str, Callable] = {}

    def dt(self, halvings: int) -> float:
        return self._dt / 2**halvings

    def steps(self, halvings: int) -> int:
        return self.looks * (self._each << halvings)

    @property
    def times(self) -> np.ndarray:
        return self.seconds / self.looks * (1.0 + np.arange(self.looks))

    def path(self, name: str, halvings: int) -> State:
        """The states at `times`."""
        return self._run(name, self.state, 0.0, self.dt(halvings), self._each << halvings)

    def _run(self, name: str, state: State, t: float, dt: float, each: int) -> State:
        if name not in self._programs:
            self._programs[name] = self._program(name)
        given = jnp.asarray(t), jnp.asarray(dt), jnp.asarray(each)
        return jax.block_until_ready(self._programs[name](state, *given))

    def _program(self, name: str) -> Callable:
        """(state, t, dt, steps between looks) -> states; one program for all steps."""
        formulation = formulations()[name]

        def run(state: State, t: Any, dt: Any, each: Any) -> State:
            def one(i: Any, x: tuple[Any, State]) -> tuple[Any, State]:
                t, now = x
                u = None if self._control is None else self._control(t, now)
                how = {"integrator": self._integrator, "constraints": formulation}
                return t + dt, step(self.model, now, u, dt, t=t, **how)

            def look(x: tuple[Any, State], _: None) -> tuple[tuple[Any, State], State]:
                x = jax.lax.fori_loop(0, each, one, x)
                return x, x[1]

            return jax.lax.scan(look, (t, state), None, self.looks)[1]

        return jax.jit(run, compiler_options=compiler_options())

    def step_us(self, name: str, halvings: int) -> float:
        """Microseconds of a step, of the fastest run."""
        return 1e6 * fastest(lambda: self.path(name, halvings)) / self.steps(halvings)

    @functools.cached_property
    def _residual(self) -> Callable:
        return jax.jit(jax.vmap(functools.partial(residual, self.model)))

    def gap(self, name: str, path: State) -> float:
        """The largest residual over the horizon, of rows and of their rates."""
        if not _is_finite(path):
            return math.inf
        value, rate = (float(np.abs(x).max()) for x in self._residual(path, self.times))
        if name not in RESTORING:
            value, rate = value * self.longer**2, rate * self.longer
        return max(value, rate)

    @functools.cached_property
    def _difference(self) -> Callable:
        return jax.jit(jax.vmap(functools.partial(difference, self.model)))

    def apart(self, a: State, b: State) -> float:
        """The largest deviation of a configuration coordinate over the horizon."""
        if not (_is_finite(a) and _is_finite(b)):
            return math.inf
        return float(np.abs(self._difference(a.q, b.q)).max()) * self.longer**2

    @functools.cached_property
    def _matrices(self) -> Callable:
        def found(q: jax.Array, t: Any) -> tuple[jax.Array, jax.Array]:
            return jacobian(self.model, q, t), mass_matrix(self.model, q)

        return jax.jit(jax.vmap(found))

    def _rows(self, q: jax.Array, t: np.ndarray) -> np.ndarray:
        """G M^-1/2 (looks, rows, nv)."""
        G, M = (np.asarray(x) for x in self._matrices(q, t))
        return np.linalg.solve(np.linalg.cholesky(M), G.swapaxes(1, 2)).swapaxes(1, 2)

    def rank(self, path: State) -> Rank:
        """Along a run by "projected", looked at more closely where the rows are closest to losing
        rank. A row is scaled by its usual length on the run: that one vanishes is a loss too."""
        B = self._rows(path.q, self.times)
        usual = np.median(np.linalg.norm(B, axis=2), axis=0)
        said = usual > INDEPENDENT * usual.max()
        scale = np.where(said, 1.0 / np.where(said, usual, 1.0), 0.0)[:, None]
        s = np.linalg.svd(scale * B, compute_uv=False)
        full = int((s > INDEPENDENT).sum(1).max())
        least, k = s[:, full - 1], int(s[:, full - 1].argmin())
        before, start = self.state, 0.0
        if k:
            before, start = jax.tree.map(lambda x: x[k - 1], path), float(self.times[k - 1])
        apart = 2 * self.seconds / self.looks**2  # looks on the two intervals around the k-th
        nearer = self._run("projected", before, start, apart / 2, 2)
        times = start + apart * (1.0 + np.arange(self.looks))
        s = np.linalg.svd(scale * self._rows(nearer.q, times), compute_uv=False)
        every, at = np.append(least, s[:, full - 1]), np.append(self.times, times)
        rows, j = B.shape[1], int(every.argmin())
        return Rank(rows, rows - full, float(every[j]), float(at[j]), float(np.median(least)))


def _is_finite(path: State) -> bool:
    return bool(jnp.isfinite(path.q).all() and jnp.isfinite(path.v).all())
