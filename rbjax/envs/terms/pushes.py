"""Pushes: events that change the velocity of a floating base from time to time.

The first two entries of v are the horizontal velocity of the base in world axes, m/s.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import real_number
from rbjax.envs.task import Event, Variable


def velocity_pushes(dt: float, name: str = "push") -> tuple[tuple[Variable, ...], Event]:
    """Return the variables and the event of sudden changes of the horizontal velocity.

    The time T between pushes is drawn at a reset. At each multiple of T the velocity changes by a
    vector of random direction.

    Args:
        dt: control step, s.
        name: name of the event. Its values are `name_time` (2,), s, and `name_speed` (2,), m/s, the
            ranges of uniform distributions. A time below one control step is one control step.

    Raises:
        InputError: dt is not a number above zero.

    Source: Zakka et al., *MuJoCo Playground*, 2025, G1 joystick.

    Example:
        >>> import rbjax as rb
        >>> variables, event = rb.envs.terms.velocity_pushes(0.02)
        >>> event.name
        'push'
    """
    real_number("velocity_pushes", "dt", dt, above=0.0)

    def steps(key: Any, params: Any) -> jax.Array:
        return jnp.maximum(jnp.round(_uniform(key, params.values[f"{name}_time"]) / dt), 1.0)

    def apply(key: Any, state: Any, params: Any) -> Any:
        keys = jax.random.split(key)
        angle = _uniform(keys[0], (0.0, 2 * math.pi))
        speed = _uniform(keys[1], params.values[f"{name}_speed"])
        due = (state.step + 1) % state.variables[f"{name}_steps"].astype(jnp.int32) == 0
        return _pushed(state, jnp.where(due, speed, 0.0), jnp.cos(angle), jnp.sin(angle))

    return (Variable(f"{name}_steps", steps),), Event(name, apply)


def force_pushes(dt: float, name: str = "push") -> tuple[tuple[Variable, ...], Event]:
    """Return the variables and the event of horizontal forces on the base that last some steps.

    A force of random direction begins after a waiting time W and lasts a time D. It accelerates the
    robot by a(t) = sin(pi t / D) s / (2 D), as the force m a(t) at the center of mass does, in the
    form of one change of the velocity of the base a control step. W, D and s are drawn at a reset.
    For small control steps the velocity changes by s / pi in a push.

    Args:
        dt: control step, s.
        name: name of the event. Its values are `name_wait`, `name_duration` (2,), s, and
            `name_speed` (2,), m/s, the ranges of uniform distributions. A speed or a duration of
            zero is no push.

    The variable `name` (3,) is the acceleration in world axes, m/s^2.

    Raises:
        InputError: dt is not a number above zero.

    Source: Zakka et al., *MuJoCo Playground*, 2025, Go1 joystick.

    Example:
        >>> import rbjax as rb
        >>> variables, event = rb.envs.terms.force_pushes(0.02, "gust")
        >>> variables[0].name
        'gust'
    """
    real_number("force_pushes", "dt", dt, above=0.0)

    def drawn(what: str, unit: float) -> Any:
        def start(key: Any, params: Any) -> jax.Array:
            return _uniform(key, params.values[f"{name}_{what}"]) / unit

        return start

    def none(size: int) -> Any:
        return lambda key, params: jnp.zeros((size,) if size else ())

    def apply(key: Any, state: Any, params: Any) -> Any:
        old = state.variables
        wait, duration = old[f"{name}_wait_steps"], old[f"{name}_duration"]
        clock, angle = old[f"{name}_clock"], old[f"{name}_angle"]
        begins = clock >= jnp.round(wait)
        time = (clock - jnp.round(wait)) * dt
        ends = time > duration
        angle = jnp.where(clock + 1 >= jnp.round(wait), angle, _uniform(key, (0.0, 2 * math.pi)))
        lasting = jnp.where(duration > 0, duration, 1.0)
        a = jnp.sin(math.pi * time / lasting) * old[f"{name}_speed"] / (2 * lasting)
        a = jnp.where(begins & ~ends & (duration > 0), a, 0.0)
        c, s = jnp.cos(angle), jnp.sin(angle)
        new = {
            f"{name}_clock": jnp.where(ends & begins, 0.0, clock + 1),
            f"{name}_angle": angle,
            name: jnp.stack([a * c, a * s, 0.0 * a]),
        }
        new = {key: x.astype(old[key].dtype) for key, x in new.items()}
        return _pushed(state.replace(variables={**old, **new}), a * dt, c, s)

    variables = (
        Variable(name, none(3)),
        Variable(f"{name}_clock", none(0)),
        Variable(f"{name}_angle", none(0)),
        Variable(f"{name}_wait_steps", drawn("wait", dt)),
        Variable(f"{name}_duration", drawn("duration", 1.0)),
        Variable(f"{name}_speed", drawn("speed", 1.0)),
    )
    return variables, Event(name, apply)


def _uniform(key: Any, limits: Any) -> jax.Array:
    return limits[0] + (limits[1] - limits[0]) * jax.random.uniform(key, ())


def _pushed(state: Any, speed: Any, cosine: Any, sine: Any) -> Any:
    """Return a state of an environment with another horizontal velocity."""
    v = state.state.v
    change = jnp.stack([speed * cosine, speed * sine]).astype(v.dtype)
    moved = jnp.concatenate([v[:2] + change, v[2:]])
    return state.replace(state=state.state.replace(v=moved))
