"""One control step of one sample, and the begin of an episode.

begin:    drawn values of the model, variables, initial state
advance:  delayed action, controls, events, physics, variables, terminations, rewards
observe:  observation terms, with their noise and delay
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import check_step
from rbjax.envs.checks import (
    array_of,
    check_event,
    check_flag,
    check_noise,
    check_number,
    check_robot,
    check_shape,
    check_start,
    check_vector,
    floats,
    term_of,
)
from rbjax.envs.episode import EnvState, Params
from rbjax.envs.task import Observation, Task
from rbjax.envs.transition import Transition
from rbjax.forces.context import Context
from rbjax.forces.inputs import Inputs
from rbjax.lanes.arrays import select
from rbjax.model import Model, State, with_constants
from rbjax.motion.field import Field, dynamics_of, free_motion, with_contact
from rbjax.motion.integrators import advance_state, integrator_of
from rbjax.motion.step import with_memory
from rbjax.sensors.solution import MotionSolution


class ControlStep:
    """The functions of one sample that `Environment` compiles."""

    def __init__(self, task: Task):
        self.task = task
        self.dtype = jnp.zeros(()).dtype
        model = task.model
        law = with_contact("Environment", model, free_motion, task.contact)
        self.dynamics = dynamics_of("Environment", model, law, None, steps=True)
        self.integrator = integrator_of("Environment", task.integrator, self.dynamics, model)
        #: the physics step in s
        self.step = float(model.timestep if task.dt is None else task.dt)
        self.dt = check_step(f"task {task.name!r}", "dt", self.step, self.dtype)
        self.action_size: int = task.action.size(model)
        self.terms = {
            group: [(term, term_of(task, term)) for term in terms]
            for group, terms in task.observations.items()
        }

    @functools.cached_property
    def unique_terms(self) -> list[tuple[str, Observation, Callable]]:
        """The name group/term, the term and its function of each observation. A term that is in
        several groups is listed once, in the first one."""
        found: dict[int, tuple[str, Observation, Callable]] = {}
        for group, terms in self.terms.items():
            for term, read in terms:
                found.setdefault(id(term), (f"{group}/{term.name}", term, read))
        return list(found.values())

    @functools.cached_property
    def delayed(self) -> dict[str, tuple[int, int]]:
        """The delays of the action and of observations, by name."""
        out = {} if self.task.action_delay == (0, 0) else {"action": self.task.action_delay}
        return out | {name: t.delay for name, t, _ in self.unique_terms if t.delay != (0, 0)}

    def begin(self, key: jax.Array, params: Params) -> EnvState:
        """Return the state of a new episode. The buffers of observations are left out."""
        task, dtype = self.task, self.dtype
        start, random, delay, variable = jax.random.split(key, 4)
        drawn = {
            r.name: floats(
                array_of(
                    f"task {task.name!r}: draw of {r.name!r}",
                    r.draw(jax.random.fold_in(random, i), params),
                ),
                dtype,
            )
            for i, r in enumerate(task.randomise)
        }
        params = self.with_drawn(params, drawn, constants=False)
        variables = {
            v.name: array_of(
                f"task {task.name!r}: start of {v.name!r}",
                v.start(jax.random.fold_in(variable, i), params),
            )
            for i, v in enumerate(task.variables)
        }
        model = params.model
        state = check_start(task, model, task.start(start, params))
        state = State(state.q.astype(dtype), state.v.astype(dtype), state.x, state.memory)
        if state.x is None and model.nx:
            state = state.replace(x=model.start(dtype))
        state = with_memory(model, state, self.dynamics)
        delays = {
            name: jax.random.randint(jax.random.fold_in(delay, i), (), low, high + 1)
            for i, (name, (low, high)) in enumerate(self.delayed.items())
        }
        initial = getattr(task.action, "initial_ctrl", lambda model: np.zeros(model.nu))
        buffers = {}
        if "action" in self.delayed:
            buffers["action"] = jnp.zeros((task.action_delay[1] + 1, self.action_size), dtype)
        return EnvState(
            state=state, acceleration=jnp.zeros_like(state.v), step=jnp.int32(0),
            action=jnp.zeros(self.action_size, dtype), ctrl=jnp.asarray(initial(model), dtype),
            variables=variables, drawn=drawn, delays=delays, buffers=buffers,
            episode_return=jnp.zeros((), dtype),
        )  # fmt: skip

    def before_physics(self, own: tuple, params: Params) -> tuple[EnvState, jax.Array, jax.Array]:
        """Return the state after the events, the controls, and the integers of the key that is
        left.

        own: integers of a key, state, action.
        """
        data, state, action = own
        event, rest = jax.random.split(key_of(data))
        return *self.prepare(event, state, action, params), jax.random.key_data(rest)

    def after_physics(self, own: tuple, params: Params, *, resets: bool) -> tuple:
        """Return observation, state, reward, done and info of a control step.

        own: the integers of the key and the state of `before_physics`, action, controls, and the
            result of `physics`.
        resets: whether the next episode begins if this one ended.
        """
        data, last, action, ctrl, moved = own
        finish, begin, noise = jax.random.split(key_of(data), 3)
        state, reward, done, info = self.finish(finish, last, action, ctrl, moved, params)
        if resets:
            new = self.begin(begin, params)
            new = new.replace(buffers={**state.buffers, **new.buffers})
            state = select(done, new, state)
        obs, state = self.observe(noise, last, state, params, done if resets else False)
        return obs, state, reward, done, info

    def prepare(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: Params
    ) -> tuple[EnvState, jax.Array]:
        """Run the events, and put the action into its delay buffer. Return the state and the
        controls."""
        task = self.task
        params = self.with_drawn(params, state.drawn, constants=False)
        for i, e in enumerate(task.events):
            state = check_event(task, e, e.apply(jax.random.fold_in(key, i), state, params))
        if "action" in self.delayed:
            buffer = jnp.concatenate([action[None], state.buffers["action"][:-1]])
            action = _row(buffer, state.delays["action"])
            state = state.replace(buffers={**state.buffers, "action": buffer})
        ctrl = task.action.ctrl(action, state, params)
        return state, check_shape(
            f"task {task.name!r}",
            "the result of the action map",
            ctrl,
            (task.model.nu,),
            self.dtype,
        )

    def physics(
        self, state: State, step: jax.Array, drawn: dict[str, Any], ctrl: jax.Array, params: Params
    ) -> tuple[State, jax.Array]:
        """Integrate a control step. Return the state, and the mean acceleration (nv,) over the last
        physics step."""
        model = self.with_drawn(params, drawn).model
        field, count = Field(model, self.dynamics, self.dt), self.task.decimation
        begin = (step * count).astype(self.dtype)

        def one(carry: tuple, i: jax.Array) -> tuple:
            before, _ = carry
            t = self.dt * (begin + i)
            after = advance_state(self.integrator, field, t, before, Inputs(ctrl), self.dt)
            return (after, (after.v - before.v) / self.dt), None

        carry = state, jnp.zeros_like(state.v)
        if count == 1:
            return one(carry, jnp.zeros((), self.dtype))[0]
        return jax.lax.scan(one, carry, jnp.arange(count, dtype=self.dtype))[0]

    def finish(
        self, key: jax.Array, last: EnvState, action: jax.Array, ctrl: jax.Array,
        moved: tuple[State, jax.Array], params: Params,
    ) -> tuple[EnvState, jax.Array, jax.Array, dict[str, Any]]:  # fmt: skip
        """Return the state after a control step, the reward, done, and info."""
        task = self.task
        params = self.with_drawn(params, last.drawn)
        motion, acceleration = moved
        step, variables = last.step + 1, dict(last.variables)
        state = last.replace(
            state=motion, acceleration=acceleration, step=step, action=action, ctrl=ctrl
        )
        transition = self.transition(last, state, params)
        for v in task.variables:
            if v.measure is not None:
                variables[v.name] = _alike(v, v.measure(transition), variables)
        transition = dataclasses.replace(transition, variables=variables)
        numbers = [motion.q, motion.v, action, *([] if motion.x is None else [motion.x])]
        failed = ~jnp.all(jnp.isfinite(jnp.concatenate(numbers)))
        terminated = failed
        for name, ends in task.terminations.items():
            terminated = terminated | check_flag(f"termination {name!r}", task, ends(transition))
        transition = dataclasses.replace(transition, terminated=terminated)
        rewards = {}
        for r in task.rewards:
            found = check_number(f"reward term {r.name!r}", task, r.read(transition))
            rewards[r.name] = params.weights[r.name] * found
        total = check_number(
            "total_reward", task, task.total_reward(rewards, self.dt * task.decimation)
        )
        failed = failed | ~jnp.isfinite(total)
        terminated = terminated | failed
        rewards = {name: jnp.where(failed, 0.0, r) for name, r in rewards.items()}
        reward = jnp.where(failed, 0.0, total).astype(self.dtype)
        truncated = (step >= task.episode) & ~terminated
        for i, v in enumerate(task.variables):
            if v.update is not None:
                new = v.update(jax.random.fold_in(key, i), transition)
                variables = {**variables, v.name: _alike(v, new, variables)}
                transition = dataclasses.replace(transition, variables=variables)
        state = state.replace(variables=variables, episode_return=state.episode_return + reward)
        info = {
            "terminated": terminated, "truncated": truncated, "failed": failed,
            "rewards": rewards, "return": state.episode_return, "length": step,
        }  # fmt: skip
        return state, reward, terminated | truncated, info

    def transition(self, before: EnvState, after: EnvState, params: Params) -> Transition:
        """Return the transition between two states of an episode."""
        state, dt = after.state, self.dt * self.task.decimation
        t = dt * after.step.astype(self.dtype)
        context = Context.of(params.model, t, state, after.ctrl, self.dt)
        solution = MotionSolution(
            context,
            Inputs(after.ctrl),
            self.dynamics,
            memory=state.memory,
            acceleration=after.acceleration,
        )
        context = dataclasses.replace(context, solution=solution)
        return Transition(
            before=before.state, after=context, action=after.action, last_action=before.action,
            ctrl=after.ctrl, last_ctrl=before.ctrl, variables=after.variables, params=params,
            dt=dt, step=after.step,
        )  # fmt: skip

    def observe(
        self, key: jax.Array, last: EnvState, state: EnvState, params: Params, is_reset: Any
    ) -> tuple[Any, EnvState]:
        """Return the observation, and the state with the buffers of delayed terms.

        last: state before the control step.
        is_reset: whether an episode begins at the state, traced. Terms then read a transition from
            the initial state to itself, and delayed terms begin with their first value. False: no
            reset. None: the buffers do not exist yet.
        """
        params = self.with_drawn(params, state.drawn)
        if isinstance(is_reset, jax.Array):
            before, now = ((x.state, x.action, x.ctrl) for x in (last, state))
            before = select(is_reset, now, before)
            last = last.replace(state=before[0], action=before[1], ctrl=before[2])
        transition = self.transition(last, state, params)
        buffers, values = dict(state.buffers), {}
        for name, term, read in self.unique_terms:
            value = check_vector(
                f"observation {term.name!r}", self.task, read(transition), self.dtype
            )
            check_noise(self.task, term, value)
            if name in self.delayed:
                first = jnp.broadcast_to(value, (self.delayed[name][1] + 1, *value.shape))
                if is_reset is None:
                    buffers[name] = first
                else:
                    pushed = jnp.concatenate([value[None], buffers[name][:-1]])
                    buffers[name] = jnp.where(is_reset, first, pushed)
                value = _row(buffers[name], state.delays[name])
            values[id(term)] = value
        noisy = [t for _, t, _ in self.unique_terms if np.any(np.asarray(t.noise))]
        if noisy:  # one draw for all terms: a random number costs as much as a term
            ends = np.cumsum([values[id(term)].shape[0] for term in noisy])
            drawn = jax.random.uniform(key, (int(ends[-1]),), self.dtype, -1.0, 1.0)
            for term, own in zip(noisy, jnp.split(drawn, ends[:-1]), strict=True):
                values[id(term)] += params.noise * jnp.asarray(term.noise, self.dtype) * own
        out = {
            group: jnp.concatenate([values[id(term)] for term, _ in terms])
            for group, terms in self.terms.items()
        }
        return (out if len(out) > 1 else out["policy"]), state.replace(buffers=buffers)

    def with_drawn(
        self, params: Params, drawn: dict[str, Any], *, constants: bool = True
    ) -> Params:
        """Return the parameters with the drawn values of an episode in the model.

        constants: whether the link constants are computed at once, for a part that reads motions.
            Else a function that needs them computes them.
        """
        if not drawn:
            return params
        model = params.model
        for r in self.task.randomise:
            model = check_robot(self.task, r, r.apply(model, drawn[r.name]))
        return with_model(params, with_constants(model, self.dtype) if constants else model)


def key_of(data: jax.Array) -> jax.Array:
    """Return the key of two integers, with the same random numbers whatever JAX's default is."""
    return jax.random.wrap_key_data(data, impl="threefry2x32")


def with_model(params: Params, model: Model) -> Params:
    """Return the parameters with another model."""
    return Params(model, params.weights, params.noise, params.values)


def _alike(variable: Any, value: Any, variables: dict[str, jax.Array]) -> jax.Array:
    old = variables[variable.name]
    return check_vector(f"variable {variable.name!r}", None, value, old.dtype, old.shape)


def _row(buffer: jax.Array, index: jax.Array) -> jax.Array:
    """Return a row of a short buffer, by selects."""
    out = buffer[0]
    for i in range(1, buffer.shape[0]):
        out = jnp.where(index == i, buffer[i], out)
    return out
