"""Observation terms as sensors, and logs of an environment as recordings, for `rb.sysid`.

    sensor:     h(context) = read(transition whose state after the step is the context)
    recording:  observations o_k at the times k dt, controls u_k that hold from k dt to (k + 1) dt

A log is the record of `Environment.unroll`, or the log of a real robot with the same observations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, instance
from rbjax.control.optimal.shooting.expansion import arguments_read
from rbjax.dynamics.arguments import check_array, shape_of
from rbjax.envs.checks import check_vector, term_of
from rbjax.envs.control_step import ControlStep, key_of
from rbjax.envs.environment import Environment
from rbjax.envs.episode import EnvState, Params
from rbjax.envs.task import Observation
from rbjax.envs.transition import Transition
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.model import State
from rbjax.sensors import CustomSensor
from rbjax.sysid.data.recording import Channel, Recording
from rbjax.sysid.simulation.setup import Grid


def observation_sensors(
    env: Environment, terms: Sequence[str] | None = None, *, group: str = "policy",
    variables: Mapping[str, Any] | None = None, params: Params | None = None,
) -> dict[str, CustomSensor]:  # fmt: skip
    """Return observation terms of an environment as sensors, for `rb.sysid.Setup.with_sensors`.

    Args:
        env: the environment.
        terms: names of terms; None for all terms that are functions of the state of motion and of
            the controls.
        group: group of the observations.
        variables: values of variables of the task that terms read, such as a constant command.
        params: parameters; None for the default parameters.

    Returns:
        "other:" + name of the term -> ideal sensor, without noise and delay.

    Raises:
        UnknownName: no such term or group.
        InputError: a term reads the action or a variable without a value.

    Example:
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> sensors = rb.envs.observation_sensors(env)
        >>> sorted(sensors)
        ['other:cart_position', 'other:pole_direction', 'other:velocity']
        >>> setup = rb.sysid.Setup.of(env.task.model).with_sensors(sensors)
    """
    where = "observation_sensors"
    instance(where, "env", env, Environment, 'an rb.envs.Environment, as rb.envs.make("...")')
    known = {term.name: term for term in _terms(env, group)}
    chosen = [known[choice("observation", name, known)] for name in known if terms is None] or [
        known[choice("observation", name, known)] for name in terms or ()
    ]
    given = env.default_params if params is None else params
    given = jax.tree.map(np.asarray, given)  # constants of the sensor
    own = {name: np.asarray(x, float) for name, x in (variables or {}).items()}
    found = {}
    for term in chosen:
        sensor, others = _sensor(env, term, given, own)
        if others and terms is None:
            continue
        if others:
            raise InputError(
                f"{where}: the observation {term.name!r} reads {others}, expected a function of "
                "the state of motion and the controls; give values of variables by `variables`"
            )
        found[f"other:{term.name}"] = sensor
    return found


def log_recording(
    env: Environment, observations: Any, actions: Any, terms: Sequence[str] | None = None, *,
    group: str = "policy", start: State | EnvState | None = None, name: str = "log",
) -> Recording:  # fmt: skip
    """Return the log of an environment as a recording, for `rb.sysid.identify`.

    The controls are those of the actions without delay.

    Args:
        env: the environment.
        observations: (T, n), each before the action of its row, as "obs" of `Environment.unroll`.
            The episode must not end within the log.
        actions: (T, na), in the units that the action map of the task expects.
        terms: names of terms; None for all that `observation_sensors` returns.
        group: group of the observations.
        start: state of motion, or state of the episode, at the first observation; None if it is
            not known. An action map that reads the last controls, such as `Increment`, requires
            the state of the episode.
        name: name of the recording.

    Returns:
        `rb.sysid.Recording` with the channels "other:NAME" and "ctrl", and the state "q" and "v" at
        the start. The standard deviation of a channel is that of the uniform noise of its term.

    Raises:
        InputError: wrong shapes, a task that delays actions or one of the terms, an action map
            that reads the state of the episode without that state.
        UnknownName: no such term or group.

    Example:
        >>> import jax, jax.numpy as jnp, rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> obs, state = env.reset(jax.random.key(0))
        >>> policy = lambda obs, key: jax.random.uniform(key, (1,), obs.dtype, -1, 1)
        >>> _, _, path = env.unroll(jax.random.key(1), obs, state, policy, 50)
        >>> log = rb.envs.log_recording(env, path["obs"], path["action"], start=state.state)
        >>> log.channels["other:velocity"].values.shape
        (50, 2)
    """
    where = "log_recording"
    instance(where, "env", env, Environment, 'an rb.envs.Environment, as rb.envs.make("...")')
    sizes = env.observation_size if isinstance(env.observation_size, dict) else None
    width = env.observation_size if sizes is None else sizes[choice("group", group, sizes)]
    rows = (shape_of(where, "actions", actions) or (0,))[0]
    actions = check_array(where, "actions", actions, (rows, env.action_size))
    seen = np.asarray(check_array(where, "observations", observations, (rows, width)))
    times = env.dt * np.arange(rows)
    if terms is None:
        terms = [x.partition(":")[2] for x in observation_sensors(env, group=group)]
    _check_delays(where, env, terms, group)
    channels: dict[str, Any] = {}
    at, half = 0, float(env.default_params.noise)
    for term in _terms(env, group):
        size = _size(env, term)
        if term.name in terms:
            noise = np.broadcast_to(half * np.asarray(term.noise, float) / np.sqrt(3), (size,))
            known = None if not noise.all() else noise
            channels[f"other:{term.name}"] = Channel(times, seen[:, at : at + size], noise=known)
        at += size
    for given in terms:
        choice("observation", given, [t.name for t in _terms(env, group)])
    channels["ctrl"] = Channel(times, np.asarray(_controls(where, env, actions, start)))
    start = start.state if isinstance(start, EnvState) else start
    if start is not None:
        for key in ("q", "v"):
            first = np.full((rows, np.size(getattr(start, key))), np.nan)
            first[0] = np.asarray(getattr(start, key))
            noise = np.full(first.shape[1], 1.0)
            channels[key] = Channel(times, first, noise=noise, dropped="nan")
    return Recording(name, channels)


def control_grid(env: Environment) -> Grid:
    """Return the steps of integration of an environment, for `rb.sysid.identify`.

    Args:
        env: the environment.

    Returns:
        `rb.sysid.Grid` with the control step in s, the physics steps in it, and the integrator.

    Raises:
        InputError: not an environment.

    Example:
        >>> import dataclasses, rbjax as rb
        >>> task = dataclasses.replace(rb.envs.tasks()["cart_pole_balance"](), decimation=5)
        >>> rb.envs.control_grid(rb.envs.Environment(task)).substeps
        5
    """
    instance(
        "control_grid", "env", env, Environment, 'an rb.envs.Environment, as rb.envs.make("...")'
    )
    sample = ControlStep(env.task)
    return Grid(env.dt, env.task.decimation, sample.integrator)


def _terms(env: Environment, group: str) -> Sequence[Observation]:
    groups = env.task.observations
    return groups[choice("group of observations", group, groups)]


def _size(env: Environment, term: Observation) -> int:
    """Return the number of entries of a term."""

    def value(data: jax.Array) -> jax.Array:
        sample = ControlStep(env.task)
        state = sample.begin(key_of(data), env.default_params)
        transition = sample.transition(
            state, state, sample.with_drawn(env.default_params, state.drawn)
        )
        return check_vector("", env.task, term_of(env.task, term)(transition), env.dtype)

    return jax.eval_shape(value, jax.ShapeDtypeStruct((2,), jnp.uint32)).shape[0]


def _sensor(
    env: Environment, term: Observation, params: Params, variables: dict[str, Any]
) -> tuple[CustomSensor, list[str]]:
    """Return a term as a sensor, and the names of what it reads beside the context."""
    task, read, size = env.task, term_of(env.task, term), _size(env, term)

    def value(context: Context, action: Any, own: Mapping[str, Any], step: Any) -> jax.Array:
        dtype = context.q.dtype
        ctrl = jnp.zeros(task.model.nu, dtype) if context.ctrl is None else context.ctrl
        transition = Transition(
            before=context.state, after=context, action=action, last_action=action, ctrl=ctrl,
            last_ctrl=ctrl, variables=dict(own), params=params, dt=env.dt, step=step,
        )  # fmt: skip
        return check_vector(f"observation {term.name!r}", task, read(transition), dtype)

    def begin(data: jax.Array) -> dict[str, Any]:
        return ControlStep(task).begin(key_of(data), env.default_params).variables

    shapes = jax.eval_shape(begin, jax.ShapeDtypeStruct((2,), jnp.uint32))
    names = [name for name in shapes if name not in variables]
    zeros = [jnp.zeros(shapes[name].shape, shapes[name].dtype) for name in names]

    def plain(action: jax.Array, step: jax.Array, *others: jax.Array) -> jax.Array:
        model = task.model
        state = model.default_state()
        q, v = (x.astype(env.dtype) for x in (state.q, state.v))
        state = State(q, v, model.start(env.dtype))
        context = Context.of(model, 0.0, state, jnp.zeros(model.nu, env.dtype), env.dt)
        own = variables | dict(zip(names, others, strict=True))
        return value(context, action, own, step)

    no_action = jnp.zeros(env.action_size, env.dtype)
    used = arguments_read(plain, [no_action, jnp.zeros((), env.dtype), *zeros])
    labels = ["the action", "the step", *(f"the variable {name!r}" for name in names)]
    others = [label for label, is_used in zip(labels, used, strict=True) if is_used]

    def sensor(context: Context) -> jax.Array:
        action = jnp.zeros(env.action_size, context.q.dtype)
        own = variables | {n: np.zeros(shapes[n].shape) for n in names}
        return value(context, action, own, 0)

    return CustomSensor(sensor, size), others


def _check_delays(where: str, env: Environment, terms: Sequence[str], group: str) -> None:
    """Check that neither the action nor one of the terms is delayed."""
    delays = {f"the observation {t.name!r}": t.delay for t in _terms(env, group) if t.name in terms}
    for name, delay in ({"the action": env.task.action_delay} | delays).items():
        if delay != (0, 0):
            raise InputError(
                f"{where}: {name} has a delay of {delay} control steps, expected none; make the "
                "environment with a delay of (0, 0), record the log there, or shift the rows of a "
                "log by its delay, or leave an observation out by `terms`"
            )


def _controls(where: str, env: Environment, actions: jax.Array, start: Any) -> jax.Array:
    """Compute the controls (T, nu) of actions (T, na)."""
    task, params = env.task, env.default_params
    known = isinstance(start, EnvState)
    state: EnvState = start if known else ControlStep(task).begin(jax.random.key(0), params)
    state = state.replace(ctrl=jnp.asarray(state.ctrl, env.dtype))

    def ctrl_of(action: jax.Array, ctrl: jax.Array, last: jax.Array) -> jax.Array:
        found: jax.Array = task.action.ctrl(action, state.replace(ctrl=ctrl, action=last), params)
        return found

    no_action = jnp.zeros(env.action_size, env.dtype)
    if any(arguments_read(ctrl_of, [no_action, state.ctrl, no_action])[1:]) and not known:
        raise InputError(
            f"{where}: the controls of {type(task.action).__name__} depend on those before, and "
            "start is not the state of an episode; give start=state, as env.reset(key) returns it"
        )

    def one(last: tuple, action: jax.Array) -> tuple:
        ctrl = ctrl_of(action, *last)
        return (ctrl, action), ctrl

    first = state.ctrl, jnp.asarray(state.action, env.dtype)
    return jax.lax.scan(one, first, jnp.asarray(actions, env.dtype))[1]
