"""Commands of a task: variables that are drawn at a reset and again from time to time.

A command c (n,) is a velocity, for instance (m/s, m/s, rad/s). The numbers are `params.values`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import integer, real_number
from rbjax.envs.task import Variable


def switched_commands(dt: float, name: str = "command") -> tuple[Variable, ...]:
    """Return the variables of a command whose entries change at random times.

    At a reset c is uniform in [-a, a]. The time between changes has an exponential distribution. At
    a change each entry stays with probability 1/2. Otherwise it becomes uniform in [-a, a] with
    probability b, else zero.

    Args:
        dt: control step, s.
        name: name of the variable (n,). Its values are `name_range` a (n,), `name_on` b (n,) and
            `name_time`, s, the mean time between changes.

    Raises:
        InputError: dt is not a number above zero.

    Source: Zakka et al., *MuJoCo Playground*, 2025, Go1 joystick.

    Example:
        >>> import rbjax as rb
        >>> [v.name for v in rb.envs.terms.switched_commands(0.02)]
        ['command', 'command_steps']
    """
    real_number("switched_commands", "dt", dt, above=0.0)

    def steps(key: Any, params: Any) -> jax.Array:
        time = jax.random.exponential(key) * params.values[f"{name}_time"]
        return jnp.round(time / dt)

    def uniform(key: Any, params: Any) -> jax.Array:
        a = jnp.asarray(params.values[f"{name}_range"])
        return a * jax.random.uniform(key, a.shape, a.dtype, -1.0, 1.0)

    def due(transition: Any) -> Any:
        return transition.variables[f"{name}_steps"] <= 1

    def changed(key: Any, transition: Any) -> jax.Array:
        c, params = transition.variables[name], transition.params
        keys = jax.random.split(key, 3)
        on = jax.random.uniform(keys[0], c.shape) < jnp.asarray(params.values[f"{name}_on"])
        other = jax.random.uniform(keys[1], c.shape) < 0.5
        new = jnp.where(on, uniform(keys[2], params), 0.0).astype(c.dtype)
        return jnp.where(due(transition) & other, new, c)

    def counted(key: Any, transition: Any) -> jax.Array:
        left = transition.variables[f"{name}_steps"]
        return jnp.where(
            due(transition), steps(key, transition.params).astype(left.dtype), left - 1
        )

    # the command is first: it reads the steps that are left before they change
    return (
        Variable(name, uniform, update=changed),
        Variable(f"{name}_steps", steps, update=counted),
    )


def periodic_commands(every: int, name: str = "command") -> tuple[Variable, ...]:
    """Return the variables of a command that is drawn every `every` control steps.

    With probability s all entries are zero. Otherwise they are uniform in [low, high].

    Args:
        every: number of control steps.
        name: name of the variable (n,). Its values are `name_low`, `name_high` (n,), `name_stop` s.

    Raises:
        InputError: every is not an integer above zero.

    Example:
        >>> import rbjax as rb
        >>> [v.name for v in rb.envs.terms.periodic_commands(500, "goal")]
        ['goal', 'goal_steps']
    """
    integer("periodic_commands", "every", every, least=1)

    def drawn(key: Any, params: Any) -> jax.Array:
        low, high = (jnp.asarray(params.values[f"{name}_{x}"]) for x in ("low", "high"))
        keys = jax.random.split(key)
        c = low + (high - low) * jax.random.uniform(keys[0], low.shape, low.dtype)
        stop = jax.random.uniform(keys[1], ()) < params.values[f"{name}_stop"]
        return jnp.where(stop, 0.0, c)

    def changed(key: Any, transition: Any) -> jax.Array:
        c = transition.variables[name]
        return jnp.where(
            transition.variables[f"{name}_steps"] <= 1,
            drawn(key, transition.params).astype(c.dtype),
            c,
        )

    def counted(key: Any, transition: Any) -> jax.Array:
        left = transition.variables[f"{name}_steps"]
        return jnp.where(left <= 1, jnp.asarray(float(every), left.dtype), left - 1)

    def full(key: Any, params: Any) -> jax.Array:
        return jnp.asarray(float(every))

    return Variable(name, drawn, update=changed), Variable(f"{name}_steps", full, update=counted)
