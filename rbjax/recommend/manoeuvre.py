"""One manoeuvre of a wheeled robot at its fidelities: trial runs, deviations, costs, contacts."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import compiler_options
from rbjax.lanes import Lane, add, mul
from rbjax.model import State
from rbjax.recommend.request import fastest
from rbjax.stability.runs.largest_step import stable_step
from rbjax.wheeled.kinematics.numbers import Numbers, stacked
from rbjax.wheeled.models.fidelity import Fidelity, as_state
from rbjax.wheeled.models.loads import wheel_loads
from rbjax.wheeled.models.rolling import Rolling
from rbjax.wheeled.models.slipping import Slipping
from rbjax.wheeled.models.states import with_twist
from rbjax.wheeled.motion.rollout import Lists, advanced

MOST_LOOKS = 64  # times at which poses are compared and contacts looked at
MOST_STEPS = 1_000_000
SECONDS = 0.05  # of the clock, at least


class Manoeuvre:
    """A start, controls and times, which all fidelities of a robot share.

    Steps are dt / 2^halvings. Controls are constant over a step, as in `rbjax.wheeled.rollout`;
    those of a table (steps, nu) over its own steps of dt.
    """

    def __init__(self, q: jax.Array, twist: jax.Array, controls: Any, dt: float, steps: int):
        self.q, self.twist, self.controls = q, twist, controls
        self._dt, self._steps = dt, steps
        ends = np.round(np.linspace(0, steps, min(MOST_LOOKS, steps) + 1)).astype(int)
        self._ends, self._counts = ends, np.diff(ends)
        self._programs: dict[str, Callable] = {}

    def dt(self, halvings: int) -> float:
        return self._dt / 2**halvings

    def steps(self, halvings: int) -> int:
        return self._steps << halvings

    @property
    def times(self) -> np.ndarray:
        return self._dt * self._ends

    def start(self, vehicle: Fidelity) -> State:
        """The state in which no wheel slides."""
        return with_twist(vehicle, self.q, self.twist)

    def control(self, t: Any, step: Any, state: State) -> jax.Array:
        """The controls (nu,) at a time, in a step of dt."""
        if callable(self.controls):
            return jnp.asarray(self.controls(t, state), jnp.float64)
        return self.controls[jnp.minimum(step, len(self.controls) - 1)]

    def path(self, vehicle: Fidelity, halvings: int) -> State:
        """The states at `times`, the first at the start."""
        if vehicle.name not in self._programs:
            self._programs[vehicle.name] = self._program(vehicle)
        parts = jnp.asarray(1 << halvings), jnp.asarray(self.dt(halvings))
        return jax.block_until_ready(self._programs[vehicle.name](*parts))

    def _program(self, vehicle: Fidelity) -> Callable:
        """(parts of a step of dt, a part) -> states; one program for all steps."""

        def run(parts: Any, h: Any) -> State:
            n, now = vehicle.instant(self.start(vehicle))

            def once(_: Any, x: tuple[Any, Lists]) -> tuple[Any, Lists]:
                i, y = x
                u = self.control(i * h, i // parts, as_state(*y, jnp.float64))
                given = [u[k] for k in range(vehicle.nu)]
                return i + 1, advanced(vehicle, n, y, given, h, "rk4")

            def look(x: tuple[Any, Lists], count: Any) -> tuple[tuple[Any, Lists], State]:
                x = jax.lax.fori_loop(0, count * parts, once, x)
                return x, as_state(*x[1], jnp.float64)

            begin = now.q, now.v, now.x
            later = jax.lax.scan(look, (jnp.asarray(0), begin), self._counts)[1]
            first = as_state(*begin, jnp.float64)
            return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, later)

        return jax.jit(run, compiler_options=compiler_options())

    def step_us(self, vehicle: Fidelity, halvings: int) -> float:
        """Microseconds of a step, of the fastest run."""
        run = functools.partial(self.path, vehicle, halvings)
        return 1e6 * fastest(run, SECONDS) / self.steps(halvings)

    def along(self, path: State, look: Callable[[State, jax.Array], Any]) -> np.ndarray:
        """`look` of the states of a path, or of its first states, and their controls."""
        count = len(path.q)

        def one(state: State, t: Any, step: Any) -> Any:
            return look(state, self.control(t, step, state))

        every = jax.jit(jax.vmap(one), compiler_options=compiler_options())
        return np.asarray(every(path, self.times[:count], self._ends[:count]))

    def stable_halvings(self, vehicle: Fidelity, path: State) -> int:
        """Those that make steps stable along a path: every mode that decays then does so in steps.

        A step that is too large need not show in the pose: tyres that saturate hold the speeds of
        wheels that chatter.
        """
        if not vehicle.nv:
            return 0

        def look(state: State, u: jax.Array) -> jax.Array:
            def rates(y: jax.Array) -> jax.Array:
                x = y[vehicle.nv :] if vehicle.nx else None
                n, now = vehicle.instant(State(state.q, y[: vehicle.nv], x), u)
                out = [*vehicle.accelerations(n, now), *vehicle.relaxation(n, now)]
                return stacked(out, jnp.float64)

            y = state.v if state.x is None else jnp.concatenate([state.v, state.x])
            return jax.jacfwd(rates)(y)

        matrices = self.along(path, look)
        if not np.isfinite(matrices).all():
            return 0
        size = matrices.shape[-1]
        whole = np.pad(matrices, ((0, 0), (size, 0), (size, 0)))  # modes of coordinates left out
        limit = stable_step("rk4", whole)
        return math.ceil(math.log2(self._dt / limit)) if 0 < limit < self._dt else 0


def apart(a: State, b: State) -> float:
    """The largest deviation of the chassis' place, m, or heading, rad."""
    off = np.asarray(a.q[:, :3] - b.q[:, :3])
    if not np.isfinite(off).all():
        return math.inf
    return float(max(np.hypot(off[:, 0], off[:, 1]).max(), np.abs(off[:, 2]).max()))


class Demand(NamedTuple):
    """What rolling needs of the ground. Fields: share, at least so much of the traction that tyres
    give under loads at rest; at, its time in s."""

    share: float
    at: float


def demand(run: Manoeuvre, rolling: Rolling, slipping: Slipping, path: State) -> Demand:
    """The largest share on a path of a fidelity that rolls, of the force on all wheels together and
    of that of each shaft."""

    def look(state: State, u: jax.Array) -> jax.Array:
        n, now = rolling.instant(state, u)
        force = rolling.holding(n, now)
        most, of_shafts = _traction(n, slipping)
        whole = jnp.hypot(force[0], force[1]) / most
        torques = force[2 + len(n.bodies) :]
        radii = [n.wheels[i].radius for i in n.layout.setters]
        each = [abs(t) / (r * x) for t, r, x in zip(torques, radii, of_shafts, strict=True)]
        return jnp.stack([whole, *each]).max()

    shares = run.along(path, look)
    k = int(shares.argmax())
    return Demand(float(shares[k]), float(run.times[k]))


def _traction(n: Numbers, slipping: Slipping) -> tuple[Lane, list[Lane]]:
    """The most that tyres give in any direction, N: of all wheels, and along those of a shaft."""
    whole: Lane = 0.0
    of_shafts: list[Lane] = [0.0] * len(n.shafts)
    for wheel, load, tyre in zip(n.wheels, wheel_loads(n), slipping.tyres, strict=True):
        along, across = tyre.limits
        whole = add(whole, mul(load, jnp.maximum(along, across)))
        of_shafts[wheel.shaft] = add(of_shafts[wheel.shaft], mul(load, along))
    return whole, of_shafts


def first_lift(run: Manoeuvre, slipping: Slipping, path: State) -> float:
    """When the ground would first have to pull a wheel, s; inf if it never does."""

    def look(state: State, u: jax.Array) -> jax.Array:
        n, now = slipping.instant(state, u)
        return stacked(slipping.forces(n, now)[0], jnp.float64).min()

    lifted = run.along(path, look) < 0
    return float(run.times[lifted.argmax()]) if lifted.any() else math.inf
