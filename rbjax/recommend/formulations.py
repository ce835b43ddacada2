"""`formulation`: choose the formulation of a model's constraints for a motion, by trial runs.

    1. compute the motion by "projected", with steps that are halved until it converges
    2. compute the rank of the constraint rows along it: redundant rows, singular positions
    3. halve the step of each candidate until the residual of the rows (the gap) and the error are
       as requested
    4. choose the cheapest candidate per second of motion
Beyond the trial run, errors and residuals of positions are assumed to grow with t^2, and residuals
of velocities with t, unless the formulation corrects them.

If rows are redundant, only formulations that do not decide a rank are candidates: proximal
multipliers. If the motion passes a singular position, where residuals are divided by a singular
value near zero, candidates must also correct the residual.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints import Formulation, formulations, jacobian, residual
from rbjax.constraints.formulation import formulation_of
from rbjax.display import displayed
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.dynamics.arguments import check_arrays, check_takes
from rbjax.errors import InputError
from rbjax.forces.inputs import Source
from rbjax.model import Model, State
from rbjax.motion.step import step
from rbjax.progress import Say, progress_line
from rbjax.recommend.halved_steps import HalvedSteps, Trial, cost_decides
from rbjax.recommend.recommendation import Recommendation, check_request, double

#: the longest trial run, s
MOST_SECONDS = 2.0
#: the number of times at which motions are compared
MOST_LOOKS = 64
#: scaled rows are independent if their singular value is above this
INDEPENDENT = 1e-7
#: a position is singular if the least singular value is below this fraction of its median
SINGULAR = 0.05
#: the formulations that correct the residual of the rows, so that it does not grow
RESTORING = ("baumgarte", "projected")
HALVINGS = 8  # of the step
CLOSED = 1e-6  # the largest residual of the initial state: m, rad, and per second
PROXIMAL = ("multipliers", *RESTORING)
BY_RANK = ("null_space_qr",)
FREE = "nothing decides: the model has 0 rows, its motion is free"
#: the reasons for the defaults
WHY = {
    "projected": "keeps the constraint rows at rounding error over any horizon, decides no rank "
    "and has no parameter to choose",
    "compliant": "enforces rows that yield, which the model has",
}


@displayed
@dataclass(frozen=True)
class FormulationRecommendation(Recommendation):
    """A formulation and a step: `rb.rollout(model, state, None, r.dt, constraints=r.formulation)`.

    Measured values are nan if no motion was given.

    Fields, in addition to the fields of `Recommendation` (cost: microseconds per second of motion):
        formulation: None if the model has no rows.
        dt: the step, s.
        gap: the largest residual of a row (m, rad) or of its rate over the horizon.
        error: the largest deviation of a configuration coordinate.
        redundant: the number of redundant rows.
        closest: the least singular value of the independent rows along the motion, each row scaled
            to length one.
    """

    formulation: Formulation | None
    dt: float
    gap: float
    error: float
    redundant: int | None
    closest: float


def formulation(
    model: Model,
    state: State | None = None,
    accuracy: float | None = None,
    *,
    horizon: float = 1.0,
    dt: float | None = None,
    integrator: str = "rk4",
    ctrl: Source | None = None,
    progress: bool = True,
) -> FormulationRecommendation:
    """Recommend a formulation of the model's constraints for its motion from a state.

    Candidates run with steps dt, dt/2, dt/4, ... until gap and error over the horizon are at most
    the accuracy. The recommendation is the cheapest per second of motion, measured on this machine.
    Without a state and an accuracy, it is the default of `rollout` and `simulate`, for any motion.

    Args:
        model: the robot, with constraints.
        state: initial q (nq,), v (nv,), on the constraints; or None.
        accuracy: the largest residual of a row or of its rate, and the largest deviation of a
            configuration coordinate over the horizon, in m, rad and seconds; at least 1e-10.
        horizon: duration of the motion, s. Only the first 2 s are run; growing errors are
            extrapolated.
        dt: the largest step, s; the model's timestep if None.
        integrator: a name, as in `rb.rollout`.
        ctrl: (t, state) -> (nu,), as for `rb.rollout`; None for no actuation.
        progress: whether to display the progress on the terminal.

    Returns:
        `FormulationRecommendation`.

    Raises:
        InputError: a state of the wrong type or shape, not finite, or off the constraints; an
            accuracy, a horizon or a step that is not positive or too fine; a motion that no step
            reproduces with this accuracy.

    It compiles one program for each candidate (three or four) and two for the rows, and computes in
    f64.

    Source: Masarati, *Multibody System Dynamics*, ch. 7, 8.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> r = rb.recommend.formulation(model, model.default_state(), 1e-6)
        >>> r.name, r.reason
        ('none', 'nothing decides: the model has 0 rows, its motion is free')
    """
    if state is None and accuracy is None:
        return _of_any_motion(model, dt)
    if state is None or accuracy is None:
        raise InputError(
            f"recommend: {'accuracy' if state is None else 'state'} is given and "
            f"{'state' if state is None else 'accuracy'} is not; give both for a motion, or "
            "neither for the default"
        )
    check_request(accuracy, progress, horizon=horizon, **({} if dt is None else {"dt": dt}))
    with jax.enable_x64(True):
        state = check_arrays("recommend", model, {"state": state})["state"]
        if ctrl is not None:
            check_takes("recommend", "ctrl", ctrl, "t", "state")
        model, state = jax.tree.map(double, (model, state))
        largest = float(model.timestep if dt is None else dt)
        if not model.constraints:
            return FormulationRecommendation(
                "none", 0.0, (), FREE, None, largest, 0.0, 0.0, 0, math.inf
            )
        off = max(float(np.abs(x).max()) for x in residual(model, state))
        if not off <= CLOSED:
            raise InputError(
                f"recommend: the state is off the constraints by {off:.2g}, expected at most "
                f"{CLOSED:.0e}; rb.constraints.assemble(model, state) finds one that is on them"
            )
        with progress_line("recommend", progress) as say:
            runs = ConstrainedRuns(
                model, state, float(horizon), largest, integrator, ctrl, float(accuracy), say
            )
            return _recommended(runs, float(horizon))


def _of_any_motion(model: Model, dt: float | None) -> FormulationRecommendation:
    found = formulation_of("recommend", model, None)
    name, why = "none", FREE
    if found is not None:
        name = next(key for key, x in formulations().items() if x == found)
        why = f"no motion is given, so nothing is measured: {name} {WHY[name]}"
    step, unknown = float(model.timestep if dt is None else dt), math.nan
    return FormulationRecommendation(
        name, unknown, (), why, found, step, unknown, unknown, None, unknown
    )


def _recommended(runs: ConstrainedRuns, horizon: float) -> FormulationRecommendation:
    truth = runs.path("projected", runs.converge("projected"))
    runs.say("the rank of the rows")
    rank = runs.rank(truth)
    independent = PROXIMAL if rank.redundant else PROXIMAL + BY_RANK
    names = RESTORING if rank.singular else independent
    trials = [_trial(runs, name, truth) for name in names]
    good = [x for x in trials if x.success]
    if not good:
        raise InputError(
            f"recommend: none of {', '.join(names)} keeps gap and error within "
            f"{runs.accuracy:.1e} over {horizon:g} s with steps down to {trials[-1].dt:.1e} s; "
            f"{runs.cure}"
        )
    best = min(good, key=lambda x: x.cost)
    why = (
        f"{_ruled_out(rank)}{_decided(best, trials)}; {best.name} with steps of {best.dt:.2g} s "
        f"leaves a gap of {best.gap:.1e} and an error of {best.error:.1e} (requested: "
        f"{runs.accuracy:.1e}) over {horizon:g} s, at {best.cost:.2g} us per second of motion"
    )
    return FormulationRecommendation(
        best.name, best.cost, tuple(trials), why, formulations()[best.name], best.dt, best.gap,
        best.error, rank.redundant, rank.closest,
    )  # fmt: skip


def _trial(runs: ConstrainedRuns, name: str, truth: State) -> Trial:
    def measure(path: State) -> tuple[float, float, bool]:
        error, gap = runs.deviation(path, truth), runs.gap(name, path)
        return error, gap, max(error, gap) <= runs.accuracy

    return runs.trial(name, range(HALVINGS + 1), measure)


def _ruled_out(rank: Rank) -> str:
    """Explain which candidates are excluded by the rank of the rows."""
    if rank.singular:
        return (
            f"a singular position is met at {rank.at:.2g} s, where the least singular value of the "
            f"rows falls to {rank.closest:.1e} from {rank.median:.2g}, so only proximal "
            "multipliers that put the rows back are tried; "
        )
    if rank.redundant:
        return (
            f"{rank.redundant} of {rank.rows} rows are redundant, so only proximal multipliers, "
            "which decide no rank, are tried; "
        )
    return ""


def _decided(best: Trial, trials: list[Trial]) -> str:
    """Explain the choice among the candidates."""
    bare = next((x for x in trials if x.name == "multipliers"), best)
    if best.name in RESTORING and best.dt > bare.dt:
        needs = f"needs steps of {bare.dt:.2g} s"
        if not bare.success:
            needs = f"is off by {max(bare.gap, bare.error):.1e} with steps of {bare.dt:.2g} s"
        return f"drift decides: multipliers, which does not correct drift, {needs}"
    other = min((x for x in trials if x is not best), key=lambda x: x.cost)
    short = f"accuracy decides: {other.name} is off by {max(other.gap, other.error):.1e}"
    return cost_decides(best, trials) or short


class Rank(NamedTuple):
    """The rank of the constraint rows along a motion."""

    rows: int  # the number of rows
    redundant: int  # the number of redundant rows
    closest: float  # the least singular value of the scaled independent rows
    at: float  # the time of `closest`, s
    median: float  # the median of the least singular values along the motion

    @property
    def singular(self) -> bool:
        """True if the motion passes a singular position."""
        return self.closest < SINGULAR * self.median


class ConstrainedRuns(HalvedSteps):
    """Trial runs of a model from a state, with the formulations of its constraints as
    candidates."""

    most_steps = 200_000
    cure = "give a larger accuracy, a shorter horizon or a smaller dt"

    def __init__(
        self, model: Model, state: State, horizon: float, dt: float, integrator: str, ctrl: Any,
        accuracy: float, say: Say,
    ):  # fmt: skip
        super().__init__(dt, accuracy, say)
        self.model, self.state = model, state
        self._integrator, self._ctrl = integrator, ctrl
        seconds = min(horizon, MOST_SECONDS)
        self.looks = min(MOST_LOOKS, math.ceil(seconds / dt))
        self._each = max(1, int(seconds / self.looks / dt * (1 + 1e-9)))  # steps between two times
        self.seconds = self.looks * self._each * dt
        self.longer = max(1.0, horizon / self.seconds)
        self.times = self.seconds / self.looks * (1.0 + np.arange(self.looks))

    def steps(self, k: int) -> int:
        return self.looks * (self._each << k)

    def arguments(self, k: int) -> tuple:
        return self.state, jnp.asarray(0.0), jnp.asarray(self.dt(k)), self._each << k

    def motion(self, name: str) -> Callable[..., State]:
        """Return the function (state, t, dt, steps between samples) -> states at the sample
        `times`."""
        how: dict[str, Any] = {"integrator": self._integrator, "constraints": formulations()[name]}

        def run(state: State, t: Any, dt: Any, each: Any) -> State:
            def one(_: Any, x: tuple[Any, State]) -> tuple[Any, State]:
                t, now = x
                u = None if self._ctrl is None else self._ctrl(t, now)
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
        """Compute the scaled constraint Jacobian G M^-1/2 (samples, rows, nv)."""
        G, M = (np.asarray(x) for x in self._matrices(q, t))
        return np.linalg.solve(np.linalg.cholesky(M), G.swapaxes(1, 2)).swapaxes(1, 2)

    def rank(self, path: State) -> Rank:
        """Compute the rank of the rows along a motion, with more samples near the least singular
        value.

        Each row is scaled by its median length along the motion, so a row that vanishes loses rank.
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
