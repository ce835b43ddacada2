"""Functions of one sample, traced, and the programs of their derivatives."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from rbjax.compiler.jax.derivatives import Linearised, Transposed
from rbjax.compiler.jax.uncollected import uncollected

Moving = tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class Program:
    """A function of one sample, traced.

    vjp: the transposed derivative, vjp(moving, args, kept, bars) -> cotangents of the arguments
        that move, from the cotangents of the results (None for zero). If None, that of the jaxpr,
        which needs only the arguments.
    keeping: moving arguments -> the program that runs instead of this one for a derivative. Its
        results are the same, and more that `vjp` reads.
    reads: the index of the first result that `vjp` reads, as `kept`.
    sized: the program that replaces this one for the derivative of a batch of a given size, by the
        arguments that move.
    apart: the same function as several kernels, for a batch on a GPU. Inside another program, and
        for derivatives, the traced one is used.
    up_to: the largest batch for which `apart` is used; None for any.
    once: it runs once where others run many times, so that on a CPU its compile time matters more
        than its run time; on a GPU XLA runs it. Its derivatives run once, too.
    team: on a GPU a team of threads runs a sample, if its arrays fit into shared memory. Of
        derivatives a thread does.
    """

    closed: ClosedJaxpr
    vjp: Callable | None = None
    keeping: Callable[[Moving], Program] | None = None
    reads: int = 0
    sized: Callable[[int, Moving], Program] | None = None
    apart: Callable | None = None
    up_to: int | None = None
    once: bool = False
    team: bool = False
    derived: dict[Any, Any] = field(default_factory=dict)
    split: dict[Any, Any] = field(default_factory=dict)

    @property
    def inputs(self) -> list[Any]:
        return [v.aval for v in self.closed.jaxpr.invars]

    @property
    def outputs(self) -> list[Any]:
        return [v.aval for v in self.closed.jaxpr.outvars]

    def kept(self, moving: Moving) -> list[Any]:
        """The inputs of a derivative besides the arguments."""
        return self.keeping(moving).outputs[self.reads :] if self.keeping else []

    def __call__(self, *args: jax.Array) -> list[jax.Array]:
        return jaxpr_as_fun(self.closed)(*args)

    def goes_apart(self, samples: int) -> bool:
        """Whether a batch on a GPU runs as several kernels."""
        return self.apart is not None and (self.up_to is None or samples <= self.up_to)

    def derive(self, key: Any, f: Callable, *avals: Any) -> Program:
        """Another program derived from this one, cached."""
        if key not in self.derived:
            self.derived[key] = dataclasses.replace(traced(f, *avals), once=self.once)
        return self.derived[key]

    def parts(self, shared: tuple[bool, ...], split: Callable) -> Any:
        """The rest, and the part that depends only on shared operands (`uniform`), cached."""
        if shared not in self.split:
            self.split[shared] = split(self, shared)
        return self.split[shared]

    def _along(self, moving: Moving, args: Any) -> tuple[Callable, list[Any]]:
        """This as a function of the arguments that move, and these arguments."""

        def along(*changed: jax.Array) -> list[jax.Array]:
            rest = iter(changed)
            return self(*(next(rest) if m else x for m, x in zip(moving, args, strict=True)))

        return along, [x for m, x in zip(moving, args, strict=True) if m]

    def transposed_equations(self, moving: Moving, weighed: Moving) -> Transposed | None:
        """The equations of the cotangents of arguments that move; None where they have loops."""
        if self.closed.effects or self.vjp is not None:
            return None
        return self._linearised(moving).transposed(weighed)

    def _linearised(self, moving: Moving) -> Linearised:
        """Its equations and those of its rates, cached."""
        key = "linearised", moving
        if key not in self.derived:
            self.derived[key] = Linearised.of(self.closed, moving)
        return self.derived[key]

    def tangent(self, moving: Moving) -> Program:
        """(args, kept, tangents of those that move) -> tangents of all results."""
        kept = self.kept(moving)
        key = "tangent", moving
        if key not in self.derived and not self.closed.effects:
            self.derived[key] = Program(self._linearised(moving).tangent(kept), once=self.once)

        def f(*xs: jax.Array) -> list[jax.Array]:
            rates = list(xs[len(moving) + len(kept) :])
            found = jax.jvp(*self._along(moving, xs[: len(moving)]), rates)[1]
            return [  # a zero tangent has dtype float0, which no array here can have
                t if jnp.issubdtype(a.dtype, jnp.floating) else jnp.zeros(a.shape, a.dtype)
                for t, a in zip(found, self.outputs, strict=True)
            ]

        rates = [a for m, a in zip(moving, self.inputs, strict=True) if m]
        return self.derive(key, f, *self.inputs, *kept, *rates)

    def transposed(self, moving: Moving, weighed: tuple[bool, ...]) -> Program:
        """(args, kept, cotangents of the weighed results) -> cotangents of those that move."""
        also = self.kept(moving)
        key = "vjp", moving, weighed
        if key not in self.derived and self.vjp is None:
            back = self.transposed_equations(moving, weighed)
            if back is not None:
                self.derived[key] = Program(back.closed(), once=self.once)

        def f(*xs: jax.Array) -> list[jax.Array]:
            n, end = len(moving), len(moving) + len(also)
            args, kept, given = xs[:n], xs[n:end], iter(xs[end:])
            if self.vjp is not None:
                bars = [next(given) if w else None for w in weighed]
                return self.vjp(moving, args, kept, bars)

            along, moved = self._along(moving, args)

            def wanted(*changed: jax.Array) -> list[jax.Array]:
                return [y for w, y in zip(weighed, along(*changed), strict=True) if w]

            return list(jax.vjp(wanted, *moved)[1](list(given)))

        bars = [a for w, a in zip(weighed, self.outputs, strict=True) if w]
        return self.derive(key, f, *self.inputs, *also, *bars)


@uncollected
def traced(f: Callable, *avals: Any) -> Program:
    """The program of a function of flat arguments that closes over no traced values."""
    return Program(jax.make_jaxpr(f)(*(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals)))
