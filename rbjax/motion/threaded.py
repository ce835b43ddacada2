"""Rollouts on threads: one sample is one program, and threads run the batch."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.compiler.jax.function import trace
from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import Moving, Program
from rbjax.compiler.jax.uniform import hoist_uniform
from rbjax.dynamics.drivers import choice
from rbjax.dynamics.tracing.algorithm import with_compiled_constants
from rbjax.dynamics.tracing.custom_rules import split_tracers
from rbjax.dynamics.tracing.devices import on_each_device
from rbjax.dynamics.tracing.operations import operation_count
from rbjax.forces.inputs import joined, shapes
from rbjax.model import Model, State
from rbjax.motion.checkpointed_rollout import CheckpointedRollout, checkpoint_interval
from rbjax.motion.field import Dynamics, Field
from rbjax.motion.inputs import Sources
from rbjax.motion.integrators import Integrator, advance_state

#: operations of a step above which saving its residuals is faster than recomputing them
SAVE_RESIDUALS_ABOVE = 4_000
#: operations of a policy above which XLA evaluates it between the steps
POLICY_UP_TO = 4_000


@dataclass(frozen=True)
class Steps:
    """Options of a rollout: `count` steps; every `save_every`-th state is saved."""

    dynamics: Dynamics
    integrator: Integrator
    save_every: int
    count: int
    batched: bool


def rollout_on_threads(
    model: Model, state: State, sources: Sources, dt: jax.Array, how: Steps, memory: float
) -> State:
    """Compute the states (..., T, nq), (..., T, nv) and (..., T, nx) of a rollout, one thread per
    sample.

    A small policy is part of the thread program. XLA evaluates a larger one for the whole batch
    between the steps.
    """
    dtype = state.q.dtype
    model = choice.on_threads(model, dtype)
    made = with_compiled_constants(model, dtype)
    model = model.replace(constants=made.execution.constants)
    batched, steps, save_every = how.batched, how.count, how.save_every
    given, treedef = jax.tree.flatten(state)
    one = [x[0] if batched else x for x in given]
    size, rows = len(one), sources.rows
    between = sources.has_functions and _is_large(
        sources, model, dt, jax.tree.unflatten(treedef, one)
    )
    driven = rows is not None or between
    moving, closed = split_tracers((model, dt))

    def once(i: jax.Array, *args: jax.Array) -> list[jax.Array]:
        state = jax.tree.unflatten(treedef, args[:size])
        model, dt = closed(list(args[size + driven :]))
        numbers = [args[size]] if driven else []
        if between and rows is not None:
            numbers = [args[size][: rows.shape[-1]], args[size][rows.shape[-1] :]]
        if sources.has_functions and not between:
            numbers.append(sources.evaluate(model, i * dt, state))
        inputs = sources.inputs(model, *numbers)
        field = Field(model, how.dynamics, dt)
        return jax.tree.leaves(advance_state(how.integrator, field, i * dt, state, inputs, dt))

    control = [jnp.zeros(_width(sources, model, rows, between), dtype)] if driven else []
    step, shared = trace(once, [jnp.int32(0), *one, *control, *moving])
    own = 1 + size + driven
    known = [True] * len(shared) + [False] * own + [True] * len(moving)
    step, shared = hoist_uniform(step, known, [*shared, *[None] * own, *moving], run)
    if between:
        return _between(model, step, shared, state, sources, dt, how, memory)
    run_steps = functools.partial(CheckpointedRollout, step, size, steps, save_every, driven)
    each = sum(x.size * x.dtype.itemsize for x in one)

    @functools.cache
    def sized(batch: int, moving: Moving) -> Program:
        left = run_steps(1).step_vjp(moving).bytes
        fits = left and steps * batch * (each + left) <= memory
        whole = functools.partial(_run, step)  # one equation, which is not traced again
        if fits and operation_count(whole, *step.inputs).total > SAVE_RESIDUALS_ABOVE:
            return run_steps(1, keep_residuals=True).program(plain)
        return run_steps(checkpoint_interval(save_every, steps, batch * each, memory)).program(
            plain
        )

    plain = run_steps(save_every).program()
    program = Program(plain.closed, for_batch_size=sized)
    operands = given if rows is None else [*given, rows]
    f = functools.partial(_run, program)
    if batched:
        due = [2] * size + [3]
        axes = [0 if x.ndim == n else None for x, n in zip(operands, due, strict=False)]
        f = jax.vmap(f, in_axes=(*axes, *[None] * len(shared)))
    return jax.tree.unflatten(treedef, f(*operands, *shared))


def _run(program: Program, *operands: jax.Array) -> list[jax.Array]:
    return run(program, operands)


def _is_large(sources: Sources, model: Model, dt: jax.Array, one: State) -> bool:
    count = operation_count(lambda state: sources.evaluate(model, 0 * dt, state), one)
    return count.total > POLICY_UP_TO


def _width(sources: Sources, model: Model, rows: jax.Array | None, between: bool) -> int:
    """Return the number of columns of an input row.
    between: whether the row also contains the values of input functions."""
    asked = sum(
        math.prod(shape)
        for f, shape in zip(sources.functions, shapes(model), strict=True)
        if f is not None
    )
    return (0 if rows is None else rows.shape[-1]) + (asked if between else 0)


def _between(
    model: Model, step: Program, shared: list, state: State, sources: Sources, dt: jax.Array,
    how: Steps, memory: float,
) -> State:  # fmt: skip
    """Compute a rollout whose policy XLA evaluates, with one kernel call per step."""
    given, treedef = jax.tree.flatten(state)
    batched, save_every = how.batched, how.save_every
    rows, per_sample = sources.rows, sources.rows is not None and sources.rows.ndim == 3

    def act(args: list, /) -> Any:
        def one(i: jax.Array, *state: jax.Array) -> jax.Array:
            return sources.evaluate(model, i * dt, jax.tree.unflatten(treedef, state))

        return (jax.vmap(one, in_axes=(None, *[0] * len(given))) if batched else one)(*args)

    def advance(i: jax.Array, *args: jax.Array) -> list[jax.Array]:
        return run(step, [i, *args, *shared])

    if batched:
        act = on_each_device(act, [jnp.int32(0), *given], [None, *[0] * len(given)], len(given[0]))
        advance = jax.vmap(advance, in_axes=(None, *[0] * len(given), 0))

    def numbers(i: jax.Array, asked: jax.Array) -> jax.Array:
        if rows is None:
            return asked
        row = rows[:, i] if per_sample else rows[i]
        return joined([row, asked])

    @functools.partial(jax.checkpoint, prevent_cse=False)  # keep no activations of the network
    def once(carry: Any, _: None) -> tuple[Any, None]:
        i, *state = carry
        return (i + 1, *advance(i, *state, numbers(i, act([i, *state])))), None

    def segment(carry: Any, _: None) -> tuple[Any, Any]:
        # an iteration of XLA's loop costs as much as a small kernel
        carry, _ = jax.lax.scan(once, carry, None, length=save_every, unroll=min(4, save_every))
        return carry, carry[1:]

    if how.count * sum(x.size * x.dtype.itemsize for x in given) > memory:
        segment = jax.checkpoint(segment, prevent_cse=False)
    start = (jnp.int32(0), *given)
    _, saved = jax.lax.scan(segment, start, None, length=how.count // save_every)
    states = [jnp.concatenate([x[None], y]) for x, y in zip(given, saved, strict=True)]
    if batched:
        states = [jnp.moveaxis(x, 0, 1) for x in states]
    return jax.tree.unflatten(treedef, states)
