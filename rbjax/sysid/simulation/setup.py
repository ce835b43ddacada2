"""What a recording would have read: the motion of a set-up under its commands, and its sensors.

    u_k = controller(t_k, readings_k, command_k)   acts from t_k + delay to t_(k+1) + delay
    x'  = f(model, x, u),     reading(t) = scale * h(t - delay, x, u) + bias
Commands come with a period and are held. A delay of any length is continuous and differentiable:
the period in which a command takes over is integrated in two parts. Between two instants of the
grid the motion is a cubic through both states (Hermite); states of force elements are linear
between them. h is the ideal sensor (`rbjax.sensors`).
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
from rbjax.motion.integrators import Integrator
from rbjax.motion.step import step
from rbjax.sensors import Columns, Context, Sensor, sensor_of
from rbjax.sysid.simulation.segments import in_segments

#: (t, reading, command (n,)) -> ctrl (nu,), called once for each command
Controller = Callable[[Any, State, jax.Array], jax.Array]


class Calibration(Record):
    """reading = scale * value(t - delay) + bias, a number for each channel; delay in s."""

    bias: jax.Array
    scale: jax.Array
    delay: jax.Array

    @classmethod
    def ideal(cls, channels: int) -> Calibration:
        """The calibration of an ideal sensor."""
        return cls(jnp.zeros(channels), jnp.ones(channels), jnp.zeros(()))


class PD(Record):
    """A servo that runs once a command: ctrl = kp (command - q) - kd v, of the readings; kp, kd
    (nu,). Its joints are those of the model, in order."""

    kp: jax.Array
    kd: jax.Array

    def __call__(self, t: Any, reading: State, command: jax.Array) -> jax.Array:
        return self.kp * (command - reading.q) - self.kd * reading.v


class Setup(Record):
    """All of an experiment that has numbers, so all that can be unknown.

    Fields: model; sensors by name: "q" (nq channels), "v" (nv), and those of `with_sensors`;
    controller, None where commands are the controls; delay of the controls in s, None for none;
    readings, the ideal sensors of names that are not registered.

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
        """With ideal sensors."""
        sensors = {"q": Calibration.ideal(model.nq), "v": Calibration.ideal(model.nv)}
        return cls(model, sensors, controller, None if delay is None else jnp.asarray(delay))

    def with_sensors(self, *added: str | Mapping[str, Sensor]) -> Setup:
        """The set-up with more ideal sensors, each on its own clock; bias, scale and delay are
        leaves, which can be unknown: `Unknown("sensors.gyro:imu.bias")`.

        Args:
            added: names of sensors: "a", "tau", "pose:BODY", "pose:SITE", "position:SITE",
                "gyro:SITE", "accelerometer:SITE"; or a dict name ->
                sensor of `rbjax.sensors`, such as {"current": Currents(constant)} or
                {"other:height": CustomSensor(...)}.

        Raises:
            UnknownName: a sensor, body or site that is not known.

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
        """The ideal sensor of a name."""
        return self.readings[name] if name in self.readings else sensor_of(name)

    def columns(self, sensor: str) -> Columns:
        """The columns of a sensor."""
        return self.sensor(sensor).columns(self.model)

    def unit(self, sensor: str) -> str:
        """The unit of a sensor, in SI."""
        return self.sensor(sensor).unit(self.model)


class Grid(NamedTuple):
    """How motion is integrated.

    Fields:
        period: seconds a command is held.
        substeps: steps of integration in it. 0, in `identify` and `many_starts`: as many as the
            recordings need, by a check with steps of half the length.
        integrator: as in `rollout`.
        longest_delay: periods that a command may be late, 0 for none.
    """

    period: float
    substeps: int = 1
    integrator: str | Integrator = "rk4"
    longest_delay: int = 0


class Path(NamedTuple):
    """A motion: the states (N + 1, ...) at the instants of N commands and one period later, and the
    controls (N, nu) that were asked for at these instants."""

    q: jax.Array
    v: jax.Array
    x: jax.Array | None
    ctrls: jax.Array


def motion(
    made: Callable[[jax.Array], Setup], p: jax.Array, start: State, commands: jax.Array, grid: Grid,
    *, keep: int | None = None, count: int = 1,
) -> Path:  # fmt: skip
    """The motion of the set-up made(p) under commands (N, n). Numbers that p does not change stay
    known, which the program needs to be fast. keep: a reverse derivative keeps every keep-th state
    and simulates again what lies between; None: it keeps all that each period computes. count: of
    segments that are simulated side by side; more than one have no reverse derivative."""
    states, ctrls = stepped(lambda p: ready(made(p)), p, start, commands, grid, keep, count)
    return Path(states.q, states.v, states.x, commands if ctrls is None else ctrls)


def stepped(
    made: Callable[[Any], Setup], p: Any, start: State, commands: jax.Array, grid: Grid,
    keep: int | None = None, count: int = 1,
) -> tuple[State, jax.Array | None]:  # fmt: skip
    """`moved` of the set-up made(p), a thread a sample or a segment of it."""
    if count == 1 or keep is not None:
        run = threads(lambda p, start, commands: moved(made(p), start, commands, grid, keep))
        return run(p, start, commands)

    def segment(p: Any, begins: Any, commands: jax.Array) -> Any:
        once = period(made(p), grid)
        (_, *carry), shown = jax.lax.scan(once, begins, commands)
        return tuple(carry), shown

    def one(p: Any, begins: Any, commands: jax.Array) -> Any:
        return threads(segment)(p, (begins[0], *begins[1]), commands)

    first = beginning(made(p), start, commands, grid)[1:]
    after, ctrls = in_segments(one, p, first, commands, count)
    return _begun(start, after), ctrls


def ready(setup: Setup) -> Setup:
    """The set-up as programs of threads are shortest: the numbers of its links made before the
    steps, and equal limbs a loop. A derivative of steps then takes half as long to compile."""
    model = setup.model
    if not kernels_available():
        return setup
    if model.driver == "auto":
        model = model.replace(driver="limbs")
    return setup.replace(model=with_constants(model, model.gravity.dtype))


def moved(
    setup: Setup, start: State, commands: jax.Array, grid: Grid, keep: int | None
) -> tuple[State, jax.Array | None]:
    """The states, and the controls where these are not the commands."""
    carry = beginning(setup, start, commands, grid)
    after, ctrls = _swept(period(setup, grid), carry, commands, keep)
    return _begun(start, after), ctrls


def _begun(start: State, after: State) -> State:
    """The states of a motion, of which the start is the first."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, after)


def beginning(setup: Setup, start: State, commands: jax.Array, grid: Grid) -> tuple[Any, ...]:
    """What the first period starts from: its place, the state and, where controls come late, those
    that wait."""
    zero = jnp.zeros((), int)
    if not _is_late(setup, grid):
        return zero, start
    ctrl = jax.eval_shape(functools.partial(_asked, setup, grid), zero, start, commands[0])
    return zero, start, jnp.zeros((grid.longest_delay + 2, *ctrl.shape), ctrl.dtype)


def _is_late(setup: Setup, grid: Grid) -> bool:
    return setup.delay is not None and grid.longest_delay > 0


def _asked(setup: Setup, grid: Grid, k: Any, state: State, command: jax.Array) -> jax.Array:
    """The controls that the command of a period asks for."""
    if setup.controller is None:
        return command
    read = [s.scale * x + s.bias for s, x in ((setup.sensors[i], getattr(state, i)) for i in "qv")]
    return setup.controller(k * grid.period, State(*read), command)


def period(setup: Setup, grid: Grid) -> Callable[[Any, jax.Array], Any]:
    """A period as a step of `scan`: (what it starts from, its command) -> what the next one starts
    from, and the state there with the controls, where these are not the commands."""
    model, T, n = setup.model, grid.period, grid.substeps
    asked = functools.partial(_asked, setup, grid)

    def advanced(state: State, ctrl: jax.Array, h: Any, t: Any) -> State:
        return step(model, state, ctrl, h, t=t, integrator=grid.integrator)

    def kept(ctrl: jax.Array) -> jax.Array | None:
        return None if setup.controller is None else ctrl

    def at_once(carry: Any, command: jax.Array) -> Any:
        k, state = carry
        now, h = asked(k, state, command), jnp.asarray(T / n, state.q.dtype)

        def once(i: Any, s: State) -> State:
            return advanced(s, now, h, k * T + i * h)

        state = once(0, state) if n == 1 else jax.lax.fori_loop(0, n, once, state)
        return (k + 1, state), (state, kept(now))

    def late(carry: Any, command: jax.Array) -> Any:
        k, state, queue = carry
        now = asked(k, state, command)
        fresh = jnp.broadcast_to(now, queue.shape)  # before the first one acts, the first one
        queue = jnp.where(k == 0, fresh, jnp.concatenate([now[None], queue[:-1]]))
        delay = jnp.clip(setup.delay, 0.0, grid.longest_delay * T)
        # the last whole period counts as a full one, so that a delay at its end has a derivative
        whole = jnp.clip(jnp.ceil(delay / T).astype(int) - 1, 0)
        rest = delay - whole * T
        before, after = queue[whole + 1], queue[whole]

        def once(i: Any, s: State) -> State:  # the old command's steps, then the new one's
            old = i < n
            h = jnp.where(old, rest, T - rest) / n
            t = k * T + jnp.where(old, i * h, rest + (i - n) * h)
            return advanced(s, jnp.where(old, before, after), h, t)

        state = jax.lax.fori_loop(0, 2 * n, once, state)
        return (k + 1, state, queue), (state, kept(now))

    return late if _is_late(setup, grid) else at_once


def _swept(once: Callable, carry: Any, commands: jax.Array, keep: int | None) -> Any:
    """What is there after each command. A reverse derivative keeps every keep-th carry."""
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


def reading(setup: Setup, path: Path, grid: Grid, kind: str, times: jax.Array) -> jax.Array:
    """What a sensor reads (T, n) at times (T,) after the start."""
    sensor, shows = setup.sensors[kind], setup.sensor(kind)
    read = jax.vmap(lambda t: shows(_context(setup, path, grid, t)))(times - sensor.delay)
    return sensor.scale * read + sensor.bias


def _context(setup: Setup, path: Path, grid: Grid, t: Any) -> Context:
    """An instant between two of the grid. A sample within a thousandth of a period before a command
    sees it."""
    T, last = grid.period, path.q.shape[0] - 2
    delayed = setup.delay is not None and grid.longest_delay > 0
    late = jnp.clip(setup.delay, 0.0, grid.longest_delay * T) if delayed else 0.0
    ctrl = path.ctrls[jnp.clip(jnp.floor((t - late) / T + 1e-3).astype(int), 0, last)]
    state = _between(setup.model, path, T, t)
    return Context.of(setup.model, t, state, ctrl, T / grid.substeps)


def _between(model: Model, path: Path, T: float, t: Any) -> State:
    """The state at a time, from the cubic of the interval in which it lies."""
    last = path.q.shape[0] - 2
    k = jnp.clip(jnp.floor(t / T + 1e-9).astype(int), 0, last)
    s = jnp.clip(t / T - k, 0.0, 1.0)
    q0, q1, v0, v1 = path.q[k], path.q[k + 1], path.v[k], path.v[k + 1]
    adds = model.nq == model.nv  # without attitudes XLA makes one pass of all this
    d = q1 - q0 if adds else difference(model, q0, q1)
    a, b = T * v0 - d, d - T * v1
    along = s * d + s * (1 - s) * ((1 - s) * a + s * b)
    v = (d + (1 - 2 * s) * ((1 - s) * a + s * b) + s * (1 - s) * (b - a)) / T
    x = None if path.x is None else (1 - s) * path.x[k] + s * path.x[k + 1]
    return State(q0 + along if adds else integrate(model, q0, along), v, x)
