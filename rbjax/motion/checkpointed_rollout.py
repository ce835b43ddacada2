"""Rollout of one sample as one thread program, with a reverse gradient of bounded memory.

The forward program stores a checkpoint, the state before every k-th step. The reverse program
computes the k steps from each checkpoint again, keeps their states in the thread's own memory, and
transposes them from the last to the first. A sample stores steps / k checkpoints and k states. If
memory allows, each step is stored with its residuals for the vjp: the acceleration and the factors
of the mass matrix, which `forward_dynamics` names. The vjp computes all other values again.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import Moving, Program, traced
from rbjax.compiler.jax.saved import HELD_UP_TO, SavedVjp

Arrays = tuple[jax.Array, ...]


@dataclass(frozen=True)
class CheckpointedRollout:
    """A loop of steps `step(i, *state, control, *others) -> state` as a program.

    size: number of arrays of the state.
    driven: whether the step has a control.
    k: number of steps from one checkpoint to the next, a divisor of save_every.
    keep_residuals: whether the residuals of the steps are saved too; then k is 1.
    """

    step: Program
    size: int
    steps: int
    save_every: int
    driven: bool
    k: int
    keep_residuals: bool = False

    def program(self, plain: Program | None = None) -> Program:
        """Build the program (*state, controls (steps, nu), *others) -> states.

        The states have the shape (1 + steps / save_every, ...).
        plain: the program without a derivative, if it has been traced.
        """
        avals: list[Any] = list(self.step.inputs[1:])
        if self.driven:
            u = avals[self.size]
            avals[self.size] = jax.ShapeDtypeStruct((self.steps, *u.shape), u.dtype)
        plain = plain or traced(lambda *args: self._forward(args)[0], *avals)
        every = self.k == self.save_every  # every checkpoint is also a result

        @functools.cache
        def keeping(moving: Moving) -> Program:
            if every and not self.keep_residuals:
                return plain

            def f(*args: Any) -> list:
                states, before, left = self._forward(
                    args, self.step_vjp(moving) if self.keep_residuals else None
                )
                return [*states, *([] if every else before), *left]

            return traced(f, *avals)

        return Program(
            plain.closed,
            vjp=self._vjp,
            forward_with_residuals=keeping,
            first_residual=0 if every else self.size,
        )

    def step_vjp(self, moving: Sequence[bool]) -> SavedVjp:
        """Return the vjp of the step by the differentiated (`moving`) arguments of the rollout."""
        first = self.size + self.driven
        own = (False, *[True] * self.size, *moving[self.size : first], *moving[first:])
        return SavedVjp.of(self.step, own)

    def _parts(self, args: Sequence[Any]) -> tuple[Arrays, Any, Sequence[Any]]:
        state, rest = tuple(args[: self.size]), args[self.size :]
        if not self.driven:
            return state, None, rest
        return state, rest[0].reshape(*self._turns, *rest[0].shape[1:]), rest[1:]

    @property
    def _turns(self) -> tuple[int, int, int]:
        """The lengths of the three nested loops: number of saved states, of checkpoints per saved
        state, and of steps per checkpoint."""
        return self.steps // self.save_every, self.save_every // self.k, self.k

    def _forward(
        self, args: Sequence[Any], step_vjp: SavedVjp | None = None
    ) -> tuple[list, list, list]:
        """Run all steps; return saved states, checkpoints, and the residuals for `step_vjp`."""
        state, controls, others = self._parts(args)
        saved, kept, k = self._turns

        def once(carry: Any, u: Any) -> tuple[Any, Any]:
            return self._advance(carry, u, others, step_vjp)

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
            [x.reshape(saved * kept, *x.shape[2:]) for x in before],
            [x.reshape(self.steps, -1) for x in left],
        )

    def _advance(self, carry: Any, u: Any, others: Sequence[Any], step_vjp: SavedVjp | None) -> Any:
        """Advance (step index, state) by a step with control u. Also return the residuals for
        `step_vjp`."""
        i, state = carry
        step = step_vjp.forward if step_vjp else self.step
        new = run(step, [i, *state, *_given(u), *others])  # one equation for any length
        return (i + 1, tuple(new[: self.size])), tuple(new[self.size :])

    def _vjp(self, moving: Moving, args: Sequence[Any], kept: Any, bars: Any) -> list:
        state, controls, others = self._parts(args)
        saved, chunks, k = self._turns
        kept, left = list(kept[: self.size]), kept[self.size :]
        if self.k == self.save_every:  # the checkpoints are the results without the last
            kept = [x[:-1] for x in kept]
        kept, left = (
            tuple(x.reshape(saved, chunks, *x.shape[1:]) for x in xs) for xs in (kept, left)
        )
        bars = [
            jnp.zeros((saved + 1, *x.shape), x.dtype) if bar is None else bar
            for x, bar in zip(state, bars, strict=True)
        ]
        first = self.size + self.driven  # index of the first of `others`
        which = [n for n in range(len(others)) if moving[first + n]]
        steered = self.driven and moving[self.size]
        step_vjp = self.step_vjp(moving)
        held = step_vjp if 0 < k * step_vjp.bytes <= HELD_UP_TO else None

        def once(carry: Any, x: Any) -> tuple[Any, Any]:
            i, bar, sums = carry
            state, u, left = x
            at = (i - 1, *state, *_given(u), *others)
            left = left or step_vjp.forward(*at)[self.size :]
            found = step_vjp(at, left[0], bar)
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


def checkpoint_interval(save_every: int, steps: int, bytes_each: int, budget: float) -> int:
    """Return the smallest divisor k of save_every for which steps / k states fit into the budget;
    save_every if none fits.

    >>> checkpoint_interval(100, 1000, 4, 4000), checkpoint_interval(100, 1000, 4, 500)
    (1, 10)
    >>> checkpoint_interval(7, 7, 4, 1)
    7
    """
    for k in range(1, save_every + 1):
        if save_every % k == 0 and math.ceil(steps / k) * bytes_each <= budget:
            return k
    return save_every
