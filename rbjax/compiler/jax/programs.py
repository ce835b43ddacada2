"""Traced functions of one sample, and the programs of their derivatives."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Var, jaxpr_as_fun

from rbjax.compiler.jax.derivatives import LinearisedJaxpr, Transposed, dependents
from rbjax.compiler.jax.garbage import gc_paused

Moving = tuple[bool, ...]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Program:
    """A traced function of one sample. Its arguments that have tangents are called moving.

    closed: its jaxpr.
    vjp: vector-Jacobian product vjp(moving, args, residuals, cotangents) -> cotangents of the
        moving arguments. Zero cotangents of results are None. If `vjp` is None, JAX derives it
        from the jaxpr.
    forward_with_residuals: maps the moving arguments to the program that replaces this one if it is
        differentiated. It returns the same results, and the residuals that `vjp` reads.
    first_residual: index of the first result of that program that is a residual.
    for_batch_size: maps a batch size and the moving arguments to the program whose derivative is
        used.
    multi_kernel: the same function as several kernels, for a batch on a GPU. Derivatives and other
        programs use the traced function.
    max_batch: the largest batch for which `multi_kernel` is used; None for any.
    compile_fast: whether its compile time matters more than its run time, because it runs once. A
        GPU then runs it under XLA. This also holds for its derivatives.
    team: whether a block of GPU threads runs a sample, if its arrays fit into shared memory. One
        thread runs its derivatives.
    saves: whether a reverse derivative reads the named values of the forward pass, if they fit
        into memory, instead of computing them again (`saved`).
    derived: cache of programs made from this one.
    """

    closed: ClosedJaxpr
    vjp: Callable | None = None
    forward_with_residuals: Callable[[Moving], Program] | None = None
    first_residual: int = 0
    for_batch_size: Callable[[int, Moving], Program] | None = None
    multi_kernel: Callable | None = None
    max_batch: int | None = None
    compile_fast: bool = False
    team: bool = False
    saves: bool = False
    derived: dict[Hashable, object] = field(default_factory=dict)

    @property
    def inputs(self) -> list[ShapedArray]:
        return [cast(ShapedArray, v.aval) for v in self.closed.jaxpr.invars]

    @property
    def outputs(self) -> list[ShapedArray]:
        return [cast(ShapedArray, v.aval) for v in self.closed.jaxpr.outvars]

    def residuals(self, moving: Moving) -> list[ShapedArray]:
        """Return the avals of the saved residuals, which follow the arguments of the derivative."""
        forward = self.forward_with_residuals
        return forward(moving).outputs[self.first_residual :] if forward else []

    def __call__(self, *args: jax.Array) -> list[jax.Array]:
        return jaxpr_as_fun(self.closed)(*args)

    def uses_multi_kernel(self, samples: int) -> bool:
        """Return whether a batch of this size runs as several kernels on a GPU."""
        fits = self.max_batch is None or samples <= self.max_batch
        return self.multi_kernel is not None and fits

    def memoize(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return make(), or its earlier result for this key."""
        if key not in self.derived:
            self.derived[key] = make()
        return cast(T, self.derived[key])

    def depends(self, moving: Sequence[bool]) -> bool:
        """Return whether all results depend on the moving arguments."""
        jaxpr = self.closed.jaxpr
        start = [v for v, m in zip(jaxpr.invars, moving, strict=True) if m]
        found = dependents(jaxpr.eqns, start)
        return all(isinstance(a, Var) and a in found for a in jaxpr.outvars)

    def tangent(self, moving: Moving) -> Program:
        """Return the program (args, residuals, tangents of moving args) -> tangents of results."""
        return self.memoize(("tangent", moving), lambda: self._tangent(moving))

    def transposed(self, moving: Moving, has_cotangent: Moving) -> Program:
        """Return the program (args, residuals, cotangents) -> cotangents of the moving args."""
        key = "transposed", moving, has_cotangent
        return self.memoize(key, lambda: self._transposed(moving, has_cotangent))

    def transposed_equations(self, moving: Moving, has_cotangent: Moving) -> Transposed | None:
        """Return the equations of the transposed derivative.

        Returns None if the program has a `vjp` or effects, or if an equation computes values and
        tangents together.
        """
        if self.closed.effects or self.vjp is not None:
            return None
        return self.linearised(moving).transposed(has_cotangent)

    def linearised(self, moving: Moving) -> LinearisedJaxpr:
        """Return the linearisation by the moving arguments."""
        return self.memoize(("linear", moving), lambda: LinearisedJaxpr.of(self.closed, moving))

    def _tangent(self, moving: Moving) -> Program:
        residuals = self.residuals(moving)
        if not self.closed.effects:
            return self._same(self.linearised(moving).tangent(residuals))

        def f(*xs: jax.Array) -> list[jax.Array]:
            tangents = list(xs[len(moving) + len(residuals) :])
            found = jax.jvp(*self._restricted(moving, xs[: len(moving)]), tangents)[1]
            return [  # a zero tangent has dtype float0
                t if jnp.issubdtype(a.dtype, jnp.floating) else jnp.zeros(a.shape, a.dtype)
                for t, a in zip(found, self.outputs, strict=True)
            ]

        tangents = [a for m, a in zip(moving, self.inputs, strict=True) if m]
        return self._same(traced(f, *self.inputs, *residuals, *tangents).closed)

    def _transposed(self, moving: Moving, has_cotangent: Moving) -> Program:
        equations = self.transposed_equations(moving, has_cotangent)
        if equations is not None:
            return self._same(equations())
        residuals = self.residuals(moving)
        n, end = len(moving), len(moving) + len(residuals)

        def f(*xs: jax.Array) -> list[jax.Array]:
            given = iter(xs[end:])
            if self.vjp is not None:
                cotangents = [next(given) if c else None for c in has_cotangent]
                return self.vjp(moving, xs[:n], xs[n:end], cotangents)
            restricted, moved = self._restricted(moving, xs[:n])

            def wanted(*changed: jax.Array) -> list[jax.Array]:
                return [y for c, y in zip(has_cotangent, restricted(*changed), strict=True) if c]

            return list(jax.vjp(wanted, *moved)[1](list(given)))

        cotangents = [a for c, a in zip(has_cotangent, self.outputs, strict=True) if c]
        return self._same(traced(f, *self.inputs, *residuals, *cotangents).closed)

    def _same(self, closed: ClosedJaxpr) -> Program:
        return Program(closed, compile_fast=self.compile_fast)

    def _restricted(
        self, moving: Moving, args: Sequence[jax.Array]
    ) -> tuple[Callable, list[jax.Array]]:
        """Return this program as a function of its moving arguments, and these arguments."""

        def restricted(*changed: jax.Array) -> list[jax.Array]:
            rest = iter(changed)
            return self(*(next(rest) if m else x for m, x in zip(moving, args, strict=True)))

        return restricted, [x for m, x in zip(moving, args, strict=True) if m]


@gc_paused()
def traced(f: Callable, *avals: jax.ShapeDtypeStruct | ShapedArray) -> Program:
    """Return the program of a function of flat arrays. f must not close over traced values."""
    return Program(jax.make_jaxpr(f)(*(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals)))
