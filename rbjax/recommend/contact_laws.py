"""`contact_law`: choose the law of contact for a motion, by trial runs.

    1. compute the motion with rigid contacts and Coulomb friction, "impulse", at an eighth of the
       step: the limit of all laws for stiff contacts
    2. compute it by each law at the step, and by "compliant" with adaptive steps
    3. measure penetration, creep, lift and computing time of each
    4. choose the cheapest law whose measures are at most the accuracy
All measures are lengths. The travel of a contact is the length of its slip while the surfaces are
closer than the accuracy. Creep is the largest difference of a travel from the reference: slip where
friction should hold, friction that depends on the direction, bodies that friction lifts. Lift is
the gain of mechanical energy divided by the weight, which no contact may give.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, integer, real_number
from rbjax.contact.compliant import CompliantContact
from rbjax.contact.geometry.detection import chosen_pairs, contacts_at
from rbjax.contact.impacts.moreau import MoreauContact
from rbjax.contact.impacts.point_velocity import contact_jacobian
from rbjax.contact.registry import laws
from rbjax.display import displayed
from rbjax.dynamics.algorithms.energy import kinetic_energy, potential_energy
from rbjax.dynamics.arguments import check_arrays, check_takes
from rbjax.errors import InputError, RbjaxError
from rbjax.forces.inputs import Source
from rbjax.lanes.arrays import matvec
from rbjax.model import Model, State
from rbjax.motion.rollout import run_rollout
from rbjax.motion.simulate import simulate
from rbjax.motion.trajectory import Trajectory
from rbjax.progress import Say, progress_line
from rbjax.recommend.recommendation import Recommendation, check_request, double, fastest

#: the name of contacts as force elements with adaptive steps
COMPLIANT = "compliant"
#: the steps of the reference in a step, and its Gauss-Seidel sweeps
FINER, SWEEPS = 8, 100
#: share of the accuracy by which the weight presses in a compliant contact
PRESSED = 0.25
#: m/s^2, by which the weight is defined
STANDARD_GRAVITY = 9.81
#: seconds for the measurement of a law's time
SECONDS = 0.2
MOST_STEPS = 100_000
#: the measures of a law, with the words of the reason
MEASURES = {
    "penetration": "presses in by {:.1e} m",
    "creep": "slips {:.1e} m more or less than with rigid friction",
    "lift": "gains the energy of a lift by {:.1e} m",
}


class LawTrial(NamedTuple):
    """The measures of a law on the motion."""

    name: str  # the law
    penetration: float  # m, the largest overlap of two surfaces
    creep: float  # m, the largest difference of a travel from the reference
    lift: float  # m, the gain of energy by the weight; nan if controls act
    unconverged: int  # the number of steps whose solver did not converge
    step_us: float  # microseconds of a step; of an adaptive solver, of the requested step
    cost: float  # microseconds per second of motion
    success: bool  # whether the measures are at most the accuracy


@displayed
@dataclass(frozen=True)
class LawRecommendation(Recommendation):
    """A law of contact: `rb.rollout(r.model, state, None, r.dt, contact=r.contact)`, or
    `rb.simulate(r.model, state, ts)` if `contact` is None.

    Fields, in addition to the fields of `Recommendation` (cost: microseconds per second of motion):
        model: the robot; for "compliant" with its force element, and no other law.
        contact: the value of `contact=`, or None for "compliant".
        dt: the step, s.
        penetration, creep, lift: the measures of the law, m.
    """

    model: Model
    contact: Any
    dt: float
    penetration: float
    creep: float
    lift: float


def contact_law(
    model: Model,
    state: State,
    accuracy: float = 1e-3,
    *,
    horizon: float = 0.25,
    dt: float | None = None,
    ctrl: ArrayLike | Source | None = None,
    restitution: float = 0.0,
    progress: bool = True,
) -> LawRecommendation:
    """Recommend a law of contact for a motion from a state.

    Each law of `rb.contact.laws` runs with the step dt, and `rb.contact.CompliantContact` with
    adaptive steps and a stiffness that follows from the accuracy. The recommendation is the
    cheapest law whose penetration, creep and lift are at most the accuracy, measured on this
    machine. The reference is rigid contact with Coulomb friction and Newton's restitution. Limits
    and friction loss of joints are in all laws except "compliant".

    Args:
        model: the robot, with contacts, as `rb.load` makes it.
        state: initial q (nq,), v (nv,), before or in the contact.
        accuracy: m, the largest penetration, creep and lift.
        horizon: duration of the motion, s. Choose the part in which the robot touches.
        dt: the step, s; the model's timestep if None.
        ctrl: controls as for `rb.rollout`; None for no actuation. Lift is not measured with them.
        restitution: e of the reference and of "impulse"; the restitution of the other
            laws follows from their parameters.
        progress: whether to display the progress on the terminal.

    Returns:
        `LawRecommendation`.

    Raises:
        InputError: a state of the wrong type or shape, or not finite; a model without contacts; an
            accuracy, a horizon or a step that is not positive; no law is accurate enough.

    It compiles one program for each law (four) and two for the reference and the measures, and
    computes in f64.

    Source: Acary & Brogliato, *Numerical Methods for Nonsmooth Dynamical Systems*, ch. 1.

    Example: a box that slides
        >>> import rbjax as rb
        >>> box = '''<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.1">
        ...     <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
        ...     <geom type="box" size="0.1 0.1 0.1"/></body></worldbody></mujoco>'''
        >>> model = rb.load(box)
        >>> r = rb.recommend.contact_law(model, rb.State([0.0, 0.0], [1.0, 0.0]), 5e-3)
        >>> r.name in rb.contact.laws(), r.penetration < 5e-3
        (True, True)
    """
    check_request(accuracy, progress, horizon=horizon, **({} if dt is None else {"dt": dt}))
    real_number("recommend", "restitution", restitution, least=0.0, most=1.0)
    with jax.enable_x64(True):
        state = check_arrays("recommend", model, {"state": state})["state"]
        if callable(ctrl):
            check_takes("recommend", "ctrl", ctrl, "t", "state")
        pairs = chosen_pairs("recommend", model, None)
        if not pairs:
            raise InputError(
                "recommend: no geoms of the model may touch, so there is no law to choose"
            )
        model, state = jax.tree.map(double, (model, state))
        step = float(model.timestep if dt is None else dt)
        steps = integer("recommend", "horizon / dt", round(float(horizon) / step), least=2)
        with progress_line("recommend", progress) as say:
            runs = _Runs(model, state, step, steps, ctrl, float(accuracy), restitution, say)
            return _recommended(runs)


class _Runs:
    """Trial runs of a model from a state, by each law."""

    def __init__(
        self, model: Model, state: State, dt: float, steps: int, ctrl: Any, accuracy: float,
        restitution: float, say: Say,
    ):  # fmt: skip
        self.model, self.state, self.dt, self.steps = (
            model,
            State(state.q, state.v, state.x),
            dt,
            steps,
        )
        self.ctrl, self.accuracy, self.say = ctrl, accuracy, say
        self.weight = float(model.bodies.mass.sum()) * STANDARD_GRAVITY
        self.free = model.replace(contact=None)
        self._restitution = restitution
        self._measured = jax.jit(jax.vmap(self._measures_at))

    def law(self, name: str) -> Any:
        """Return the value of `contact=` for the law of a name."""
        if name == "impulse":
            return MoreauContact.of(self.model, restitution=self._restitution)
        return laws()[name](self.model)

    def compliant(self) -> Model:
        """Return the model with compliant contacts, and no other law."""
        depth = PRESSED * self.accuracy
        element = CompliantContact.of(
            self.free, stiffness=self.weight / depth**1.5, dissipation=10.0,
            slip_speed=0.5 * self.accuracy / (self.steps * self.dt),
        )  # fmt: skip
        return self.free.with_forces(element)

    def reference(self) -> Trajectory:
        law = MoreauContact.of(self.model, restitution=self._restitution, sweeps=SWEEPS)
        return self._rolled(law, self.dt / FINER, FINER)

    def run(self, name: str) -> Callable[[], Trajectory]:
        """Return the function that computes the motion by a law."""
        if name != COMPLIANT:
            law = self.law(name)
            return lambda: self._rolled(law, self.dt, 1)
        model, ts = self.compliant(), jnp.asarray(self.dt * np.arange(self.steps + 1))
        ctrl = self.ctrl
        if ctrl is not None and not callable(ctrl) and jnp.ndim(ctrl) == 1:
            ctrl = jnp.asarray(ctrl)
        return lambda: jax.block_until_ready(
            simulate(model, self.state, ts, ctrl, throw=False, max_steps=MOST_STEPS)
        )

    def _rolled(self, law: Any, dt: float, every: int) -> Trajectory:
        ctrl = self.ctrl
        if ctrl is not None and not callable(ctrl) and jnp.ndim(ctrl) == 2:
            ctrl = jnp.repeat(jnp.asarray(ctrl), every, 0)
        path, _, _ = run_rollout(
            self.model, self.state, ctrl, dt, dynamics=law, save_every=every,
            steps=self.steps * every,
        )  # fmt: skip
        return jax.block_until_ready(path)

    def measures(self, path: Trajectory) -> tuple[float, float, np.ndarray]:
        """Measure the penetration and the lift, and the travel (T, n) of each contact."""
        distance, slip, energy = map(np.asarray, self._measured(path.q, path.v))
        travel = np.cumsum(np.where(distance < self.accuracy, slip, 0.0), 0) * self.dt
        lift = (
            math.nan if self.ctrl is not None else float((energy - energy[0]).max()) / self.weight
        )
        return max(0.0, float(-distance.min())), lift, travel

    def _measures_at(self, q: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        contacts = contacts_at(self.model, q, jnp.inf, chosen_pairs("recommend", self.model, None))
        J = contact_jacobian(self.model, q, contacts)
        u = matvec(J.reshape(-1, self.model.nv), v).reshape(-1, 3)
        distance = jnp.where(contacts.exists, contacts.distance, jnp.inf)
        energy = kinetic_energy(self.free, q, v) + potential_energy(self.free, q)
        return distance, jnp.hypot(u[:, 1], u[:, 2]), energy

    def trial(self, name: str, rigid: np.ndarray) -> LawTrial:
        """Measure a law; `rigid` is the travel (T, n) of the reference."""
        self.say(name)
        nan = math.nan
        failed = LawTrial(name, nan, nan, nan, 0, nan, math.inf, False)
        try:
            run = self.run(name)
            path = run()
        except RbjaxError:  # a law that does not support this robot
            return failed
        if not bool(path.success):
            return failed
        penetration, lift, travel = self.measures(path)
        creep = float(np.abs(travel - rigid).max())
        left = int(path.unconverged)
        good = not max(penetration, creep) > self.accuracy and not lift > self.accuracy
        us = 1e6 * fastest(run, SECONDS) / self.steps
        return LawTrial(name, penetration, creep, lift, left, us, us / self.dt, good and left == 0)


def _recommended(runs: _Runs) -> LawRecommendation:
    runs.say("the reference")
    reference = runs.reference()
    if not bool(reference.success):
        raise InputError(
            f"recommend: the motion with rigid contacts has values that are not finite at steps of "
            f"{runs.dt / FINER:.2g} s; give a smaller dt"
        )
    *_, rigid = runs.measures(reference)
    trials = [runs.trial(name, rigid) for name in (*laws(), COMPLIANT)]
    good = [x for x in trials if x.success]
    if not good:
        known = [x for x in trials if math.isfinite(x.cost)]
        why = "; ".join(f"{x.name} {_fault(x)}" for x in known)
        raise InputError(
            f"recommend: no law is within {runs.accuracy:.1e} m with steps of {runs.dt:.2g} s over "
            f"{runs.steps * runs.dt:.3g} s: {why or 'no law moves this robot'}; give a smaller "
            "dt or a larger accuracy"
        )
    best = min(good, key=lambda x: x.cost)
    model, contact = (runs.compliant(), None) if best.name == COMPLIANT else (
        runs.model, runs.law(best.name))  # fmt: skip
    return LawRecommendation(
        best.name, best.cost, tuple(trials), _reason(best, trials, runs.accuracy, rigid), model,
        contact, runs.dt, best.penetration, best.creep, best.lift,
    )  # fmt: skip


def _fault(trial: LawTrial) -> str:
    """Explain which measure of a law is the worst, or that its solver did not converge."""
    if trial.unconverged:
        return f"does not converge in {trial.unconverged} steps"
    worst = max(MEASURES, key=lambda name: np.nan_to_num(getattr(trial, name)))
    return MEASURES[worst].format(getattr(trial, worst))


def _reason(best: LawTrial, trials: list[LawTrial], accuracy: float, rigid: np.ndarray) -> str:
    others = [x for x in trials if x is not best and math.isfinite(x.cost)]
    lost = ", ".join(f"{x.name} {_fault(x)}" for x in others if not x.success)
    nearest = min((x for x in others if x.success), key=lambda x: x.cost, default=None)
    parts = ["no contact slips in this motion"] if not rigid.any() else []
    parts += [f"accuracy decides: {lost}"] if lost else []
    if nearest is not None:
        ratio = f"{nearest.name} takes {nearest.cost / best.cost:.2g} times as long"
        parts.append(ratio if lost else f"cost decides: {ratio}")
    parts.append(
        f"{best.name} presses in by {best.penetration:.1e} m, creeps {best.creep:.1e} m "
        f"(requested: {accuracy:.1e} m) at {best.step_us:.2g} us a step"
    )
    return "; ".join(parts)
