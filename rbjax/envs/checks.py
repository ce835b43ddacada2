"""Checks of a task: names, shapes of terms, initial states, parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError
from rbjax.model import Model, State
from rbjax.sensors import sensor_of


def check_task(task: Any) -> None:
    """Check the static fields of a task."""
    from rbjax.envs.task import Task

    if not isinstance(task, Task):
        raise InputError(
            f"Environment: task is {type(task).__name__}, expected an rb.envs.Task; "
            "rb.envs.make(name) makes the environment of a named task"
        )
    where = f"task {task.name!r}"
    check_model(where, task.model)
    integer(where, "decimation", task.decimation, least=1)
    integer(where, "episode", task.episode, least=1)
    if "policy" not in task.observations:
        raise InputError(
            f'{where}: observations has the groups {sorted(task.observations)}, expected "policy" '
            "among them"
        )
    for group, terms in task.observations.items():
        if not terms:
            raise InputError(
                f"{where}: observations[{group!r}] is empty, expected one or more "
                "rb.envs.Observation"
            )
    if not task.rewards:
        raise InputError(f"{where}: rewards is empty, expected one or more rb.envs.Reward")
    lists: dict[str, Any] = {
        "rewards": task.rewards,
        "variables": task.variables,
        "randomise": task.randomise,
    }
    lists |= {f"observations[{g!r}]": terms for g, terms in task.observations.items()}
    for name, terms in lists.items():
        twice = [n for n, count in Counter(t.name for t in terms).items() if count > 1]
        if twice:
            raise InputError(f"{where}: {name} has {twice[0]!r} twice, expected different names")
    delays = {"action_delay": task.action_delay}
    delays |= {
        f"delay of {t.name!r}": t.delay for terms in task.observations.values() for t in terms
    }
    for name, delay in delays.items():
        steps = tuple(delay) if isinstance(delay, tuple | list) else ()
        whole = len(steps) == 2 and all(isinstance(k, int | np.integer) for k in steps)
        if not whole or not 0 <= steps[0] <= steps[1]:
            raise InputError(
                f"{where}: {name} is {delay}, expected (smallest, largest) in control steps, such "
                "as (0, 2)"
            )
    if task.tracked is not None:
        task.model.body(task.tracked)


def term_of(task: Any, term: Any) -> Callable:
    """Return the function of a transition of an observation term."""
    read = sensor_of(term.read) if isinstance(term.read, str) else term.read
    if callable(getattr(read, "columns", None)):
        return lambda transition: read(transition.after)
    if not callable(read):
        raise InputError(
            f"task {task.name!r}: observation {term.name!r} reads {read!r}, expected a function "
            'of a transition, a sensor, or the name of a sensor such as "gyro:imu"'
        )
    return read


def check_number(what: str, task: Any, value: Any) -> jax.Array:
    """Check that a term returned a number."""
    if np.shape(value):
        raise InputError(
            f"task {task.name!r}: {what} returned shape {np.shape(value)}, expected a number; sum "
            "its entries"
        )
    return jnp.asarray(value)


def check_flag(what: str, task: Any, value: Any) -> jax.Array:
    """Check that a termination returned a bool."""
    x = check_number(what, task, value)
    if x.dtype != bool:
        raise InputError(
            f"task {task.name!r}: {what} returned a number of dtype {x.dtype}, expected a bool, "
            "such as the result of a comparison"
        )
    return x


def check_noise(task: Any, term: Any, value: jax.Array) -> None:
    """Check that the noise of an observation fits it."""
    if np.shape(term.noise) not in ((), value.shape):
        raise InputError(
            f"task {task.name!r}: observation {term.name!r} has noise of shape "
            f"{np.shape(term.noise)}, expected a number or {value.shape}"
        )


def number_of(task: Any, name: str, value: Any, dtype: Any) -> jax.Array:
    """Convert an entry of `Task.values` to an array of floats, or of bools."""
    try:
        x = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"task {task.name!r}: values[{name!r}] is {value!r}, expected a number or an array"
        ) from error
    return x if x.dtype == bool else x.astype(dtype)


def check_vector(
    what: str, task: Any, value: Any, dtype: Any, shape: tuple[int, ...] | None = None
) -> jax.Array:
    """Check that a term returned a number or a vector, or an array of a shape; cast it."""
    where = f"task {task.name!r}: " if task is not None else ""
    x = jnp.asarray(value, dtype)
    if shape is None and x.ndim == 0:
        return x[None]
    if (x.ndim != 1) if shape is None else (x.shape != shape):
        due = "a number or (n,)" if shape is None else f"{shape}"
        raise InputError(f"{where}{what} returned shape {x.shape}, expected {due}")
    return x


def check_start(task: Any, model: Model, state: Any) -> State:
    """Check the initial state of a task."""
    due = ((model.nq,), (model.nv,))
    if not isinstance(state, State) or (state.q.shape, state.v.shape) != due:
        got = type(state).__name__
        if isinstance(state, State):
            got = f"rb.State(q {state.q.shape}, v {state.v.shape})"
        raise InputError(
            f"task {task.name!r}: start returned {got}, expected rb.State(q {due[0]}, v {due[1]})"
        )
    return state


def check_shape(where: str, name: str, x: Any, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    """Check the shape of an array and cast it."""
    if jnp.shape(x) != shape:
        raise InputError(
            f"{where}: {name} has shape {jnp.shape(x)}, expected {shape}; map over a batch by "
            "jax.vmap"
        )
    return jnp.asarray(x, dtype)


def check_params(name: str, params: Any, due: Any) -> None:
    """Check that parameters have the structure and the shapes of the default parameters."""
    where = f"environment {name!r}"
    if not isinstance(params, type(due)):
        raise InputError(
            f"{where}: params is {type(params).__name__}, expected rb.envs.Params; change "
            "env.default_params by replace"
        )
    for field in ("weights", "values"):
        names, expected = sorted(getattr(params, field)), sorted(getattr(due, field))
        if names != expected:
            raise InputError(f"{where}: params.{field} has {names}, expected {expected}")
    found, _ = jax.tree_util.tree_flatten_with_path(params)
    expected_leaves, _ = jax.tree_util.tree_flatten_with_path(due)
    structures: list[Any] = [jax.tree.structure(x) for x in (params, due)]
    if structures[0] != structures[1]:
        raise InputError(
            f"{where}: params.model is another robot than that of the task, expected its model "
            "with changed leaves"
        )
    for (path, x), (_, y) in zip(found, expected_leaves, strict=True):
        if jnp.shape(x) != jnp.shape(y):
            raise InputError(
                f"{where}: params{jax.tree_util.keystr(path)} has shape {jnp.shape(x)}, expected "
                f"{jnp.shape(y)}; map over several robots by jax.vmap"
            )
