"""A task: a robot, its observations, rewards, events and terminations, as small functions.

A task declares functions and static options. `Environment` runs it. All numbers that a user changes
without compiling again (the model, reward weights, the level of noise, ranges of commands) are in
`Params`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import flag, real_array, shown
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_takes
from rbjax.envs.actions import Direct
from rbjax.envs.episode import Params
from rbjax.envs.task_table import task_display
from rbjax.errors import InputError
from rbjax.model import Model, State


@displayed
@dataclass(frozen=True)
class Observation:
    """An observation term. In several groups the same object has the same value, noise included.

    name: name of the term.
    read: function of a `Transition` that returns a number or (n,); or a sensor
        (`rbjax.sensors.Sensor`); or the name of a sensor, such as "gyro:imu".
    noise: half-width of uniform noise, a number or (n,), in the unit of the term. It is multiplied
        by `Params.noise`.
    delay: smallest and largest delay in control steps, drawn at each reset.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Observation("q", lambda transition: transition.after.q, noise=0.01).delay
        (0, 0)
    """

    name: str
    read: Any
    noise: Any = 0.0
    delay: tuple[int, int] = (0, 0)


@displayed
@dataclass(frozen=True)
class Reward:
    """A reward term.

    name: name of the term.
    read: function of a `Transition` that returns a number.
    weight: factor of the term. `Params.weights` has the factor that is used.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("effort", lambda transition: (transition.ctrl**2).sum(), -0.1).weight
        -0.1
    """

    name: str
    read: Callable[[Any], Any]
    weight: float = 1.0


@displayed
@dataclass(frozen=True)
class Variable:
    """A variable of a task between steps: a command, the phase of a gait, the time in the air.

    name: name of the variable, the key of `Transition.variables`.
    start: function (key, params) that returns its value at a reset, an array.
    measure: function of a `Transition` that returns its new value, before the rewards; or None.
    update: function (key, transition) that returns its new value after the rewards; or None.

    Example:
        >>> import jax, rbjax as rb
        >>> goal = rb.envs.Variable("goal", lambda key, params: jax.random.normal(key, (2,)))
        >>> goal.update is None
        True
    """

    name: str
    start: Callable[[jax.Array, Params], Any]
    measure: Callable[[Any], Any] | None = None
    update: Callable[[jax.Array, Any], Any] | None = None


@displayed
@dataclass(frozen=True)
class Event:
    """An event at the beginning of a control step, such as a push.

    name: name of the event.
    apply: function (key, state: EnvState, params) that returns the changed `EnvState`; key () is of
        `jax.random`.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Event("nothing", lambda key, state, params: state).name
        'nothing'
    """

    name: str
    apply: Callable[[jax.Array, Any, Params], Any]


@displayed
@dataclass(frozen=True)
class Randomisation:
    """A number or an array of the model that is drawn at each reset (domain randomisation).

    name: name of the randomisation, the key of `EnvState.drawn`.
    draw: function (key, params) that returns the drawn value.
    apply: function (model, value) that returns the changed model.

    Source: Tobin et al., *Domain randomization for transferring deep neural networks*, 2017.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.random_scale("masses", lambda model: model.bodies.mass, 0.9, 1.1).name
        'masses'
    """

    name: str
    draw: Callable[[jax.Array, Params], Any]
    apply: Callable[[Model, jax.Array], Model]


def random_scale(
    name: str, where: Callable[[Model], Any], low: Any, high: Any, *, each: bool = False
) -> Randomisation:
    """Return a `Randomisation` that multiplies a leaf of the model by a uniform factor.

    Args:
        name: name of the randomisation.
        where: function of the model that returns the leaf, or a list of leaves with common factors,
            such as mass (nb,) and inertia (nb, 3, 3). The first leaf is the one of the factors,
            which scale the leading axes of the others.
        low, high: smallest and largest factor, numbers or arrays of the leaf's shape.
        each: True for independent factors of the entries of the leaf. False: all entries are at the
            same share of the way from low to high; with numbers, one factor of all entries.

    Example:
        >>> import rbjax as rb
        >>> factor = rb.envs.random_scale("damping", lambda model: model.joints.damping, 0.5, 2.0)
        >>> factor.apply(rb.load("cart_pole"), 2.0).joints.damping.shape
        (2,)
    """
    return Randomisation(
        name, _uniform("random_scale", name, where, low, high, each),
        lambda model, value: _changed("random_scale", name, model, where, value, jnp.multiply),
    )  # fmt: skip


def random_offset(
    name: str, where: Callable[[Model], Any], low: Any, high: Any, *, each: bool = False
) -> Randomisation:
    """Return a `Randomisation` that adds a uniform number to a leaf of the model.

    Args:
        name: name of the randomisation.
        where: function of the model that returns the leaf, or a list of leaves, as in
            `random_scale`.
        low, high: smallest and largest number, in the unit of the leaf, numbers or arrays of the
            leaf's shape.
        each: True for independent numbers of the entries of the leaf. False: all entries are at the
            same share of the way from low to high; with numbers, one number for all entries.

    Example:
        >>> import rbjax as rb
        >>> shift = rb.envs.random_offset(
        ...     "com", lambda model: model.bodies.com, -0.05, 0.05, each=True)
        >>> shift.name
        'com'
    """
    return Randomisation(
        name, _uniform("random_offset", name, where, low, high, each),
        lambda model, value: _changed("random_offset", name, model, where, value, jnp.add),
    )  # fmt: skip


def _changed(
    of: str, name: str, model: Model, where: Callable, value: Any, change: Callable
) -> Model:
    """Return the model with `change` of each leaf and `value`, whose axes are the leaf's first."""
    shape = jnp.shape(value)

    def one(x: jax.Array) -> jax.Array:
        if x.shape[: len(shape)] != shape:
            raise InputError(
                f"{of}: the value of {name!r} has shape {shape}, expected a number or the first "
                f"axes of {x.shape}, the shape of each leaf that changes"
            )
        return change(x, jnp.reshape(value, shape + (1,) * (x.ndim - len(shape))))

    return eqx.tree_at(where, model, jax.tree.map(one, where(model)))


def _uniform(
    of: str, name: str, where: Callable, low: Any, high: Any, each: bool
) -> Callable[[jax.Array, Params], jax.Array]:
    """Return the draw of a `Randomisation`. of: the function that makes it, for messages."""
    check_takes(of, "where", where, "model")
    flag(of, "each", each)
    lowest, highest = real_array(of, "low", low), real_array(of, "high", high)
    shapes = {lowest.shape, highest.shape} - {()}
    if len(shapes) > 1 or not np.all(lowest <= highest):
        raise InputError(
            f"{of}: low is {low} and high {high}, expected low of at most high, of one shape"
        )

    def draw(key: jax.Array, params: Params) -> jax.Array:
        leaves = jax.tree.leaves(where(params.model))
        if not leaves or not all(eqx.is_inexact_array(x) for x in leaves):
            raise InputError(
                f"{of}: where of {name!r} returns {shown(where(params.model))}, expected a leaf of "
                "the model, such as model.bodies.mass, or a list of leaves"
            )
        leaf = leaves[0]
        for end, x in (("low", lowest), ("high", highest)):
            if x.shape not in ((), leaf.shape):
                raise InputError(
                    f"{of}: {end} of {name!r} has shape {x.shape}, expected a number or "
                    f"{leaf.shape}, the shape of the leaf"
                )
        least, most = jnp.asarray(lowest, leaf.dtype), jnp.asarray(highest, leaf.dtype)
        share = jax.random.uniform(key, leaf.shape if each else (), leaf.dtype)
        return least + share * (most - least)

    return draw


def sum_of_rewards(rewards: Mapping[str, jax.Array], dt: Any) -> Any:
    """Compute the reward of a control step: dt times the sum of the weighted terms.

    Args:
        rewards: name of a reward term -> its weighted value (), in units of reward per second.
        dt: control step, s.

    Returns:
        (), the reward of the step.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.sum_of_rewards({"alive": 1.0, "effort": -0.5}, 0.02)
        0.01
    """
    return dt * sum(rewards.values())


@displayed
@dataclass(frozen=True)
class Task:
    """A task for a policy. `rb.envs.Environment(task)` runs it.

    Fields:
        name: name of the task.
        model: an `rb.Model`, with its contact law and its sensors.
        start: function (key, params) that returns the initial `State` of an episode.
        observations: group -> observation terms. The group "policy" is required; "critic" is for
            the value function (privileged observations).
        rewards: reward terms.
        action: map of the action of the policy to the controls (`rbjax.envs.actions`).
        action_delay: smallest and largest delay of the action in control steps, drawn at each
            reset.
        variables: variables of the task between steps.
        events: events at the beginning of a control step.
        terminations: name -> function of a `Transition` that returns True if the episode ends.
            A state, an action or a reward that is not finite always ends it.
        randomise: what is drawn at each reset in the model.
        decimation: physics steps in a control step.
        dt: physics step in s; None for the model's timestep.
        integrator: as in `rb.rollout`.
        contact: law of contact as in `rb.rollout`, such as rb.contact.SoftContact(iterations=4);
            None for the law of the model.
        episode: control steps in an episode; then it is truncated.
        values: name -> number or array: further numbers of the task, `Params.values`.
        total_reward: function (weighted reward terms, dt) that returns the reward of a step.
        curriculum: function (params, progress) that returns the params at a progress in 0..1 of the
            training; or None.
        tracked: name of the body that a viewer follows; None for the first body.

    Example:
        >>> import jax.numpy as jnp, rbjax as rb
        >>> model = rb.load("pendulum")
        >>> speed = rb.envs.Observation("speed", lambda transition: transition.after.v)
        >>> height = rb.envs.Reward("height", lambda transition: -jnp.cos(transition.after.q[0]))
        >>> task = rb.envs.Task(
        ...     "swing_up", model, start=lambda key, params: model.random_state(key),
        ...     observations={"policy": (speed,)}, rewards=(height,))
        >>> rb.envs.Environment(task).observation_size
        1
    """

    name: str
    model: Model
    start: Callable[[jax.Array, Params], State]
    observations: Mapping[str, Sequence[Observation]]
    rewards: Sequence[Reward]
    action: Any = field(default_factory=Direct)
    action_delay: tuple[int, int] = (0, 0)
    variables: Sequence[Variable] = ()
    events: Sequence[Event] = ()
    terminations: Mapping[str, Callable[[Any], Any]] = field(default_factory=dict)
    randomise: Sequence[Randomisation] = ()
    decimation: int = 1
    dt: float | None = None
    integrator: Any = None
    contact: Any = None
    episode: int = 1000
    values: Mapping[str, Any] = field(default_factory=dict)
    total_reward: Callable[[Mapping[str, jax.Array], Any], Any] = sum_of_rewards
    curriculum: Callable[[Params, Any], Params] | None = None
    tracked: str | None = None

    _display_ = task_display
