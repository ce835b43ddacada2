"""What a recording would have read: the motion of a set-up under its commands, and its sensors.

    u_k = controller(t_k, readings_k, command_k)   acts from t_k + delay to t_(k+1) + delay
    x'  = f(model, x, u),     reading(t) = scale * x(t - delay) + bias
Commands come with a period and are held. A delay of any length is continuous and differentiable:
the period in which a command takes over is integrated in two parts. Between two instants of the
grid the motion is a cubic through both states (Hermite).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.dynamics.manifold import difference, integrate
from rbjax.model import Model, State
from rbjax.model.record import Record
from rbjax.motion.linearise import step
from rbjax.threads import threads

#: (t, reading, command (n,)) -> ctrl (nu,), called once for each command
Controller = Callable[[Any, State, jax.Array], jax.Array]


class Sensor(Record):
    """reading = scale * value(t - delay) + bias, a number for each channel; delay in s."""

    bias: jax.Array
    scale: jax.Array
    delay: jax.Array

    @classmethod
    def ideal(cls, channels: int) -> Sensor:
        """One that reads what is."""
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

    Fields: model; sensors, by what they read: "q" (nq channels), "v" (nv); controller, None where
    commands are the controls; delay of the controls in s, None for none.

    Example:
        >>> import rbjax as rb
        >>> setup = rb.sysid.Setup.of(rb.load("pendulum"))
        >>> sorted(setup.sensors)
        ['q', 'v']
    """

    model: Model
    sensors: dict[str, Sensor]
    controller: Any = None
    delay: Any = None

    @classmethod
    def of(cls, model: Model, controller: Controller | None = None, delay: Any = None) -> Setup:
        """With ideal sensors."""
        sensors = {"q": Sensor.ideal(model.nq), "v": Sensor.ideal(model.nv)}
        return cls(model, sensors, controller, None if delay is None else jnp.asarray(delay))


class Grid(NamedTuple):
    """How motion is integrated. period: seconds a command is held; substeps: steps in it;
    longest_delay: periods that a command may be late, 0 for none."""

    period: float
    substeps: int = 1
    integrator: str = "rk4"
    longest_delay: int = 0


def motion(
    made: Callable[[jax.Array], Setup], p: jax.Array, start: State, commands: jax.Array, grid: Grid,
    *, keep: int | None = None,
) -> State:  # fmt: skip
    """The states (N + 1, ...) at the instants of N commands (N, n) and one period later, of the
    set-up made(p). Numbers that p does not change stay known, which the program needs to be
    fast. keep: a reverse derivative keeps every keep-th state and simulates again what lies
    between; None: it keeps all that each period computes."""
    run = threads(lambda p, start, commands: _motion(made(p), start, commands, grid, keep))
    return run(p, start, commands)


def _motion(
    setup: Setup, start: State, commands: jax.Array, grid: Grid, keep: int | None
) -> State:
    model, T, n = setup.model, grid.period, grid.substeps
    sensors, controller = setup.sensors, setup.controller

    def advance(t: Any, state: State, ctrl: jax.Array, time: Any) -> State:
        h = time / n

        def once(i: Any, s: State) -> State:
            return step(model, s, ctrl, h, t=t + i * h, integrator=grid.integrator)

        return once(0, state) if n == 1 else jax.lax.fori_loop(0, n, once, state)

    def asked(k: Any, state: State, command: jax.Array) -> jax.Array:
        if controller is None:
            return command
        read = [s.scale * x + s.bias for s, x in ((sensors[i], getattr(state, i)) for i in "qv")]
        return controller(k * T, State(*read), command)

    def at_once(carry: Any, command: jax.Array) -> Any:
        k, state = carry
        state = advance(k * T, state, asked(k, state, command), jnp.asarray(T, state.q.dtype))
        return (k + 1, state), state

    def late(carry: Any, command: jax.Array) -> Any:
        k, state, queue = carry
        now = asked(k, state, command)
        fresh = jnp.broadcast_to(now, queue.shape)  # before the first one acts, the first one
        queue = jnp.where(k == 0, fresh, jnp.concatenate([now[None], queue[:-1]]))
        delay = jnp.clip(setup.delay, 0.0, grid.longest_delay * T)
        # the last whole period counts as a full one, so that a delay at its end has a derivative
        whole = jnp.clip(jnp.ceil(delay / T).astype(int) - 1, 0)
        rest = delay - whole * T
        state = advance(k * T, state, queue[whole + 1], rest)
        state = advance(k * T + rest, state, queue[whole], T - rest)
        return (k + 1, state, queue), state

    zero = jnp.zeros((), int)
    if setup.delay is None or not grid.longest_delay:
        after = _swept(at_once, (zero, start), commands, keep)
    else:
        ctrl = jax.eval_shape(asked, zero, start, commands[0])
        queue = jnp.zeros((grid.longest_delay + 2, *ctrl.shape), ctrl.dtype)
        after = _swept(late, (zero, start, queue), commands, keep)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, after)


def _swept(once: Callable, carry: Any, commands: jax.Array, keep: int | None) -> State:
    """The states after each command. A reverse derivative keeps every keep-th carry."""
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


def reading(setup: Setup, path: State, grid: Grid, kind: str, times: jax.Array) -> jax.Array:
    """What a sensor reads (T, n) at times (T,) after the start."""
    sensor = setup.sensors[kind]
    q, v = jax.vmap(functools.partial(_between, setup.model, path, grid.period))(
        times - sensor.delay
    )
    return sensor.scale * (q if kind == "q" else v) + sensor.bias


def _between(model: Model, path: State, T: float, t: Any) -> tuple[jax.Array, jax.Array]:
    """q and v at a time, from the cubic of the interval in which it lies."""
    last = path.q.shape[0] - 2
    k = jnp.clip(jnp.floor(t / T + 1e-9).astype(int), 0, last)
    s = jnp.clip(t / T - k, 0.0, 1.0)
    q0, q1, v0, v1 = path.q[k], path.q[k + 1], path.v[k], path.v[k + 1]
    d = difference(model, q0, q1)
    a, b = T * v0 - d, d - T * v1
    along = s * d + s * (1 - s) * ((1 - s) * a + s * b)
    v = (d + (1 - 2 * s) * ((1 - s) * a + s * b) + s * (1 - s) * (b - a)) / T
    return integrate(model, q0, along), v
