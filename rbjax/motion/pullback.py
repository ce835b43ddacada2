"""The transposed derivative of a step, from what the step has left behind.

`forward_dynamics` names its acceleration and its factors of the mass matrix. Where a derivative
follows, a step keeps these beside its results, and the transposed step reads them; all else it
computes again from the arguments.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Literal, jaxpr_as_fun

from rbjax.dynamics.forward import LEFT
from rbjax.threads.programs import Program, traced


class Pullback:
    """Of a step, with respect to those of its arguments that move.

    forward: the arguments -> the results, and a vector of what is left.
    """

    forward: Program

    def __init__(self, step: Program, moving: Sequence[bool]):
        def linearised(*args: Any) -> list[Any]:
            def along(*changed: Any) -> list[Any]:
                rest = iter(changed)
                return step(*(next(rest) if m else x for m, x in zip(moving, args, strict=True)))

            keep = jax.checkpoint_policies.save_only_these_names(*LEFT)
            along = jax.checkpoint(along, prevent_cse=False, policy=keep)
            new, pullback = jax.vjp(along, *itertools.compress(args, moving))
            leaves, self._tree = jax.tree.flatten(pullback)
            return [*new, *leaves]

        closed = jax.make_jaxpr(linearised)(*step.inputs)
        n, jaxpr = len(step.outputs), closed.jaxpr
        places = {v: ("argument", k) for k, v in enumerate(jaxpr.invars)}
        places |= {v: ("constant", x) for v, x in zip(jaxpr.constvars, closed.consts, strict=True)}
        self._sources: list[tuple[str, Any]] = [
            ("constant", v.val) if isinstance(v, Literal) else places.get(v, ("left", v.aval))
            for v in jaxpr.outvars[n:]
        ]
        held = [kind == "left" for kind, _ in self._sources]

        def forward(*args: Any) -> list[Any]:
            found = jaxpr_as_fun(closed)(*args)
            left = itertools.compress(found[n:], held)
            empty = jnp.zeros(0, step.outputs[0].dtype)
            return [*found[:n], jnp.concatenate([empty, *(x.ravel() for x in left)])]

        self.forward = traced(forward, *step.inputs)

    @classmethod
    def of(cls, step: Program, moving: tuple[bool, ...]) -> Pullback:
        """The one of this step; made once."""
        key = "pullback", moving
        if key not in step.derived:
            step.derived[key] = cls(step, moving)
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
        leaves, start = [], 0
        for kind, source in self._sources:
            if kind == "left":
                leaves.append(left[start : start + source.size].reshape(source.shape))
                start += source.size
            else:
                leaves.append(args[source] if kind == "argument" else source)
        return list(jax.tree.unflatten(self._tree, leaves)(list(bars)))
