"""A task as an optimal control problem: the cost is minus the return.

    min  -sum_k r(s_k, s_{k+1}, a_k)      over the actions a_k,      s_{k+1} = f(s_k, a_k)

s is the state of an episode, f a control step and r its reward, computed by the functions of
`Environment.step`. So the cost of a motion is minus the return of its actions, to rounding. A knot
of the problem is the pair (s_{k+1}, s_k), so the Hessian of the reward needs no second derivatives
of the physics. Tangent coordinates are the state of motion, and those leaves of the pair on which
later rewards depend.

The problem is deterministic. Left out are events, noise, delays and the randomisation of the model.
The motion goes on after a termination, and a reward that reads `terminated` is paid in each step in
which a termination is true. The cost of a state that is not finite is infinite. Variables keep
their values if their `update` draws random numbers (a command that changes at random), and are
updated otherwise (the phase of a gait).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.control.optimal.problem import Design, Problem
from rbjax.control.optimal.shooting.expansion import arguments_read
from rbjax.control.optimal.system import System
from rbjax.control.optimal.terms import Constraint, Cost, Term
from rbjax.envs.control_step import ControlStep, key_of, with_model
from rbjax.envs.episode import EnvState, Params
from rbjax.envs.task import Observation, Task, Variable
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.motion.linearise import box_minus, box_plus


class Pair(NamedTuple):
    """A knot: the state of an episode now, and before the last control step."""

    now: EnvState
    last: EnvState


#: the parts of a pair that may have tangent coordinates: which state, field, name of a variable
Part = tuple[str, str, str]


class TaskSystem(System):
    """A control step of a task as a `System`, with the states `Pair` and the actions as controls.
    `Environment.problem` makes it.

    Fields:
        params: parameters of the environment.
        sample: the control step; static.
        parts: the parts of a pair with tangent coordinates, in addition to the state of motion;
            static.
    """

    params: Params
    sample: ControlStep = eqx.field(static=True)
    parts: tuple[Part, ...] = eqx.field(static=True)

    @property
    def model(self) -> Model:
        return self.params.model

    def with_model(self, model: Model) -> TaskSystem:
        return TaskSystem(with_model(self.params, model), self.sample, self.parts)

    @property
    def n(self) -> int:
        return self._sizes()[-1].stop

    @property
    def nu(self) -> int:
        return self.sample.action_size

    @property
    def touches(self) -> bool:
        return self.params.model.contact is not None

    def checked(self, where: str, state: Any) -> Pair:
        if isinstance(state, EnvState):
            state = Pair(state, state)
        if not isinstance(state, Pair):
            raise InputError(
                f"{where}: the state is {type(state).__name__}, expected the state of an episode, "
                "as env.reset(key) returns it"
            )
        return Pair(*(self._episode(x) for x in state))

    def _episode(self, state: EnvState) -> EnvState:
        """Return a state of an episode without drawn values and delays, in the right dtypes."""
        due = self.example(None).now
        changes = {
            name: jax.tree.map(lambda y, x: jnp.asarray(x, y.dtype), getattr(due, name), given)
            for name in (
                "state",
                "acceleration",
                "step",
                "action",
                "ctrl",
                "variables",
                "episode_return",
            )
            for given in [getattr(state, name)]
        }
        return dataclasses.replace(due, **changes)

    def example(self, dtype: Any) -> Pair:
        return example_pair(self.sample, self.params)

    def step(self, t: Any, state: Pair, ctrl: jax.Array, dt: Any) -> Pair:
        return step_pair(self.sample, self.params, state, ctrl)

    def plus(self, state: Pair, dx: jax.Array) -> Pair:
        for part, at in zip((STATE, *self.parts), self._sizes(), strict=True):
            own = dx[at]
            if part[1] == "state":
                state = _put(state, part, box_plus(self.model, _get(state, part), own))
            else:
                x = _get(state, part)
                state = _put(state, part, x + own.reshape(x.shape))
        return state

    def minus(self, one: Pair, other: Pair) -> jax.Array:
        return jnp.concatenate([
            box_minus(self.model, _get(other, part), _get(one, part)) if part[1] == "state"
            else jnp.ravel(_get(one, part) - _get(other, part))
            for part in (STATE, *self.parts)
        ])  # fmt: skip

    def _sizes(self) -> list[slice]:
        """Return the tangent coordinates of each part."""
        pair, out, at = self.example(None), list[slice](), 0
        for part in (STATE, *self.parts):
            motion = 2 * self.model.nv + self.model.nx
            size = motion if part[1] == "state" else np.size(_get(pair, part))
            out.append(slice(at, at + size))
            at += size
        return out


STATE: Part = ("now", "state", "")


class MinusReward(Term):
    """Minus the reward of the control step that ends at a knot.

    system: the system of the task, with the weights and the values of its parameters.
    """

    system: TaskSystem

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        params = with_model(self.system.params, model)
        return -reward_of_pair(self.system.sample, params, state)


def example_pair(sample: ControlStep, params: Params) -> Pair:
    """Return a pair of states with the right shapes and zeros."""
    key = jax.ShapeDtypeStruct((2,), jnp.uint32)
    shapes = jax.eval_shape(lambda data: sample.begin(key_of(data), params), key)
    state = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    # a count that is an integer has no derivative
    state = dataclasses.replace(state, step=jnp.zeros((), sample.dtype))
    return Pair(state, state)


def step_pair(sample: ControlStep, params: Params, pair: Pair, action: jax.Array) -> Pair:
    """Return the pair after a control step."""
    key, last = jax.random.key(0), pair.now
    _, ctrl = sample.prepare(key, last, action, params)
    moved = sample.physics(last.state, last.step, {}, ctrl, params)
    return Pair(sample.finish(key, last, action, ctrl, moved, params)[0], last)


def reward_of_pair(sample: ControlStep, params: Params, pair: Pair) -> jax.Array:
    """Return the reward of the control step between the states of a pair; -inf if not finite."""
    now, last = pair
    moved = now.state, now.acceleration
    _, reward, _, info = sample.finish(jax.random.key(0), last, now.action, now.ctrl, moved, params)
    return jnp.where(info["failed"], -jnp.inf, reward)  # an episode pays 0 and ends


def parts_read(sample: ControlStep, params: Params) -> tuple[Part, ...]:
    """Return the parts of a pair, beside the state of motion, on which later rewards depend."""
    pair = example_pair(sample, params)
    paths, tree = jax.tree_util.tree_flatten_with_path(pair)
    leaves, names = [x for _, x in paths], [_part(path) for path, _ in paths]
    action = jnp.zeros(sample.action_size, sample.dtype)

    def reads(f: Callable, *more: jax.Array) -> set[Part]:
        found = arguments_read(f, [*leaves, *more])
        return {part for part, used in zip(names, found, strict=False) if used and part is not None}

    def reward(*xs: jax.Array) -> jax.Array:
        return reward_of_pair(sample, params, jax.tree.unflatten(tree, xs))

    needed = {STATE} | reads(reward)
    while True:

        def after(*xs: jax.Array, needed: set[Part] = needed) -> list:
            *own, u = xs
            new = jax.tree.leaves(step_pair(sample, params, jax.tree.unflatten(tree, own), u))
            return [x for x, part in zip(new, names, strict=True) if part in needed]

        more = needed | reads(after, action)
        if more == needed:
            return tuple(sorted(needed - {STATE}))
        needed = more


def _part(path: tuple) -> Part | None:
    """Return the part of a leaf of a pair; None for a leaf without tangent coordinates."""
    which, field, *rest = (str(getattr(k, "name", getattr(k, "key", ""))) for k in path)
    if field == "state":
        return (which, "state", "") if rest[0] in ("q", "v", "x") else None
    if field in ("acceleration", "action", "ctrl"):
        return which, field, ""
    return (which, field, rest[0]) if field == "variables" else None


def _get(pair: Pair, part: Part) -> Any:
    which, field, name = part
    found = getattr(getattr(pair, which), field)
    return found[name] if name else found


def _put(pair: Pair, part: Part, x: Any) -> Pair:
    which, field, name = part
    state = getattr(pair, which)
    if name:
        x = getattr(state, field) | {name: x}
    return pair._replace(**{which: dataclasses.replace(state, **{field: x})})


@dataclasses.dataclass(frozen=True)
class _Inside:
    """An action map whose actions are a few rounding errors inside of their range, so that the
    derivative at an end of the range is not that of a clipped action.

    given: the action map.
    middle: (na,) middle of the range, zero without limits.
    factor: (na,) factor of the distance from the middle.
    """

    given: Any
    middle: np.ndarray
    factor: np.ndarray

    def size(self, model: Model) -> int:
        size: int = self.given.size(model)
        return size

    def ctrl(self, action: jax.Array, state: EnvState, params: Params) -> jax.Array:
        middle, factor = (jnp.asarray(x, action.dtype) for x in (self.middle, self.factor))
        found: jax.Array = self.given.ctrl(middle + factor * (action - middle), state, params)
        return found


def deterministic_step(task: Task, params: Params, dtype: Any) -> ControlStep:
    """Return the control step of a task without all that is random."""
    low, high = (np.asarray(x, float) for x in task.action.range(task.model))
    limited = np.isfinite(low) & np.isfinite(high)
    middle = 0.5 * (np.where(limited, low, 0.0) + np.where(limited, high, 0.0))
    inside = 1 - 16 * float(jnp.finfo(dtype).eps)
    plain = dataclasses.replace(
        task, events=(), randomise=(), action_delay=(0, 0),
        action=_Inside(task.action, middle, np.where(limited, inside, 1.0)),
        observations={"policy": (Observation("action", lambda transition: transition.action),)},
    )  # fmt: skip
    sample = ControlStep(plain)
    variables = [_without_drawing(sample, v, params) for v in task.variables]
    return ControlStep(dataclasses.replace(plain, variables=variables))


def _without_drawing(sample: ControlStep, variable: Variable, params: Params) -> Variable:
    """Return a variable without its update if the update draws random numbers."""
    update = variable.update
    if update is None:
        return variable

    def updated(data: jax.Array, begin: jax.Array) -> Any:
        state = sample.begin(key_of(begin), params)
        return update(key_of(data), sample.transition(state, state, params))

    draws, _ = arguments_read(updated, [jnp.zeros(2, jnp.uint32)] * 2)
    return dataclasses.replace(variable, update=None) if draws else variable


def task_problem(
    sample: ControlStep, parts: tuple[Part, ...], horizon: int, dt: float, params: Params,
    limits: tuple, *, running: Sequence[Any] = (), terminal: Sequence[Any] = (),
    constraints: Sequence[Constraint] = (), design: Design | None = None,
) -> Problem:  # fmt: skip
    """Build the problem of a deterministic control step (`Environment.problem`)."""
    system = TaskSystem(params, sample, parts)
    reward, later = MinusReward(system), tuple(range(1, horizon))
    own = (Cost(reward, knots=later),) if later else ()
    return Problem(
        system, horizon, dt, running=(*own, *running), terminal=(Cost(reward), *terminal),
        constraints=constraints, bounds=limits, integral=False, design=design,
    )  # fmt: skip
