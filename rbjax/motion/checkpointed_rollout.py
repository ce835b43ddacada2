"""Rollout of one sample as one thread program, with a reverse gradient of bounded memory.

The forward program stores a checkpoint, the state before every k-th step. The reverse program
computes the k steps from each checkpoint again, keeps their states in the thread's own memory, and
transposes them from the last to the first. A sample stores steps / k checkpoints and k states. If
memory allows, each step is stored with its residuals for the vjp: the acceleration and the factors
of the mass matrix, which `forward_dynamics` names. The vjp computes all other values again.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Literal, Var, jaxpr_as_fun

from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import Moving, Program, traced
from rbjax.dynamics.algorithms.aba import LEFT

Arrays = tuple[jax.Array, ...]

#: bytes of its own memory that a thread may use for the residuals of recomputed steps
HELD_UP_TO = 16 * 1024


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

    def step_vjp(self, moving: Sequence[bool]) -> StepVjp:
        """Return the vjp of the step by the differentiated (`moving`) arguments of the rollout."""
        first = self.size + self.driven
        own = (False, *[True] * self.size, *moving[self.size : first], *moving[first:])
        return StepVjp.of(self.step, own)

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
        self, args: Sequence[Any], step_vjp: StepVjp | None = None
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
            [x.reshape(-1, *x.shape[2:]) for x in before],
            [x.reshape(self.steps, -1) for x in left],
        )

    def _advance(self, carry: Any, u: Any, others: Sequence[Any], step_vjp: StepVjp | None) -> Any:
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


class StepVjp:
    """The vjp of a step by some of its arguments, from saved residuals.

    forward: program from the arguments to the results and the vector of residuals.
    """

    def __init__(self, forward: Program, back: Callable):
        """back: function (args, residuals, cotangents of the results) -> cotangents of the
        arguments."""
        self.forward, self._back = forward, back

    @classmethod
    def of(cls, step: Program, moving: tuple[bool, ...]) -> StepVjp:
        """Build the vjp of a step, or return the cached one."""
        key = "step_vjp", moving
        vjps = (f(step, moving) for f in (_vjp_of_equations, _vjp_of_checkpoint))
        return step.memoize(key, lambda: cls(*next(x for x in vjps if x is not None)))

    @property
    def residuals(self) -> Any:
        """The abstract value of the vector of residuals."""
        return self.forward.outputs[-1]

    @property
    def bytes(self) -> int:
        return self.residuals.size * self.residuals.dtype.itemsize

    def __call__(self, args: Sequence[Any], left: jax.Array, bars: Sequence[Any]) -> list[Any]:
        """Compute the cotangents of the arguments from the residuals `left` and the cotangents
        `bars` of the results."""
        return self._back(args, left, bars)


def _vjp_of_equations(step: Program, moving: tuple[bool, ...]) -> tuple[Program, Callable] | None:
    """Build the vjp of a step without loops. Its residuals are the values marked by
    `checkpoint_name`. Return None if the step cannot be transposed as equations."""
    back = step.transposed_equations(moving, (True,) * len(step.outputs))
    if back is None:
        return None
    named = [
        eqn.outvars[0] for eqn in back.forward
        if eqn.primitive.name == "name" and eqn.params["name"] in LEFT
    ]  # fmt: skip
    whole = back.closed(given=named)
    read = {a for eqn in whole.jaxpr.eqns for a in eqn.invars if isinstance(a, Var)}
    left = [v for v in named if v in read]
    shapes: list[Any] = [v.aval for v in left]
    rest, n = Program(back.closed(given=left)), len(step.outputs)
    values = Program(back.values(left))

    def forward(*args: Any) -> list[Any]:
        found = run(values, args)
        return [*found[:n], _vector(found[n:], step.outputs[0].dtype)]

    def backward(args: Sequence[Any], vector: jax.Array, bars: Sequence[Any]) -> list[Any]:
        parts, start = [], 0
        for a in shapes:
            parts.append(vector[start : start + a.size].reshape(a.shape))
            start += a.size
        return run(rest, [*args, *parts, *bars])

    return traced(forward, *step.inputs), backward


def _vector(parts: Sequence[jax.Array], dtype: Any) -> jax.Array:
    return jnp.concatenate([jnp.zeros(0, dtype), *(x.ravel() for x in parts)])


def _vjp_of_checkpoint(step: Program, moving: Sequence[bool]) -> tuple[Program, Callable]:
    """Build the vjp of any step by `jax.checkpoint`, which saves the values marked by
    `checkpoint_name`."""
    trees: list[Any] = []

    def linearised(*args: Any) -> list[Any]:
        def along(*changed: Any) -> list[Any]:
            rest = iter(changed)
            return step(*(next(rest) if m else x for m, x in zip(moving, args, strict=True)))

        keep = jax.checkpoint_policies.save_only_these_names(*LEFT)
        along = jax.checkpoint(along, prevent_cse=False, policy=keep)
        new, pullback = jax.vjp(along, *itertools.compress(args, moving))
        leaves, tree = jax.tree.flatten(pullback)
        trees.append(tree)
        return [*new, *leaves]

    closed = jax.make_jaxpr(linearised)(*step.inputs)
    n, jaxpr = len(step.outputs), closed.jaxpr
    places: dict[Any, tuple[str, Any]] = {v: ("argument", k) for k, v in enumerate(jaxpr.invars)}
    places |= {v: ("constant", x) for v, x in zip(jaxpr.constvars, closed.consts, strict=True)}
    sources: list[tuple[str, Any]] = [
        ("constant", v.val) if isinstance(v, Literal) else places.get(v, ("left", v.aval))
        for v in jaxpr.outvars[n:]
    ]
    held = [kind == "left" for kind, _ in sources]

    def forward(*args: Any) -> list[Any]:
        found = jaxpr_as_fun(closed)(*args)
        left = list(itertools.compress(found[n:], held))
        return [*found[:n], _vector(left, step.outputs[0].dtype)]

    def backward(args: Sequence[Any], left: jax.Array, bars: Sequence[Any]) -> list[Any]:
        leaves, start = [], 0
        for kind, source in sources:
            if kind == "left":
                leaves.append(left[start : start + source.size].reshape(source.shape))
                start += source.size
            else:
                leaves.append(args[source] if kind == "argument" else source)
        return list(jax.tree.unflatten(trees[0], leaves)(list(bars)))

    return traced(forward, *step.inputs), backward
