"""The transposed derivative of a step, from what the step has left behind.

`forward_dynamics` names its acceleration and its factors of the mass matrix. Where a derivative
follows, a step keeps these beside its results, and the transposed step reads them; all else it
computes again from the arguments.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Literal, Var, jaxpr_as_fun

from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import Program, traced
from rbjax.dynamics.algorithms.aba import LEFT


class Pullback:
    """Of a step, with respect to those of its arguments that move.

    forward: the arguments -> the results, and a vector of what is left.
    """

    def __init__(self, forward: Program, back: Callable):
        """back(args, left, bars) -> the cotangents of the arguments that move."""
        self.forward, self._back = forward, back

    @classmethod
    def of(cls, step: Program, moving: tuple[bool, ...]) -> Pullback:
        """The one of this step; made once."""
        key = "pullback", moving
        if key not in step.derived:
            step.derived[key] = cls(*(_straight(step, moving) or _by_jax(step, moving)))
        return step.derived[key]

    @property
    def left(self) -> jax.ShapeDtypeStruct:
        """The vector that a step leaves."""
        return self.forward.outputs[-1]

    @property
    def bytes(self) -> int:
        return self.left.size * self.left.dtype.itemsize

    def __call__(self, args: Sequence[Any], left: jax.Array, bars: Sequence[Any]) -> list[Any]:
        """The cotangents of the arguments that move, of those of the results."""
        return self._back(args, left, bars)


def _straight(step: Program, moving: tuple[bool, ...]) -> tuple[Program, Callable] | None:
    """Of a step without loops: the named values are inputs of the transposed step."""
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


def _by_jax(step: Program, moving: Sequence[bool]) -> tuple[Program, Callable]:
    """Of any step: JAX keeps the named values of a checkpoint."""
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
