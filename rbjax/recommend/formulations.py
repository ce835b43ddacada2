"""`formulation`: choose the formulation of a model's constraints for a motion, by trial runs.

    1. the motion itself, by "projected" with steps that are halved until they agree
    2. the rank of the rows along it: redundant rows, singular positions
    3. each candidate with steps halved until the residual of the rows (the gap) and the error are
       as requested
    4. the cheapest of these per second of motion
Beyond the trial run, errors and residuals of positions are assumed to grow with t^2 and residuals
of velocities with t, unless the formulation corrects them.

If rows are redundant, the candidates are those without a decision on the rank: proximal
multipliers. If the motion meets a singular position, where residuals are divided by a singular
value near zero, they must also correct the residual
(benchmarks/results/work-formulations-*.json).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import numpy as np

from rbjax.constraints import Formulation, formulations, residual
from rbjax.constraints.formulation import formulation_of
from rbjax.dynamics.arguments import check_arrays, check_takes
from rbjax.errors import InputError
from rbjax.forces.inputs import Source
from rbjax.model import Model, State
from rbjax.progress import progress_line
from rbjax.recommend.constrained_runs import RESTORING, ConstrainedRuns, Rank
from rbjax.recommend.halved_steps import Trial, cost_decides
from rbjax.recommend.recommendation import Recommendation, check_request, double

HALVINGS = 8  # of the step
CLOSED = 1e-6  # m, rad, and per second: the largest residual of a start
PROXIMAL = ("multipliers", *RESTORING)
BY_RANK = ("null_space_qr",)
FREE = "nothing decides: the model has 0 rows, its motion is free"
#: the reasons for the defaults
WHY = {
    "projected": "keeps the rows at rounding over any horizon, decides no rank and has no number "
    "to choose",
    "compliant": "enforces rows that yield, which the model has",
}


@dataclass(frozen=True)
class FormulationRecommendation(Recommendation):
    """A formulation and a step: `rb.rollout(model, state, None, r.dt, constraints=r.formulation)`.
    Measured values are nan if no motion was given.

    Fields, in addition to those of `Recommendation` (cost: microseconds per second of motion):
        formulation: None if the model has no rows.
        dt: seconds.
        gap: the largest residual of a row (m, rad) or of its rate over the horizon.
        error: the largest deviation of a configuration coordinate.
        redundant: the number of redundant rows.
        closest: the least singular value of the other rows on the motion, each scaled to length
            one.
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
    control: Source | None = None,
    progress: bool = True,
) -> FormulationRecommendation:
    """Recommend a formulation of the model's constraints for its motion from a state.

    Of the formulations with steps dt, dt/2, dt/4, ... whose gap and error over the horizon are at
    most the accuracy: the one that is cheapest per second of motion, by this machine's clock.
    Without a state and an accuracy: the default of `rollout` and `simulate`, for any motion.

    Args:
        model: the robot, with constraints.
        state: initial q (nq,), v (nv,), on the constraints; or None.
        accuracy: the largest residual of a row or of its rate, and the largest deviation of a
            configuration coordinate over the horizon, in m, rad and seconds; at least 1e-10.
        horizon: seconds of motion; only the first 2 are run, and what grows is extrapolated.
        dt: the largest step in seconds; the model's timestep if None.
        integrator: a name, as in `rb.rollout`.
        control: (t, state) -> (nu,), as `rb.rollout` takes it; None for no actuation.
        progress: show the progress on the terminal.

    Returns:
        `FormulationRecommendation`.

    Raises:
        InputError: a state of the wrong type or shape, not finite, or off the constraints; an
            accuracy, a horizon or a step that is not positive or too fine; a motion that no step
            follows with this accuracy.

    It compiles a program for each candidate (three or four), two for the rows, and computes in f64.

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
    check_request(accuracy, horizon=horizon, **({} if dt is None else {"dt": dt}))
    with jax.enable_x64(True):
        state = check_arrays("recommend", model, {"state": state})["state"]
        if control is not None:
            check_takes("recommend", "control", control, "t", "state")
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
                model, state, float(horizon), largest, integrator, control, float(accuracy), say
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
    good = [x for x in trials if x.ok]
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
    """Explain which candidates the rank of the rows rules out."""
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
        if not bare.ok:
            needs = f"is off by {max(bare.gap, bare.error):.1e} with steps of {bare.dt:.2g} s"
        return f"drift decides: multipliers, which puts nothing back, {needs}"
    other = min((x for x in trials if x is not best), key=lambda x: x.cost)
    short = f"accuracy decides: {other.name} is off by {max(other.gap, other.error):.1e}"
    return cost_decides(best, trials) or short
