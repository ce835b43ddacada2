"""Simulation of a set-up: a model with its sensors, a controller and a delay, under commands.

    u_k = controller(t_k, readings_k, command_k)   acts from t_k + delay to t_(k+1) + delay
    x'  = f(model, x, u),     reading(t) = scale * h(t - delay, x, u) + bias
Commands hold for one period. h is the ideal sensor (`rbjax.sensors`). The motion is differentiable
with respect to the delay, since the period in which a new command begins to act is integrated in
two parts. Between grid points the motion is a cubic Hermite interpolant, and states of force
elements are linear.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.compiler import kernels_available, threads
from rbjax.dynamics.algorithms.manifold import difference, integrate
from rbjax.model import Model, State
from rbjax.model.links import with_constants
from rbjax.model.record import Record
from rbjax.motion.field import dynamics_of, free_motion
from rbjax.motion.integrators import Integrator, default_integrator
from rbjax.motion.step import step
from rbjax.sensors import Columns, Context, Sensor, sensor_of
from rbjax.sysid.simulation.parallel_in_time import simulate_windows

#: (t, reading, command (n,)) -> ctrl (nu,), called once for each command
Controller = Callable[[Any, State, jax.Array], jax.Array]


class Calibration(Record):
    """Calibration of a sensor: reading = scale * value(t - delay) + bias.

    `bias` and `scale` are (columns,) in units of the sensor and 1. `delay` is in s.
    """

    bias: jax.Array
    scale: jax.Array
    delay: jax.Array

    @classmethod
    def ideal(cls, channels: int) -> Calibration:
        """Create the calibration of an ideal sensor."""
        return cls(jnp.zeros(channels), jnp.ones(channels), jnp.zeros(()))


class PD(Record):
    """A PD servo: ctrl = kp (command - q) - kd v, with the readings of q and v.

    It is evaluated once for each command. kp and kd (nu,) are in the order of the joints.
    """

    kp: jax.Array
    kd: jax.Array

    def __call__(self, t: Any, reading: State, command: jax.Array) -> jax.Array:
        return self.kp * (command - reading.q) - self.kd * reading.v


class Setup(Record):
    """A model with its sensors, controller and delay. All parameters can be unknown.

    Fields:
        model: robot.
        sensors: name -> `Calibration`, for "q" (nq columns), "v" (nv) and the sensors of
            `with_sensors`.
        controller: `Controller`; None if the commands are the controls.
        delay: delay of the controls in s; None for no delay.
        readings: name -> ideal sensor, for names that are not registered.

    Example:
        >>> import rbjax as rb
        >>> setup = rb.sysid.Setup.of(rb.load("pendulum"))
        >>> sorted(setup.sensors)
        ['q', 'v']
    """

    model: Model
    sensors: dict[str, Calibration]
    controller: Any = None
    delay: Any = None
    readings: dict[str, Any] = eqx.field(default_factory=dict)

    @classmethod
    def of(cls, model: Model, controller: Controller | None = None, delay: Any = None) -> Setup:
        """Create the set-up of a model with ideal sensors of q and v."""
        sensors = {"q": Calibration.ideal(model.nq), "v": Calibration.ideal(model.nv)}
        return cls(model, sensors, controller, None if delay is None else jnp.asarray(delay))

    def with_sensors(self, *added: str | Mapping[str, Sensor]) -> Setup:
        """Add ideal sensors, each with its own clock.

        Bias, scale and delay are leaves that can be unknown: `Unknown("sensors.gyro:imu.bias")`.

        Args:
            added: names of sensors: "a", "tau", "pose:BODY", "pose:SITE", "position:SITE",
                "gyro:SITE", "accelerometer:SITE"; or a dict name -> sensor of `rbjax.sensors`, such
                as {"current": Currents(constant)} or {"other:height": CustomSensor(...)}.

        Raises:
            UnknownName: an unknown sensor, body or site.

        Example:
            >>> import rbjax as rb
            >>> arm = rb.sysid.Setup.of(rb.load("arm7"))
            >>> arm.with_sensors("gyro:tool", "position:tool").sensors["gyro:tool"].bias.shape
            (3,)
        """
        readings = dict(self.readings)
        sensors = dict(self.sensors)
        for one in added:
            given = {one: sensor_of(one)} if isinstance(one, str) else dict(one)
            readings |= {} if isinstance(one, str) else given
            for name, sensor in given.items():
                sensors[name] = Calibration.ideal(sensor.columns(self.model).size)
        return Setup(self.model, sensors, self.controller, self.delay, readings)

    def sensor(self, name: str) -> Sensor:
        """Return the ideal sensor with a name."""
        return self.readings[name] if name in self.readings else sensor_of(name)

    def columns(self, sensor: str) -> Columns:
        """Return the columns of a sensor."""
        return self.sensor(sensor).columns(self.model)

    def unit(self, sensor: str) -> str:
        """Return the SI unit of a sensor."""
        return self.sensor(sensor).unit(self.model)


class Grid(NamedTuple):
    """The steps of integration.

    Fields:
        period: time in s for which a command holds.
        substeps: number of steps in a period. 0 in `identify` and `many_starts`: as many as the
            recordings need, by a check with steps of half the length.
        integrator: integrator, as in `rollout`. None: with contacts the default of `rollout`, which
            is the integrator of the file for MuJoCo's contacts, else "rk4".
        longest_delay: largest delay of a command in periods; 0 for no delay.
    """

    period: float
    substeps: int = 1
    integrator: str | Integrator | None = None
    longest_delay: int = 0

    def integrator_of(self, model: Model) -> str | Integrator:
        """Return the integrator of the steps of a model."""
        if self.integrator is not None:
            return self.integrator
        dynamics = dynamics_of("Grid", model, free_motion, None, steps=True)
        return default_integrator(dynamics, model, "rk4")


class SimulatedPath(NamedTuple):
    """A simulated motion under N commands.

    Fields:
        q, v, x: (N + 1, ...) states at the times of the commands and one period after the last.
        ctrl: (N, nu) controls before their delay.
    """

    q: jax.Array
    v: jax.Array
    x: jax.Array | None
    ctrl: jax.Array


def simulate_motion(
    made: Callable[[jax.Array], Setup], p: jax.Array, start: State, commands: jax.Array, grid: Grid,
    *, keep: int | None = None, count: int = 1,
) -> SimulatedPath:  # fmt: skip
    """Simulate the set-up made(p) under commands (N, n).

    Args:
        made: p -> set-up. Values that do not depend on p are constants of the program.
        keep: in reverse mode, save every keep-th state and recompute the others. None: save all
            values of each period.
        count: number of time windows that are simulated in parallel. More than 1 excludes reverse
            mode.
    """
    states, ctrls = simulate_states(
        lambda p: prepare_setup(made(p)), p, start, commands, grid, keep, count
    )
    return SimulatedPath(states.q, states.v, states.x, commands if ctrls is None else ctrls)


def simulate_states(
    made: Callable[[Any], Setup], p: Any, start: State, commands: jax.Array, grid: Grid,
    keep: int | None = None, count: int = 1,
) -> tuple[State, jax.Array | None]:  # fmt: skip
    """Simulate the states, with one thread for each sample or time window.

    Return the states and the controls, which are None if they are equal to the commands.
    """

    def with_start(start: State, after: State) -> State:
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, after)

    def whole(p: Any, start: State, commands: jax.Array) -> Any:
        setup = made(p)
        carry = first_carry(setup, start, commands, grid)
        after, ctrls = scan_periods(period_step(setup, grid), carry, commands, keep)
        return with_start(start, after), ctrls

    if count == 1 or keep is not None:
        return threads(whole)(p, start, commands)

    def window(p: Any, first: Any, commands: jax.Array) -> Any:
        (_, *carry), found = jax.lax.scan(period_step(made(p), grid), first, commands)
        return tuple(carry), found

    def one(p: Any, first: Any, commands: jax.Array) -> Any:
        return threads(window)(p, (first[0], *first[1]), commands)

    first = first_carry(made(p), start, commands, grid)[1:]
    after, ctrls = simulate_windows(one, p, first, commands, count)
    return with_start(start, after), ctrls


def prepare_setup(setup: Setup) -> Setup:
    """Prepare a set-up for short programs: precompute link constants, and loop over equal limbs.

    This halves the compilation time of the derivative of a step.
    """
    model = setup.model
    if not kernels_available():
        return setup
    if model.driver == "auto":
        model = model.replace(driver="limbs")
    return setup.replace(model=with_constants(model, model.gravity.dtype))


def first_carry(setup: Setup, start: State, commands: jax.Array, grid: Grid) -> tuple[Any, ...]:
    """Create the carry of the first period: its index and the state.

    With a delay it also contains the queue of controls that do not yet act.
    """
    zero = jnp.zeros((), int)
    if not _has_delay(setup, grid):
        return zero, start
    ctrl = jax.eval_shape(functools.partial(_controls, setup, grid), zero, start, commands[0])
    return zero, start, jnp.zeros((grid.longest_delay + 2, *ctrl.shape), ctrl.dtype)


def _has_delay(setup: Setup, grid: Grid) -> bool:
    return setup.delay is not None and grid.longest_delay > 0


def _controls(setup: Setup, grid: Grid, k: Any, state: State, command: jax.Array) -> jax.Array:
    """Compute the controls from the command of period k."""
    if setup.controller is None:
        return command
    read = [s.scale * x + s.bias for s, x in ((setup.sensors[i], getattr(state, i)) for i in "qv")]
    return setup.controller(k * grid.period, State(*read), command)


def period_step(setup: Setup, grid: Grid) -> Callable[[Any, jax.Array], Any]:
    """Create the step of `scan` for one period.

    It maps (carry, command) to the next carry and the outputs: the final state, and the controls,
    which are None if they are equal to the commands.
    """
    model, T, n = setup.model, grid.period, grid.substeps
    integrator = grid.integrator_of(model)
    controls = functools.partial(_controls, setup, grid)

    def advance(state: State, ctrl: jax.Array, h: Any, t: Any) -> State:
        return step(model, state, ctrl, h, t=t, integrator=integrator)

    def computed(ctrl: jax.Array) -> jax.Array | None:
        return None if setup.controller is None else ctrl

    def without_delay(carry: Any, command: jax.Array) -> Any:
        k, state = carry
        ctrl, h = controls(k, state, command), jnp.asarray(T / n, state.q.dtype)

        def once(i: Any, s: State) -> State:
            return advance(s, ctrl, h, k * T + i * h)

        state = once(0, state) if n == 1 else jax.lax.fori_loop(0, n, once, state)
        return (k + 1, state), (state, computed(ctrl))

    def with_delay(carry: Any, command: jax.Array) -> Any:
        k, state, queue = carry
        ctrl = controls(k, state, command)
        fresh = jnp.broadcast_to(ctrl, queue.shape)  # the first command also acts before its delay
        queue = jnp.where(k == 0, fresh, jnp.concatenate([ctrl[None], queue[:-1]]))
        delay = jnp.clip(setup.delay, 0.0, grid.longest_delay * T)
        # an integer delay is split into one period less and a rest of T, to be differentiable
        whole = jnp.clip(jnp.ceil(delay / T).astype(int) - 1, 0)
        rest = delay - whole * T
        before, after = queue[whole + 1], queue[whole]

        def once(i: Any, s: State) -> State:  # n steps with the old command, n with the new one
            old = i < n
            h = jnp.where(old, rest, T - rest) / n
            t = k * T + jnp.where(old, i * h, rest + (i - n) * h)
            return advance(s, jnp.where(old, before, after), h, t)

        state = jax.lax.fori_loop(0, 2 * n, once, state)
        return (k + 1, state, queue), (state, computed(ctrl))

    return with_delay if _has_delay(setup, grid) else without_delay


def scan_periods(once: Callable, carry: Any, commands: jax.Array, keep: int | None) -> Any:
    """Scan a step over the commands. In reverse mode every keep-th carry is saved."""
    if keep is None:
        return jax.lax.scan(once, carry, commands)[1]
    again = jax.checkpoint(once, prevent_cse=False)
    whole = commands.shape[0] // keep if keep > 1 else 0

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def several(carry: Any, commands: jax.Array) -> Any:
        return jax.lax.scan(again, carry, commands)

    parts = commands[: whole * keep].reshape(whole, keep, *commands.shape[1:])
    rest = commands[whole * keep :]
    found = []
    if whole:
        carry, states = jax.lax.scan(several, carry, parts)
        found.append(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states))
    if rest.shape[0]:
        found.append(jax.lax.scan(again, carry, rest)[1])
    return jax.tree.map(lambda *x: jnp.concatenate(x), *found)


def read_sensor(
    setup: Setup, path: SimulatedPath, grid: Grid, kind: str, times: jax.Array
) -> jax.Array:
    """Compute the readings (T, n) of a sensor at times (T,) after the start."""
    calibration, sensor = setup.sensors[kind], setup.sensor(kind)
    delayed = times - calibration.delay
    read = jax.vmap(lambda t: sensor(_context_at(setup, path, grid, t)))(delayed)
    return calibration.scale * read + calibration.bias


def _context_at(setup: Setup, path: SimulatedPath, grid: Grid, t: Any) -> Context:
    """Create the context of a sensor at time t.

    A command also acts on samples up to a thousandth of a period before it.
    """
    T, last = grid.period, path.q.shape[0] - 2
    late: Any = 0.0
    if _has_delay(setup, grid):
        late = jnp.clip(setup.delay, 0.0, grid.longest_delay * T)
    ctrl = path.ctrl[jnp.clip(jnp.floor((t - late) / T + 1e-3).astype(int), 0, last)]
    state = interpolate_state(setup.model, path, T, t)
    return Context.of(setup.model, t, state, ctrl, T / grid.substeps)


def interpolate_state(model: Model, path: SimulatedPath, T: float, t: Any) -> State:
    """Interpolate the state at time t by a cubic Hermite polynomial."""
    last = path.q.shape[0] - 2
    k = jnp.clip(jnp.floor(t / T + 1e-9).astype(int), 0, last)
    s = jnp.clip(t / T - k, 0.0, 1.0)
    q0, q1, v0, v1 = path.q[k], path.q[k + 1], path.v[k], path.v[k + 1]
    adds = model.nq == model.nv  # without attitudes XLA fuses all operations
    d = q1 - q0 if adds else difference(model, q0, q1)
    a, b = T * v0 - d, d - T * v1
    along = s * d + s * (1 - s) * ((1 - s) * a + s * b)
    v = (d + (1 - 2 * s) * ((1 - s) * a + s * b) + s * (1 - s) * (b - a)) / T
    x = None if path.x is None else (1 - s) * path.x[k] + s * path.x[k + 1]
    return State(q0 + along if adds else integrate(model, q0, along), v, x)
