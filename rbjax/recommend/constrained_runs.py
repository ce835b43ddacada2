"""Trial runs of constrained motion: residuals, deviations, and the rank of the rows."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints import formulations, jacobian, residual
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.model import Model, State
from rbjax.motion.step import step
from rbjax.progress import Say
from rbjax.recommend.halved_steps import HalvedSteps

#: the longest trial run, s
MOST_SECONDS = 2.0
#: the number of times at which motions are compared
MOST_LOOKS = 64
#: singular values of scaled rows above this count
INDEPENDENT = 1e-7
#: a position is singular where the least singular value is below this part of its median
SINGULAR = 0.05
#: the formulations that correct the residual of the rows, so that it does not grow
RESTORING = ("baumgarte", "projected")


class Rank(NamedTuple):
    """The rank of the rows along a motion.

    Fields:
        rows: the number of rows.
        redundant: the number of redundant rows.
        closest: the least singular value of the scaled independent rows.
        at: the time of `closest`, s.
        median: the median of the least singular values along the motion.
    """

    rows: int
    redundant: int
    closest: float
    at: float
    median: float

    @property
    def singular(self) -> bool:
        """Whether the motion meets a singular position."""
        return self.closest < SINGULAR * self.median


class ConstrainedRuns(HalvedSteps):
    """Trial runs of a model from a state by the formulations of its constraints."""

    most_steps = 200_000
    cure = "give a larger accuracy, a shorter horizon or a smaller dt"

    def __init__(
        self, model: Model, state: State, horizon: float, dt: float, integrator: str, control: Any,
        accuracy: float, say: Say,
    ):  # fmt: skip
        super().__init__(dt, accuracy, say)
        self.model, self.state = model, state
        self._integrator, self._control = integrator, control
        seconds = min(horizon, MOST_SECONDS)
        self.looks = min(MOST_LOOKS, math.ceil(seconds / dt))
        self._each = max(1, int(seconds / self.looks / dt * (1 + 1e-9)))  # steps between two looks
        self.seconds = self.looks * self._each * dt
        self.longer = max(1.0, horizon / self.seconds)
        self.times = self.seconds / self.looks * (1.0 + np.arange(self.looks))

    def steps(self, k: int) -> int:
        return self.looks * (self._each << k)

    def arguments(self, k: int) -> tuple:
        return self.state, jnp.asarray(0.0), jnp.asarray(self.dt(k)), self._each << k

    def motion(self, name: str) -> Callable[..., State]:
        """(state, t, dt, steps between looks) -> states at `times`."""
        how = {"integrator": self._integrator, "constraints": formulations()[name]}

        def run(state: State, t: Any, dt: Any, each: Any) -> State:
            def one(_: Any, x: tuple[Any, State]) -> tuple[Any, State]:
                t, now = x
                u = None if self._control is None else self._control(t, now)
                return t + dt, step(self.model, now, u, dt, t=t, **how)

            def look(x: tuple[Any, State], _: None) -> tuple[tuple[Any, State], State]:
                x = jax.lax.fori_loop(0, each, one, x)
                return x, x[1]

            return jax.lax.scan(look, (t, state), None, self.looks)[1]

        return run

    @functools.cached_property
    def _residual(self) -> Callable:
        return jax.jit(jax.vmap(functools.partial(residual, self.model)))

    def gap(self, name: str, path: State) -> float:
        """Return the largest residual of a row or of its rate over the horizon."""
        if not _is_finite(path):
            return math.inf
        value, rate = (float(np.abs(x).max()) for x in self._residual(path, self.times))
        if name not in RESTORING:
            value, rate = value * self.longer**2, rate * self.longer
        return max(value, rate)

    @functools.cached_property
    def _difference(self) -> Callable:
        return jax.jit(jax.vmap(functools.partial(difference, self.model)))

    def deviation(self, a: State, b: State) -> float:
        """Return the largest deviation of a configuration coordinate over the horizon."""
        if not (_is_finite(a) and _is_finite(b)):
            return math.inf
        return float(np.abs(self._difference(a.q, b.q)).max()) * self.longer**2

    @functools.cached_property
    def _matrices(self) -> Callable:
        return jax.jit(
            jax.vmap(lambda q, t: (jacobian(self.model, q, t), mass_matrix(self.model, q)))
        )

    def _rows(self, q: jax.Array, t: np.ndarray) -> np.ndarray:
        """G M^-1/2 (looks, rows, nv)."""
        G, M = (np.asarray(x) for x in self._matrices(q, t))
        return np.linalg.solve(np.linalg.cholesky(M), G.swapaxes(1, 2)).swapaxes(1, 2)

    def rank(self, path: State) -> Rank:
        """Find the rank of the rows along a motion by "projected", with more looks near the least
        singular value.

        A row is scaled by its median length on the motion, so a row that vanishes loses rank.
        """
        B = self._rows(path.q, self.times)
        length = np.median(np.linalg.norm(B, axis=2), axis=0)
        nonzero = length > INDEPENDENT * length.max()
        scale = np.where(nonzero, 1.0 / np.where(nonzero, length, 1.0), 0.0)[:, None]
        s = np.linalg.svd(scale * B, compute_uv=False)
        full = int((s > INDEPENDENT).sum(1).max())
        least, k = s[:, full - 1], int(s[:, full - 1].argmin())
        before, start = self.state, 0.0
        if k:
            before, start = jax.tree.map(lambda x: x[k - 1], path), float(self.times[k - 1])
        apart = 2 * self.seconds / self.looks**2  # looks on the two intervals around the k-th
        nearer = self.compiled("projected")(before, jnp.asarray(start), jnp.asarray(apart / 2), 2)
        times = start + apart * (1.0 + np.arange(self.looks))
        s = np.linalg.svd(scale * self._rows(nearer.q, times), compute_uv=False)
        every, at = np.append(least, s[:, full - 1]), np.append(self.times, times)
        rows, j = B.shape[1], int(every.argmin())
        return Rank(rows, rows - full, float(every[j]), float(at[j]), float(np.median(least)))


def _is_finite(path: State) -> bool:
    return bool(jnp.isfinite(path.q).all() and jnp.isfinite(path.v).all())
