"""The fidelity of a wheeled robot for a manoeuvre, measured and explained in a sentence.

    1. the manoeuvre at the finest fidelity, "slipping", with steps that are halved until they agree
    2. each coarser one, likewise: how far the next finer one is from it
    3. the largest stable step at which each is as near to the finest motion as requested
    4. the cheapest of these per second of motion
All fidelities take the same controls, in the units of the robot's motors. "kinematic" moves at the
free speeds of the motors, as if they were ideal servos, so a torque says nothing to it. Those that
roll with inertia are equal, so one of them is measured, and if it is chosen their costs decide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import check_array, check_takes, shape_of
from rbjax.errors import InputError, UnknownName
from rbjax.model import State
from rbjax.progress import Say, progress_line
from rbjax.recommend.manoeuvre import MOST_STEPS, Demand, Manoeuvre, apart, demand, first_lift
from rbjax.recommend.recommendation import Recommendation
from rbjax.recommend.request import check_request, double
from rbjax.wheeled import Fidelity, Robot, at, fidelities
from rbjax.wheeled.models.rolling import Rolling
from rbjax.wheeled.models.slipping import Slipping
from rbjax.wheeled.models.states import with_twist

AGREE = 1 / 8  # of the accuracy: two runs whose poses differ by less have converged
#: compiles for a minute and costs ten times what its equals do
ASKED_FOR = ("constrained",)


class Trial(NamedTuple):
    """A fidelity on the manoeuvre. Fields: name; dt in seconds; error, the largest deviation of the
    chassis' place, m, or heading, rad, from the motion at the finest fidelity; gap, that of the
    converged motion from the next finer one's; step_us, microseconds of a step; ok, whether the
    error is as requested."""

    name: str
    dt: float
    error: float
    gap: float
    step_us: float
    ok: bool

    @property
    def cost(self) -> float:
        """Microseconds per second of motion."""
        return self.step_us / self.dt


@dataclass(frozen=True)
class FidelityRecommendation(Recommendation):
    """A fidelity and a step: `rb.wheeled.rollout(r.vehicle, r.state, controls, r.dt)`.

    Fields, besides those of `Recommendation`, whose cost is in microseconds per second of motion:
        vehicle: the robot at the fidelity.
        state: its start.
        dt: seconds.
        error: the largest deviation of the chassis' place, m, or heading, rad, from the motion at
            the finest fidelity.
        share: the part of the tyres' traction that rolling needs at least, with the loads of the
            robot at rest; above 1 it cannot roll. nan without "slipping" among the fidelities.
        lifts: the time in seconds at which the load of a wheel first becomes negative; inf for
            never, nan without "slipping".
    """

    vehicle: Fidelity
    state: State
    dt: float
    error: float
    share: float
    lifts: float


def fidelity(
    robot: Robot,
    controls: Any,
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

    Of the fidelities with stable steps dt, dt/2, dt/4, ... (rk4) whose chassis stays within the
    accuracy of the motion at the finest fidelity: the one that is cheapest per second of motion, by
    this machine's clock.

    Args:
        robot: `Robot`.
        controls: (steps, nu), each for a time dt; or (nu,), constant; or a function (t, state) ->
            (nu,), which may read `state.q`: other sizes depend on the fidelity. In the units of the
            robot's motors.
        accuracy: the largest deviation of the chassis' place, m, and heading, rad, at least 1e-10.
        q: (nq,), the coordinates at the start; zeros if None.
        twist: (3,), that of the chassis at the start, m/s and rad/s in its axes.
        horizon: seconds of motion, 1 if None; steps dt where controls are (steps, nu).
        dt: the largest step, s.
        tyre: the law of "slipping", or a tuple of one a wheel; its default if None.
        among: the names of fidelities to choose from; all but "constrained" if None, because that
            compiles for a minute and costs ten times what its equals do.
        progress: show the progress on the terminal.

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
        >>> cart, rolls = make(caster=None, motor=SpeedServo(5.0)), ["kinematic", "kinematical"]
        >>> r = rb.recommend.fidelity(cart, [5.0, 5.2], 0.05, twist=[0.4, 0.0, 0.0], among=rolls)
        >>> r.name, r.error < 0.05
        ('kinematic', True)
    """
    if not isinstance(robot, Robot):
        raise InputError(f"recommend: robot is {type(robot).__name__}, expected a Robot")
    times = {"dt": dt} if horizon is None else {"dt": dt, "horizon": horizon}
    check_request(accuracy, **times)
    names = [x for x in fidelities() if x not in ASKED_FOR] if among is None else list(among)
    for name in names:
        if name not in fidelities():
            raise UnknownName("fidelity", name, fidelities())
    names, why_not = _possible(robot, names)
    given = [at(robot, x, **({"tyre": tyre} if x == "slipping" else {})) for x in names]
    with jax.enable_x64(True):
        start = jnp.zeros(robot.layout.nq) if q is None else q
        start = check_array("recommend", "q", start, (robot.layout.nq,)).astype(jnp.float64)
        twist = check_array("recommend", "twist", twist, (3,)).astype(jnp.float64)
        run = Manoeuvre(start, twist, *_controls(robot, controls, horizon, float(dt)))
        vehicles = [jax.tree.map(double, x) for x in given]
        with progress_line("recommend", progress) as say:
            found = _Choice(run, vehicles, float(accuracy), why_not, say).made()
    # as given, and in the caller's dtype
    vehicle, dtype = given[names.index(found.name)], jnp.result_type(float)
    state = with_twist(vehicle, *(jnp.asarray(np.asarray(x), dtype) for x in (start, twist)))
    return replace(found, vehicle=vehicle, state=state)


def _controls(
    robot: Robot, controls: Any, horizon: float | None, dt: float
) -> tuple[Any, float, int]:
    """Controls as a table or a function, a step, and the number of steps."""
    seconds = 1.0 if horizon is None else float(horizon)
    steps = max(1, math.ceil(seconds / dt * (1 - 1e-9)))
    if callable(controls):
        check_takes("recommend", "controls", controls, "t", "state")
        return controls, seconds / steps, steps
    shape = shape_of("recommend", "controls", controls)
    if len(shape) == 2 and horizon is not None:
        raise InputError(
            f"recommend: horizon is {horizon} and controls are a table of {shape[0]} steps of dt; "
            "leave out the horizon, or give a function (t, state) -> (nu,)"
        )
    lead = (max(1, shape[0]),) if len(shape) == 2 else ()  # at least one step
    table = check_array("recommend", "controls", controls, (*lead, robot.nu)).astype(jnp.float64)
    if len(shape) == 2:
        return table, dt, shape[0]
    return table[None], seconds / steps, steps


def _possible(robot: Robot, names: Sequence[str]) -> tuple[list[str], str]:
    """The fidelities that can obey the controls, the coarsest first; why others cannot."""
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
    """Why its motors do not say how fast a robot moves; empty if they do."""
    free = robot.arrangement.mobility
    if len(robot.drives) < free:
        return f"{len(robot.drives)} drives do not decide {free} free velocities"
    for i, drive in enumerate(robot.drives):
        try:
            drive.motor.free_speed(0.0)
        except InputError:
            return f"drives[{i}] is a {type(drive.motor).__name__}, which has no free speed"
    return ""


class _Choice:
    """The measurements, and what follows from them."""

    def __init__(
        self, run: Manoeuvre, vehicles: list[Fidelity], accuracy: float, why_not: str, say: Say
    ):
        self.run, self.accuracy, self.why_not, self.say = run, accuracy, why_not, say
        equal = [x for x in vehicles if not isinstance(x, Slipping) and x.nv]
        self.equals = equal[1:]
        # one for each kind of motion, the finest first
        again = {x.name for x in self.equals}
        self.vehicles = [x for x in reversed(vehicles) if x.name not in again]
        self._paths: dict[tuple[str, int], State] = {}
        self._least: dict[str, int] = {}  # halvings with which steps are stable

    def made(self) -> FidelityRecommendation:
        ends = [self._converged(vehicle) for vehicle in self.vehicles]
        paths = [self._path(v, k) for v, k in zip(self.vehicles, ends, strict=True)]
        trials: list[Trial] = []
        for i, (vehicle, most) in enumerate(zip(self.vehicles, ends, strict=True)):
            gap = apart(paths[i], paths[i - 1]) if i else 0.0
            least = self._least[vehicle.name]
            trials.append(self._trial(vehicle, least, most, gap, paths[0]))
        best = min((x for x in trials if x.ok), key=lambda x: x.cost)
        vehicle = self.vehicles[trials.index(best)]
        if isinstance(vehicle, Rolling) or vehicle.name in ASKED_FOR:
            equal = {x.name: x for x in (vehicle, *self.equals)}
            ways = self._least[vehicle.name], ends[self.vehicles.index(vehicle)]
            others = [self._trial(x, *ways, best.gap, paths[0]) for x in self.equals]
            trials += others
            best = min((x for x in (best, *others) if x.ok), key=lambda x: x.cost)
            vehicle = equal[best.name]
        needed, lifts = self._contacts(paths)
        why = self._reason(best, trials, needed, lifts)
        return FidelityRecommendation(
            best.name, best.cost, tuple(trials), why, vehicle, self.run.start(vehicle), best.dt,
            best.error, needed.share, lifts,
        )  # fmt: skip

    def _path(self, vehicle: Fidelity, k: int) -> State:
        if (vehicle.name, k) not in self._paths:
            self.say(f"{vehicle.name} with steps of {self.run.dt(k):.2g} s")
            self._paths[vehicle.name, k] = self.run.path(vehicle, k)
        return self._paths[vehicle.name, k]

    def _converged(self, vehicle: Fidelity) -> int:
        """The halvings after which the motion changes by far less than the accuracy."""
        start = jax.tree.map(lambda x: x[None], self.run.start(vehicle))
        k = self.run.stable_halvings(vehicle, start)
        while self.run.steps(k + 1) <= MOST_STEPS:
            k += 1
            path = self._path(vehicle, k)
            if apart(path, self._path(vehicle, k - 1)) < AGREE * self.accuracy:
                self._least[vehicle.name] = least = self.run.stable_halvings(vehicle, path)
                if least < k:
                    return k
                k = least
        raise InputError(
            f"recommend: the motion at {vehicle.name!r} over {self.run.times[-1]:.3g} s does not "
            f"converge to {self.accuracy:.1e} with steps down to {self.run.dt(k):.1e} s; give a "
            "larger accuracy, a shorter manoeuvre, or tyres with a larger smooth_speed"
        )

    def _trial(self, vehicle: Fidelity, least: int, most: int, gap: float, truth: State) -> Trial:
        """With the largest step that is good enough; else with the smallest that was tried."""
        for k in range(least, most + 1):
            error = apart(self._path(vehicle, k), truth)
            if error <= self.accuracy:
                cost = self.run.step_us(vehicle, k)
                return Trial(vehicle.name, self.run.dt(k), error, gap, cost, True)
        return Trial(vehicle.name, self.run.dt(most), error, gap, math.inf, False)

    def _contacts(self, paths: list[State]) -> tuple[Demand, float]:
        """What rolling needs of the ground, and when a wheel lifts."""
        slipping, *others = self.vehicles
        if not isinstance(slipping, Slipping):
            return Demand(math.nan, math.nan), math.nan
        self.say("contacts")
        needed = Demand(math.nan, math.nan)
        if others and isinstance(others[0], Rolling):
            needed = demand(self.run, others[0], slipping, paths[1])
        return needed, first_lift(self.run, slipping, paths[0])

    def _reason(self, best: Trial, trials: list[Trial], needed: Demand, lifts: float) -> str:
        """The deciding criterion, with its number."""
        finest = self.vehicles[0].name
        truth = "its limit" if best.name == finest else finest
        met = (
            f"{best.name} with steps of {best.dt:.2g} s is off by {best.error:.1e} m or rad from "
            f"{truth} (requested: {self.accuracy:.1e}) over {self.run.times[-1]:.3g} s, at "
            f"{best.cost:.2g} us per second of motion"
        )
        lifted = f"; a wheel lifts at {lifts:.2g} s, which no fidelity follows"
        return f"{self._decided(best, trials, needed)}; {met}{lifted if lifts < math.inf else ''}"

    def _decided(self, best: Trial, trials: list[Trial], needed: Demand) -> str:
        order = list(fidelities())
        failed = [x for x in trials if not x.ok and order.index(x.name) < order.index(best.name)]
        if failed:
            other = max(failed, key=lambda x: order.index(x.name))
            what = "slip"
            if other.name == "kinematic":
                what = "accuracy" if best.name == "slipping" else "inertia"
            short = f"{what} decides: {other.name} is off by {other.error:.1e}"
            if what == "slip" and math.isfinite(needed.share):
                return f"{short}, rolling needs {needed.share:.2g} of the traction of all tyres"
            return short
        others = [x for x in trials if x is not best and x.ok]
        start = f"kinematic is not tried, because {self.why_not}; " if self.why_not else ""
        if not others:
            return f"{start}nothing decides: {best.name} is the only fidelity left"
        other = min(others, key=lambda x: x.cost)
        return f"{start}cost decides: {other.name} would take {other.cost:.2g} us"
