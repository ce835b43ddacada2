"""Fixed steps of one sample as one program of a thread, with a reverse gradient of known memory.

The forward program keeps the state before every k-th step. The reverse one walks back over these:
it takes the k steps again, holds their states in the thread's own memory, and transposes them from
the last to the first. So a sample keeps steps / k states, and k of them at a time beside it. Where
memory allows, each step is kept with what it leaves for its transposed derivative (`Pullback`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics import drivers
from rbjax.dynamics.devices import on_each_device
from rbjax.dynamics.operations import operation_count
from rbjax.dynamics.tracing import opened
from rbjax.integrators import INTEGRATORS
from rbjax.model import Model, State, known_zeros, made_ahead
from rbjax.pullback import Pullback
from rbjax.threads.function import trace
from rbjax.threads.primitive import run
from rbjax.threads.programs import Moving, Program, traced
from rbjax.threads.uniform import split

Arrays = tuple[jax.Array, ...]

#: bytes of its own memory in which a thread holds what the steps that it takes again leave
HELD_UP_TO = 16 * 1024


@dataclass(frozen=True)
class March:
    """Steps of `step(i, *state, control, *others) -> state`, which has no control if not `driven`.

    size: arrays of the state; k: steps from one kept state to the next, a divisor of save_every;
    leaving: whether what steps leave is kept too; then k is 1.
    """

    step: Program
    size: int
    steps: int
    save_every: int
    driven: bool
    k: int
    leaving: bool = False

    def program(self, plain: Program | None = None) -> Program:
        """(*state, controls (steps, nu), *others) -> states (1 + steps / save_every, ...).

        plain: the same without what a derivative needs, where it has been traced.
        """
        avals = list(self.step.inputs[1:])
        if self.driven:
            u = avals[self.size]
            avals[self.size] = jax.ShapeDtypeStruct((self.steps, *u.shape), u.dtype)
        plain = plain or traced(lambda *args: self._forward(args)[0], *avals)
        every = self.k == self.save_every  # every kept state is also a result

        @functools.cache
        def keeping(moving: Moving) -> Program:
            if every and not self.leaving:
                return plain

            def f(*args: Any) -> list:
                states, before, left = self._forward(
                    args, self.pullback(moving) if self.leaving else None
                )
                return [*states, *([] if every else before), *left]

            return traced(f, *avals)

        return Program(
            plain.closed, pull=self._pull, keeping=keeping, reads=0 if every else self.size
        )

    def pullback(self, moving: Sequence[bool]) -> Pullback:
        """Of the step, where these of the arguments of the march move."""
        first = self.size + self.driven
        own = (False, *[True] * self.size, *moving[self.size : first], *moving[first:])
        return Pullback.of(self.step, own)

    def _parts(self, args: Sequence[Any]) -> tuple[Arrays, Any, Sequence[Any]]:
        state, rest = tuple(args[: self.size]), args[self.size :]
        if not self.driven:
            return state, None, rest
        return state, rest[0].reshape(*self._turns, *rest[0].shape[1:]), rest[1:]

    @property
    def _turns(self) -> tuple[int, int, int]:
        """Saved states, kept states to each of them, steps to each of these."""
        return self.steps // self.save_every, self.save_every // self.k, self.k

    def _forward(
        self, args: Sequence[Any], pull: Pullback | None = None
    ) -> tuple[list, list, list]:
        """States that are saved, states that are kept, and what the steps leave for `pull`."""
        state, controls, others = self._parts(args)
        saved, kept, k = self._turns

        def once(carry: Any, u: Any) -> tuple[Any, Any]:
            return self._advance(carry, u, others, pull)

        def chunk(carry: Any, us: Any) -> tuple[Any, Any]:
            after, left = jax.lax.scan(once, carry, us, length=k)
            return after, (carry[1], left)

        def segment(carry: Any, us: Any) -> tuple[Any, Any]:
            carry, before = jax.lax.scan(chunk, carry, us, length=kept)
            return carry, (carry[1], before)

        start = (jnp.int32(0), tuple(state))
        _, (after, (before, left)) = jax.lax.scan(segment, start, controls, length=saved)
        states = [jnp.concatenate([x[None], y]) for x, y in zip(state, after, strict=True)]
        return (
            states,
            [x.reshape(-1, *x.shape[2:]) for x in before],
            [x.reshape(self.steps, -1) for x in left],
        )

    def _advance(self, carry: Any, u: Any, others: Sequence[Any], pull: Pullback | None) -> Any:
        """The number and the state of the next step, and what the step leaves for `pull`."""
        i, state = carry
        step = pull.forward if pull else self.step
        new = run(step, [i, *state, *_given(u), *others])  # one equation, however long it is
        return (i + 1, tuple(new[: self.size])), tuple(new[self.size :])

    def _pull(self, moving: Moving, args: Sequence[Any], kept: Any, bars: Any) -> list:
        state, controls, others = self._parts(args)
        saved, chunks, k = self._turns
        kept, left = list(kept[: self.size]), kept[self.size :]
        if self.k == self.save_every:  # the results, without the last
            kept = [x[:-1] for x in kept]
        kept, left = (
            tuple(x.reshape(saved, chunks, *x.shape[1:]) for x in xs) for xs in (kept, left)
        )
        bars = [
            jnp.zeros((saved + 1, *x.shape), x.dtype) if bar is None else bar
            for x, bar in zip(state, bars, strict=True)
        ]
        first = self.size + self.driven  # of the others
        which = [n for n in range(len(others)) if moving[first + n]]
        steered = self.driven and moving[self.size]
        pull = self.pullback(moving)
        held = pull if 0 < k * pull.bytes <= HELD_UP_TO else None

        def once(carry: Any, x: Any) -> tuple[Any, Any]:
            i, bar, sums = carry
            state, u, left = x
            at = (i - 1, *state, *_given(u), *others)
            left = left or pull.forward(*at)[self.size :]
            found = pull(at, left[0], bar)
            new, found = tuple(found[: self.size]), found[self.size :]
            u_bar = found.pop(0) if steered else None
            sums = tuple(a + b for a, b in zip(sums, found, strict=True))
            return (i - 1, new, sums), u_bar

        def chunk(carry: Any, x: Any) -> tuple[Any, Any]:
            start, left, us = x
            if k == 1:
                u = None if us is None else us[0]
                carry, u_bar = once(carry, (start, u, left))
                return carry, None if u_bar is None else u_bar[None]

            def again(carry: Any, u: Any) -> tuple[Any, Any]:
                after, left = self._advance(carry, u, others, held)
                return after, (carry[1], left)

            states, left = jax.lax.scan(again, (carry[0] - k, start), us, length=k)[1]
            return jax.lax.scan(once, carry, (states, us, left), length=k, reverse=True)

        def segment(carry: Any, x: Any) -> tuple[Any, Any]:
            (i, bar, sums), (more, *rest) = carry, x
            carry = i, tuple(a + b for a, b in zip(bar, more, strict=True)), sums
            return jax.lax.scan(chunk, carry, tuple(rest), length=chunks, reverse=True)

        carry = (
            jnp.int32(self.steps),
            tuple(jnp.zeros_like(x) for x in state),
            tuple(jnp.zeros_like(others[n]) for n in which),
        )
        xs = tuple(bar[1:] for bar in bars), kept, left, controls
        (_, bar, sums), u_bar = jax.lax.scan(segment, carry, xs, length=saved, reverse=True)
        out = [
            own + saved_first[0]
            for own, saved_first, m in zip(bar, bars, moving[: self.size], strict=True) if m
        ]  # fmt: skip
        if steered:
            control = self.step.inputs[1 + self.size]
            out.append(u_bar.reshape(self.steps, *control.shape))
        return out + list(sums)


def _given(u: Any) -> tuple:
    return () if u is None else (u,)


def keep_every(save_every: int, steps: int, bytes_each: int, budget: float) -> int:
    """The smallest divisor k of save_every for which steps / k states fit into the budget, or
    save_every where none does.

    >>> keep_every(100, 1000, 4, 4000), keep_every(100, 1000, 4, 500), keep_every(7, 7, 4, 1)
    (1, 10, 7)
    """
    for k in range(1, save_every + 1):
        if save_every % k == 0 and math.ceil(steps / k) * bytes_each <= budget:
            return k
    return save_every


#: operations of a step from which on it is faster to keep what it leaves than to compute it again
LEAVING_ABOVE = 4_000
#: a policy of more operations runs between the steps
POLICY_UP_TO = 4_000


def on_threads(
    model: Model, state: Any, ctrls: Any, dt: jax.Array, policy: Any, integrator: str,
    save_every: int, steps: int, batched: bool, memory: float,
) -> list[jax.Array]:  # fmt: skip
    """The states (..., T, nq) and (..., T, nv) of a rollout, one sample a thread.

    A policy of few operations is part of the thread. A larger one is evaluated for the whole batch
    between the steps, by XLA's matrix products.
    """
    q, v = state.q, state.v
    model = made_ahead(known_zeros(drivers.on_threads(model, q.dtype)), q.dtype)
    one = [x[0] if batched else x for x in (q, v)]
    between = policy is not None and _is_large(policy, dt, one)
    driven = ctrls is not None or between
    moving, closed = opened((model, dt))

    def once(i: jax.Array, q: jax.Array, v: jax.Array, *rest: jax.Array) -> list[jax.Array]:
        ctrl = rest[0] if driven else None
        model, dt = closed(list(rest[driven:]))
        if policy is not None and not between:
            ctrl = jnp.asarray(policy(i * dt, State(q, v)), q.dtype)
        return list(INTEGRATORS[integrator](model, q, v, ctrl, dt))

    control = [jnp.zeros(model.nu, q.dtype)] if driven else []
    step, shared = trace(once, [jnp.int32(0), *one, *control, *moving])
    own = 3 + driven
    known = [True] * len(shared) + [False] * own + [True] * len(moving)
    step, shared = split(step, known, [*shared, *[None] * own, *moving])
    if between:
        return _between(step, shared, policy, q, v, dt, save_every, steps, batched, memory)
    march = functools.partial(March, step, 2, steps, save_every, driven)
    each = sum(x.size * x.dtype.itemsize for x in one)

    @functools.cache
    def sized(batch: int, moving: Moving) -> Program:
        left = march(1).pullback(moving).bytes
        fits = left and steps * batch * (each + left) <= memory
        if fits and operation_count(step, *step.inputs).total > LEAVING_ABOVE:
            return march(1, leaving=True).program(plain)
        return march(keep_every(save_every, steps, batch * each, memory)).program(plain)

    plain = march(save_every).program()
    program = Program(plain.closed, sized=sized)
    given = [q, v] if ctrls is None else [q, v, ctrls]
    f = functools.partial(_run, program)
    if batched:
        shapes = [2, 2, 3][: len(given)]
        axes = [0 if x.ndim == n else None for x, n in zip(given, shapes, strict=True)]
        f = jax.vmap(f, in_axes=(*axes, *[None] * len(shared)))
    return f(*given, *shared)


def _run(program: Program, *operands: jax.Array) -> list[jax.Array]:
    return run(program, operands)


def _is_large(policy: Callable, dt: jax.Array, one: list[jax.Array]) -> bool:
    count = operation_count(lambda q, v: policy(0 * dt, State(q, v)), *one)
    return count.total > POLICY_UP_TO


def _between(
    step: Program, shared: list, policy: Callable, q: jax.Array, v: jax.Array, dt: jax.Array,
    save_every: int, steps: int, batched: bool, memory: float,
) -> list[jax.Array]:  # fmt: skip
    """A rollout whose policy is evaluated by XLA, and whose steps are a kernel each."""

    def act(args: list, /) -> Any:
        def one(i: jax.Array, q: jax.Array, v: jax.Array) -> jax.Array:
            return jnp.asarray(policy(i * dt, State(q, v)), q.dtype)

        return (jax.vmap(one, in_axes=(None, 0, 0)) if batched else one)(*args)

    def advance(i: jax.Array, q: jax.Array, v: jax.Array, u: jax.Array) -> list[jax.Array]:
        return run(step, [i, q, v, u, *shared])

    if batched:
        act = on_each_device(act, [jnp.int32(0), q, v], [None, 0, 0], q.shape[0])
        advance = jax.vmap(advance, in_axes=(None, 0, 0, 0))

    @functools.partial(jax.checkpoint, prevent_cse=False)  # the network's inside is not kept
    def once(carry: Any, _: None) -> tuple[Any, None]:
        i, q, v = carry
        return (i + 1, *advance(i, q, v, act([i, q, v]))), None

    def segment(carry: Any, _: None) -> tuple[Any, Any]:
        # a turn of XLA's loop costs as much as a small kernel
        carry, _ = jax.lax.scan(once, carry, None, length=save_every, unroll=min(4, save_every))
        return carry, carry[1:]

    if steps * sum(x.size * x.dtype.itemsize for x in (q, v)) > memory:
        segment = jax.checkpoint(segment, prevent_cse=False)
    _, saved = jax.lax.scan(segment, (jnp.int32(0), q, v), None, length=steps // save_every)
    states = [jnp.concatenate([x[None], y]) for x, y in zip((q, v), saved, strict=True)]
    return [jnp.moveaxis(x, 0, 1) for x in states] if batched else states
