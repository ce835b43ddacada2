"""`fidelity`: choose the fidelity of a wheeled robot for a manoeuvre, by trial runs.

    1. run the manoeuvre at the finest fidelity, "slipping", with steps halved until it converges
    2. run each coarser fidelity in the same way, and compare it with the next finer one
    3. for each, find the largest stable step whose motion is accurate enough
    4. choose the cheapest per second of motion
All fidelities accept the same controls, in the units of the robot's motors. "kinematic" moves at
the no-load speeds of the motors, so it does not accept torques. The rolling fidelities with inertia
have equal motions, so only one of them is measured. If it is chosen, the costs of all of them are
compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, instance
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_array, check_takes, shape_of
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.progress import progress_line
from rbjax.recommend.halved_steps import Trial, cost_decides
from rbjax.recommend.manoeuvre import Demand, Manoeuvre, demand, first_lift
from rbjax.recommend.recommendation import Recommendation, check_request, double
from rbjax.wheeled import Robot, RobotModel, at, fidelities
from rbjax.wheeled.models.robot_model import with_twist
from rbjax.wheeled.models.rolling import RollingModel
from rbjax.wheeled.models.slipping import Slipping

#: tried only on request, because it compiles slowly and costs more than equivalent fidelities
ON_REQUEST = ("constrained",)


@displayed
@dataclass(frozen=True)
class FidelityRecommendation(Recommendation):
    """A fidelity and a step: `rb.wheeled.rollout(r.model, r.state, ctrl, r.dt)`.

    Fields, in addition to the fields of `Recommendation` (cost: microseconds per second of motion):
        model: the robot at the fidelity.
        state: its initial state.
        dt: the step, s.
        error: the largest deviation of the chassis' position, m, or heading, rad, from the motion
            at the finest fidelity.
        share: the largest fraction of the tyres' traction that rolling requires, with the loads at
            rest. Above 1 the robot cannot roll. nan without "slipping" among the fidelities.
        lifts: the first time at which the load of a wheel is negative, s; inf for never, nan
            without "slipping".
    """

    model: RobotModel
    state: State
    dt: float
    error: float
    share: float
    lifts: float


def fidelity(
    robot: Robot,
    ctrl: Any,
    accuracy: float,
    *,
    q: Any = None,
    twist: Any = (0.0, 0.0, 0.0),
    horizon: float | None = None,
    dt: float = 0.01,
    tyre: Any = None,
    among: Sequence[str] | None = None,
    progress: bool = True,
) -> FidelityRecommendation:
    """Recommend the cheapest fidelity, with its step, whose motion is accurate enough.

    Fidelities run with stable steps dt, dt/2, dt/4, ... (rk4) until the chassis is within the
    accuracy of the motion at the finest fidelity. The recommendation is the cheapest per second of
    motion, measured on this machine.

    Args:
        robot: `Robot`.
        ctrl: in the units of the robot's motors: (steps, nu), each for a time dt; or (nu,),
            constant; or a function (t, state) -> (nu,), which may read only `state.q`, because the
            sizes of v and x depend on the fidelity.
        accuracy: the largest deviation of the chassis' position, m, and heading, rad, at least
            1e-10.
        q: (nq,), the initial coordinates; zeros if None.
        twist: (3,), the initial twist of the chassis in its axes, m/s and rad/s.
        horizon: duration of the motion, s; 1 if None, or steps dt if ctrl is (steps, nu).
        dt: the largest step, s.
        tyre: the tyre law of "slipping", or a tuple with one for each wheel; its default if None.
        among: the names of fidelities to choose from. None for all but "constrained", which
            compiles slowly and costs more than equivalent fidelities.
        progress: whether to display the progress on the terminal.

    Returns:
        `FidelityRecommendation`.

    Raises:
        InputError: wrong types or shapes, values that are not finite; a robot that cannot slip; a
            motion that does not converge with 1,000,000 steps.
        UnknownName: no such fidelity.

    It compiles a program for each fidelity (three to five) and a few for its linearisation and its
    contacts, and computes in f64.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.wheeled import SpeedServo
        >>> make = rb.wheeled.kinds()["differential_drive"].make
        >>> cart, rolls = make(caster=None, motor=SpeedServo(5.0)), ["kinematic", "reduced"]
        >>> r = rb.recommend.fidelity(cart, [5.0, 5.2], 0.05, twist=[0.4, 0.0, 0.0], among=rolls)
        >>> r.name, r.error < 0.05
        ('kinematic', True)
    """
    instance("recommend", "robot", robot, Robot, "a Robot")
    times = {"dt": dt} if horizon is None else {"dt": dt, "horizon": horizon}
    check_request(accuracy, progress, **times)
    names = [x for x in fidelities() if x not in ON_REQUEST] if among is None else list(among)
    for name in names:
        choice("fidelity", name, fidelities())
    names, why_not = _possible(robot, names)
    made = [at(robot, x, **({"tyre": tyre} if x == "slipping" else {})) for x in names]
    with jax.enable_x64(True):
        start = jnp.zeros(robot.layout.nq) if q is None else q
        start = check_array("recommend", "q", start, (robot.layout.nq,)).astype(jnp.float64)
        twist = check_array("recommend", "twist", twist, (3,)).astype(jnp.float64)
        given = _controls(robot, ctrl, horizon, float(dt))
        models = [jax.tree.map(double, x) for x in made]
        with progress_line("recommend", progress) as say:
            run = Manoeuvre(models, start, twist, *given, float(accuracy), say)
            found = _choose(run, models, why_not)
    # the model that was given, and the state in the caller's dtype
    model, dtype = made[names.index(found.name)], jnp.result_type(float)
    state = with_twist(model, *(jnp.asarray(np.asarray(x), dtype) for x in (start, twist)))
    return replace(found, model=model, state=state)


def _controls(robot: Robot, ctrl: Any, horizon: float | None, dt: float) -> tuple[Any, float, int]:
    """Return the controls as a table or a function, the step, and the number of steps."""
    seconds = 1.0 if horizon is None else float(horizon)
    steps = max(1, math.ceil(seconds / dt * (1 - 1e-9)))
    if callable(ctrl):
        check_takes("recommend", "ctrl", ctrl, "t", "state")
        return ctrl, seconds / steps, steps
    shape = shape_of("recommend", "ctrl", ctrl)
    if len(shape) == 2 and horizon is not None:
        raise InputError(
            f"recommend: horizon is {horizon} and ctrl is a table of {shape[0]} steps of dt; "
            "leave out the horizon, or give a function (t, state) -> (nu,)"
        )
    lead = (max(1, shape[0]),) if len(shape) == 2 else ()  # at least one step
    table = check_array("recommend", "ctrl", ctrl, (*lead, robot.nu)).astype(jnp.float64)
    if len(shape) == 2:
        return table, dt, shape[0]
    return table[None], seconds / steps, steps


def _possible(robot: Robot, names: Sequence[str]) -> tuple[list[str], str]:
    """Return the fidelities that accept the controls, coarsest first, and the reason if "kinematic"
    does not."""
    ordered = [x for x in fidelities() if x in names]
    why_not = ""
    if "kinematic" in ordered:
        why_not = _no_speeds(robot)
        if why_not:
            ordered.remove("kinematic")
    if not ordered:
        raise InputError(
            f"recommend: no fidelity is left of {list(names)}{why_not and ': ' + why_not}; "
            f"expected some of {', '.join(fidelities())}"
        )
    return ordered, why_not


def _no_speeds(robot: Robot) -> str:
    """Explain why the motors do not determine the velocities; empty if they do."""
    free = robot.arrangement.mobility
    if len(robot.drives) < free:
        return f"{len(robot.drives)} drives do not decide {free} free velocities"
    for i, drive in enumerate(robot.drives):
        try:
            drive.motor.free_speed(0.0)
        except InputError:
            return f"drives[{i}] is a {type(drive.motor).__name__}, which has no free speed"
    return ""


def _choose(run: Manoeuvre, models: Sequence[RobotModel], why_not: str) -> FidelityRecommendation:
    """Measure the fidelities, given from the coarsest to the finest, and choose one."""
    equals = [x.name for x in models if not isinstance(x, Slipping) and x.nv][1:]
    names = [x.name for x in reversed(models) if x.name not in equals]
    ends = {name: run.converge_stably(name) for name in names}
    paths = [run.path(name, k) for name, k in ends.items()]

    def trial(name: str, least: int, most: int, gap: float) -> Trial:
        def measure(path: State) -> tuple[float, float, bool]:
            error = run.deviation(path, paths[0])
            return error, gap, error <= run.accuracy

        return run.trial(name, range(least, most + 1), measure)

    trials = []
    for i, (name, most) in enumerate(ends.items()):
        gap = run.deviation(paths[i], paths[i - 1]) if i else 0.0
        trials.append(trial(name, run.least[name], most, gap))
    best = min((x for x in trials if x.success), key=lambda x: x.cost)
    if isinstance(run.models[best.name], RollingModel) or best.name in ON_REQUEST:
        least, most = run.least[best.name], ends[best.name]
        trials += [trial(name, least, most, best.gap) for name in equals]
        best = min((best, *(x for x in trials[-len(equals) :] if x.success)), key=lambda x: x.cost)
    model = run.models[best.name]
    needed, lifts = _contacts(run, names, paths)
    why = _reason(run, best, trials, names[0], why_not, needed, lifts)
    return FidelityRecommendation(
        best.name, best.cost, tuple(trials), why, model, run.start(model), best.dt, best.error,
        needed.share, lifts,
    )  # fmt: skip


def _contacts(run: Manoeuvre, names: Sequence[str], paths: list[State]) -> tuple[Demand, float]:
    """Compute the traction that rolling requires, and the time of the first wheel lift, s."""
    unknown = Demand(math.nan, math.nan)
    slipping, *others = (run.models[name] for name in names)
    if not isinstance(slipping, Slipping):
        return unknown, math.nan
    run.say("contacts")
    needed = unknown
    if others and isinstance(others[0], RollingModel):
        needed = demand(run, others[0], slipping, paths[1])
    return needed, first_lift(run, slipping, paths[0])


def _reason(
    run: Manoeuvre, best: Trial, trials: list[Trial], finest: str, why_not: str, needed: Demand,
    lifts: float,
) -> str:  # fmt: skip
    """Explain the choice by the deciding criterion and its number."""
    truth = "its limit" if best.name == finest else finest
    lifted = f"; a wheel lifts at {lifts:.2g} s, which no fidelity follows"
    return (
        f"{_decided(best, trials, why_not, needed)}; {best.name} with steps of {best.dt:.2g} s is "
        f"off by {best.error:.1e} m or rad from {truth} (requested: {run.accuracy:.1e}) over "
        f"{run.seconds:.3g} s, at {best.cost:.2g} us per second of motion"
        f"{lifted if lifts < math.inf else ''}"
    )


def _decided(best: Trial, trials: list[Trial], why_not: str, needed: Demand) -> str:
    order = list(fidelities())
    failed = [x for x in trials if not x.success and order.index(x.name) < order.index(best.name)]
    if failed:
        other = max(failed, key=lambda x: order.index(x.name))
        what = "slip"
        if other.name == "kinematic":
            what = "accuracy" if best.name == "slipping" else "inertia"
        short = f"{what} decides: {other.name} is off by {other.error:.1e}"
        if what == "slip" and math.isfinite(needed.share):
            return f"{short}, rolling needs {needed.share:.2g} of the traction of all tyres"
        return short
    start = f"kinematic is not tried, because {why_not}; " if why_not else ""
    only = f"nothing decides: {best.name} is the only fidelity left"
    return start + (cost_decides(best, trials) or only)
