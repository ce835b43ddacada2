"""Trial runs of a manoeuvre of a wheeled robot at its fidelities: motions, stability, contacts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import compiler_options
from rbjax.lanes import Lane, add, mul
from rbjax.model import State
from rbjax.progress import Say
from rbjax.recommend.halved_steps import HalvedSteps
from rbjax.stability.runs.largest_step import stable_step
from rbjax.wheeled.kinematics.parameters import Parameters, stack_lanes
from rbjax.wheeled.models.forces import wheel_loads
from rbjax.wheeled.models.robot_model import RobotModel, as_state, with_twist
from rbjax.wheeled.models.rolling import RollingModel
from rbjax.wheeled.models.slipping import Slipping
from rbjax.wheeled.motion.rollout import Lists, advance

#: the number of times at which poses are compared and contacts computed
MOST_LOOKS = 64


class Manoeuvre(HalvedSteps):
    """Initial state, controls and times of a manoeuvre, common to all fidelities of a robot.

    Controls are constant over a step, as in `rbjax.wheeled.rollout`. Controls in a table (steps,
    nu) are constant over the table's steps dt.
    """

    most_steps = 1_000_000
    cure = "give a larger accuracy, a shorter manoeuvre, or tyres with a larger smooth_speed"

    def __init__(
        self, models: Sequence[RobotModel], q: jax.Array, twist: jax.Array, controls: Any,
        dt: float, steps: int, accuracy: float, say: Say,
    ):  # fmt: skip
        super().__init__(dt, accuracy, say)
        self.models = {x.name: x for x in models}
        self.q, self.twist, self.controls, self._steps = q, twist, controls, steps
        self._ends = np.round(np.linspace(0, steps, min(MOST_LOOKS, steps) + 1)).astype(int)
        self.times = dt * self._ends
        self.seconds = dt * steps
        #: fidelity -> the least number of halvings at which steps are stable
        self.least: dict[str, int] = {}

    def steps(self, k: int) -> int:
        return self._steps << k

    def start(self, model: RobotModel) -> State:
        """Return the initial state at a fidelity, in which no wheel slides."""
        return with_twist(model, self.q, self.twist)

    def control(self, t: Any, step: Any, state: State) -> jax.Array:
        """Return the controls (nu,) at time t, which is within the step of index `step`."""
        if callable(self.controls):
            return jnp.asarray(self.controls(t, state), jnp.float64)
        return self.controls[jnp.minimum(step, len(self.controls) - 1)]

    def arguments(self, k: int) -> tuple:
        return jnp.asarray(1 << k), jnp.asarray(self.dt(k))

    def motion(self, name: str) -> Callable[..., State]:
        """Return the function (number of parts of each step dt, length of a part) -> states at
        `times`.

        The first state is the initial one.
        """
        model, counts = self.models[name], np.diff(self._ends)

        def run(parts: Any, h: Any) -> State:
            context = model.context(self.start(model))

            def once(_: Any, x: tuple[Any, Lists]) -> tuple[Any, Lists]:
                i, y = x
                u = self.control(i * h, i // parts, as_state(*y, jnp.float64))
                given = [u[k] for k in range(model.nu)]
                return i + 1, advance(model, context.n, y, given, h, "rk4")

            def look(x: tuple[Any, Lists], count: Any) -> tuple[tuple[Any, Lists], State]:
                x = jax.lax.fori_loop(0, count * parts, once, x)
                return x, as_state(*x[1], jnp.float64)

            begin = context.q, context.v, context.x
            later = jax.lax.scan(look, (jnp.asarray(0), begin), counts)[1]
            first = as_state(*begin, jnp.float64)
            return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, later)

        return run

    def deviation(self, a: State, b: State) -> float:
        """Return the largest deviation of the chassis' position, m, or heading, rad."""
        off = np.asarray(a.q[:, :3] - b.q[:, :3])
        if not np.isfinite(off).all():
            return math.inf
        return float(max(np.hypot(off[:, 0], off[:, 1]).max(), np.abs(off[:, 2]).max()))

    def converge_stably(self, name: str) -> int:
        """Halve the step until the motion has converged and is stable. Return the number of
        halvings."""
        model = self.models[name]
        least = self._stable_halvings(model, jax.tree.map(lambda x: x[None], self.start(model)))
        while True:
            k = self.converge(name, least)
            least = self.least[name] = self._stable_halvings(model, self.path(name, k))
            if least < k:
                return k

    def along(self, path: State, look: Callable[[State, jax.Array], Any]) -> np.ndarray:
        """Apply `look` to each state of a path and its controls. The path may end before the
        manoeuvre."""
        count = len(path.q)

        def one(state: State, t: Any, step: Any) -> Any:
            return look(state, self.control(t, step, state))

        every = jax.jit(jax.vmap(one), compiler_options=compiler_options())
        return np.asarray(every(path, self.times[:count], self._ends[:count]))

    def _stable_halvings(self, model: RobotModel, path: State) -> int:
        """Return the number of halvings at which steps are stable along a path.

        An unstable step may be invisible in the pose, because tyres that saturate bound the
        oscillation of wheel speeds.
        """
        if not model.nv:
            return 0

        def look(state: State, u: jax.Array) -> jax.Array:
            def rates(y: jax.Array) -> jax.Array:
                x = y[model.nv :] if model.nx else None
                context = model.context(State(state.q, y[: model.nv], x), u)
                out = [*model.accelerations(context), *model.tyre_rates(context)]
                return stack_lanes(out, jnp.float64)

            y = state.v if state.x is None else jnp.concatenate([state.v, state.x])
            return jax.jacfwd(rates)(y)

        matrices = self.along(path, look)
        if not np.isfinite(matrices).all():
            return 0
        size = matrices.shape[-1]
        whole = np.pad(matrices, ((0, 0), (size, 0), (size, 0)))  # without modes of coordinates
        limit = stable_step("rk4", whole)
        return math.ceil(math.log2(self._dt / limit)) if 0 < limit < self._dt else 0


class Demand(NamedTuple):
    """The traction that rolling without slipping requires."""

    share: float  # the largest fraction of the available traction, with loads at rest
    at: float  # the time of `share`, s


def demand(run: Manoeuvre, rolling: RollingModel, slipping: Slipping, path: State) -> Demand:
    """Compute the largest required fraction of the traction on a path of a rolling robot. It is the
    maximum over the total force on all wheels, and over the force of each shaft."""

    def look(state: State, u: jax.Array) -> jax.Array:
        context = rolling.context(state, u)
        n = context.n
        force = rolling.ground_forces(context)
        most, of_shafts = _traction(n, slipping)
        whole = jnp.hypot(force[0], force[1]) / most
        torques = force[2 + len(n.bodies) :]
        radii = [n.wheels[i].radius for i in n.layout.setters]
        each = [abs(t) / (r * x) for t, r, x in zip(torques, radii, of_shafts, strict=True)]
        return jnp.stack([whole, *each]).max()

    shares = run.along(path, look)
    k = int(shares.argmax())
    return Demand(float(shares[k]), float(run.times[k]))


def _traction(n: Parameters, slipping: Slipping) -> tuple[Lane, list[Lane]]:
    """Return the largest total force of all tyres in any direction, and of each shaft along its
    wheels, N."""
    whole: Lane = 0.0
    of_shafts: list[Lane] = [0.0] * len(n.shafts)
    for wheel, load, tyre in zip(n.wheels, wheel_loads(n), slipping.tyres, strict=True):
        along, across = tyre.limits
        whole = add(whole, mul(load, jnp.maximum(along, across)))
        of_shafts[wheel.shaft] = add(of_shafts[wheel.shaft], mul(load, along))
    return whole, of_shafts


def first_lift(run: Manoeuvre, slipping: Slipping, path: State) -> float:
    """Return the first time at which the load of a wheel is negative, s; inf if it never is."""

    def look(state: State, u: jax.Array) -> jax.Array:
        context = slipping.context(state, u)
        return stack_lanes(slipping.wheel_forces(context)[0], jnp.float64).min()

    lifted = run.along(path, look) < 0
    return float(run.times[lifted.argmax()]) if lifted.any() else math.inf
