"""Checks of a task: names, shapes of terms, initial states, parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer, real_array, real_number, shown
from rbjax.dynamics.arguments import check_model, check_takes
from rbjax.envs.episode import EnvState
from rbjax.envs.task import Event, Observation, Randomisation, Reward, Task, Variable
from rbjax.errors import InputError
from rbjax.model import Model, State
from rbjax.sensors import sensor_of


def check_task(task: Any) -> None:
    """Check the fields of a task, without calling its functions."""
    if not isinstance(task, Task):
        raise InputError(
            f"Environment: task is {type(task).__name__}, expected an rb.envs.Task; "
            "rb.envs.make(name) makes the environment of a named task"
        )
    where = f"task {task.name!r}"
    if not isinstance(task.name, str) or not task.name:
        raise InputError(f"{where}: name is {task.name!r}, expected a word")
    check_model(where, task.model)
    integer(where, "decimation", task.decimation, least=1)
    integer(where, "episode", task.episode, least=1)
    if task.dt is not None:
        real_number(where, "dt", task.dt, above=0.0)
    _check_terms(where, task)
    _check_functions(where, task)
    _check_delays(where, task)
    action = task.action
    methods = all(callable(getattr(action, name, None)) for name in ("size", "range", "ctrl"))
    if isinstance(action, type) or not methods:
        raise InputError(
            f"{where}: action is {shown(action)}, expected a map of actions such as "
            "rb.envs.Direct() or rb.envs.Scaled()"
        )
    if task.tracked is not None:
        task.model.body(task.tracked)


def _check_terms(where: str, task: Task) -> None:
    """Raise InputError unless the lists of terms contain terms of different names."""
    for name in ("observations", "values", "terminations"):
        given = getattr(task, name)
        if not isinstance(given, Mapping) or not all(isinstance(x, str) for x in given):
            raise InputError(f"{where}: {name} is {shown(given)}, expected a dict by name")
    if "policy" not in task.observations:
        raise InputError(
            f'{where}: observations has the groups {sorted(task.observations)}, expected "policy" '
            "among them"
        )
    lists: dict[str, tuple[Any, Any]] = {
        name: (getattr(task, name), kind)
        for name, kind in (
            ("rewards", Reward), ("variables", Variable), ("events", Event),
            ("randomise", Randomisation),
        )
    }  # fmt: skip
    groups = task.observations.items()
    lists |= {f"observations[{group!r}]": (terms, Observation) for group, terms in groups}
    for name, (terms, kind) in lists.items():
        term = f"rb.envs.{kind.__name__}"
        if not isinstance(terms, tuple | list) or not all(isinstance(t, kind) for t in terms):
            raise InputError(f"{where}: {name} is {shown(terms)}, expected a list of {term}")
        if not terms and kind in (Reward, Observation):
            raise InputError(f"{where}: {name} is empty, expected one or more {term}")
        names = [t.name for t in terms]
        wrong = [n for n in names if not isinstance(n, str) or not n]
        if wrong:
            raise InputError(
                f"{where}: a term of {name} has the name {wrong[0]!r}, expected a word"
            )
        twice = [n for n, count in Counter(names).items() if count > 1]
        if twice:
            raise InputError(f"{where}: {name} has {twice[0]!r} twice, expected different names")
    for reward in task.rewards:
        real_number(where, f"the weight of {reward.name!r}", reward.weight)
    for group, terms in groups:
        for t in terms:
            noise = real_array(f"{where}: observations[{group!r}]", f"noise of {t.name!r}", t.noise)
            if (noise < 0).any():
                raise InputError(
                    f"{where}: the noise of {t.name!r} is {t.noise}, expected a half-width of at "
                    "least 0"
                )


def _check_functions(where: str, task: Task) -> None:
    """Raise InputError unless the functions of a task and of its terms take their arguments."""
    check_takes(where, "start", task.start, "key", "params")
    check_takes(where, "total_reward", task.total_reward, "rewards", "dt")
    if task.curriculum is not None:
        check_takes(where, "curriculum", task.curriculum, "params", "progress")
    for name, ends in task.terminations.items():
        check_takes(where, f"termination {name!r}", ends, "transition")
    terms: dict[str, tuple[Any, dict[str, tuple[str, ...]]]] = {
        "reward": (task.rewards, {"read": ("transition",)}),
        "event": (task.events, {"apply": ("key", "state", "params")}),
        "randomisation": (
            task.randomise, {"draw": ("key", "params"), "apply": ("model", "value")},
        ),
        "variable": (
            task.variables,
            {"start": ("key", "params"), "measure": ("transition",),
             "update": ("key", "transition")},
        ),
    }  # fmt: skip
    for kind, (given, functions) in terms.items():
        for term in given:
            for name, arguments in functions.items():
                f = getattr(term, name)
                if f is not None or name not in ("measure", "update"):
                    check_takes(where, f"{name} of the {kind} {term.name!r}", f, *arguments)


def _check_delays(where: str, task: Task) -> None:
    """Raise InputError unless the delays are ranges of control steps within an episode."""
    delays = {"action_delay": task.action_delay}
    delays |= {
        f"delay of {t.name!r}": t.delay for terms in task.observations.values() for t in terms
    }
    for name, delay in delays.items():
        steps = tuple(delay) if isinstance(delay, tuple | list) else ()
        whole = len(steps) == 2 and all(
            isinstance(k, int | np.integer) and not isinstance(k, bool) for k in steps
        )
        if not whole or not 0 <= steps[0] <= steps[1] <= task.episode:
            raise InputError(
                f"{where}: {name} is {delay}, expected (smallest, largest) in control steps, such "
                f"as (0, 2), and at most the episode of {task.episode}"
            )


def term_of(task: Any, term: Any) -> Callable:
    """Return the function of a transition of an observation term."""
    read = sensor_of(term.read) if isinstance(term.read, str) else term.read
    if callable(getattr(read, "columns", None)) and not isinstance(read, type):
        return lambda transition: read(transition.after)
    if not callable(read) or isinstance(read, type):
        raise InputError(
            f"task {task.name!r}: observation {term.name!r} reads {read!r}, expected a function "
            'of a transition, a sensor, or the name of a sensor such as "gyro:imu"'
        )
    check_takes(f"task {task.name!r}", f"observation {term.name!r}", read, "transition")
    return read


def array_of(what: str, value: Any) -> jax.Array:
    """Convert a value that a function of a user returned to an array of real numbers."""
    try:
        x = None if isinstance(value, str | bytes) else jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        x = None
    if x is None:
        raise InputError(f"{what} returned {shown(value)}, expected numbers")
    if jnp.iscomplexobj(x):
        raise InputError(f"{what} returned complex numbers, expected real ones")
    return x


def check_number(what: str, task: Any, value: Any) -> jax.Array:
    """Check that a term returned a number."""
    x = array_of(f"task {task.name!r}: {what}", value)
    if x.shape:
        raise InputError(
            f"task {task.name!r}: {what} returned shape {x.shape}, expected a number; sum its "
            "entries"
        )
    return x


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


def floats(x: jax.Array, dtype: Any) -> jax.Array:
    """Cast floating-point numbers to a dtype. Integers and bools stay."""
    return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.inexact) else x


def number_of(task: Any, name: str, value: Any, dtype: Any) -> jax.Array:
    """Convert an entry of `Task.values` to an array of floats, or of bools. A value may be
    infinite."""
    try:
        x = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"task {task.name!r}: values[{name!r}] is {value!r}, expected a number or an array"
        ) from error
    if not isinstance(x, jax.core.Tracer) and np.isnan(x).any():
        raise InputError(f"task {task.name!r}: values[{name!r}] is {value!r}, expected no NaN")
    return x if x.dtype == bool else x.astype(dtype)


def check_vector(
    what: str, task: Any, value: Any, dtype: Any, shape: tuple[int, ...] | None = None
) -> jax.Array:
    """Check that a term returned a number or a vector, or an array of a shape; cast it."""
    where = f"task {task.name!r}: " if task is not None else ""
    x = array_of(f"{where}{what}", value)
    if jnp.issubdtype(x.dtype, jnp.floating) and not jnp.issubdtype(dtype, jnp.floating):
        raise InputError(
            f"{where}{what} returned numbers of dtype {x.dtype}, and it starts with {dtype}; start "
            "it with floats, such as 0.0"
        )
    x = x.astype(dtype)
    if shape is None and x.ndim == 0:
        return x[None]
    if (x.ndim != 1) if shape is None else (x.shape != shape):
        due = "a number or (n,)" if shape is None else f"{shape}"
        raise InputError(f"{where}{what} returned shape {x.shape}, expected {due}")
    return x


def check_event(task: Any, event: Any, state: Any) -> EnvState:
    """Check that an event returned the state of an episode."""
    if not isinstance(state, EnvState):
        raise InputError(
            f"task {task.name!r}: event {event.name!r} returned {type(state).__name__}, expected "
            "the rb.envs.EnvState with changes, such as state.replace(...)"
        )
    return state


def check_robot(task: Any, randomisation: Any, model: Any) -> Model:
    """Check that a randomisation returned a model."""
    if not isinstance(model, Model):
        raise InputError(
            f"task {task.name!r}: randomisation {randomisation.name!r} returned "
            f"{type(model).__name__}, expected the Model with changes"
        )
    return model


def check_start(task: Any, model: Model, state: Any) -> State:
    """Check the initial state of a task."""
    due, where = ((model.nq,), (model.nv,)), f"task {task.name!r}: start"
    expected = f"expected rb.State(q {due[0]}, v {due[1]})"
    if not isinstance(state, State):
        raise InputError(f"{where} returned {type(state).__name__}, {expected}")
    q, v = array_of(where, state.q), array_of(where, state.v)
    if (q.shape, v.shape) != due:
        raise InputError(f"{where} returned rb.State(q {q.shape}, v {v.shape}), {expected}")
    return state.replace(q=q, v=v)


def check_shape(where: str, name: str, x: Any, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    """Check the shape of an array and cast it."""
    given = array_of(f"{where}: {name}", x)
    if given.shape != shape:
        raise InputError(
            f"{where}: {name} has shape {given.shape}, expected {shape}; map over a batch by "
            "jax.vmap"
        )
    return given.astype(dtype)


def check_params(name: str, params: Any, due: Any, what: str = "params") -> None:
    """Check that parameters have the structure and the shapes of the default parameters.

    what: the parameters, for messages.
    """
    where = f"environment {name!r}"
    if not isinstance(params, type(due)):
        raise InputError(
            f"{where}: {what} is {type(params).__name__}, expected rb.envs.Params; change "
            "env.default_params by replace"
        )
    for field in ("weights", "values"):
        names, expected = sorted(getattr(params, field)), sorted(getattr(due, field))
        if names != expected:
            raise InputError(f"{where}: {what}.{field} has {names}, expected {expected}")
    found, _ = jax.tree_util.tree_flatten_with_path(params)
    expected_leaves, _ = jax.tree_util.tree_flatten_with_path(due)
    structures: list[Any] = [jax.tree.structure(x) for x in (params, due)]
    if structures[0] != structures[1]:
        raise InputError(
            f"{where}: {what} has other leaves than the default parameters, expected numbers and "
            "arrays in their places and the model of the task with changed leaves"
        )
    for (path, x), (_, y) in zip(found, expected_leaves, strict=True):
        if jnp.shape(x) != jnp.shape(y):
            raise InputError(
                f"{where}: {what}{jax.tree_util.keystr(path)} has shape {jnp.shape(x)}, expected "
                f"{jnp.shape(y)}; map over several robots by jax.vmap"
            )
