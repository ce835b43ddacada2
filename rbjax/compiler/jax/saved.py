"""The vjp of a program from values that its forward pass saves.

The values are those with a name of `LEFT`: solutions of equations, factors of matrices, contacts in
use. The vjp computes all other values again.

A program that saves (`Program.saves`) has this vjp. Between programs the saved values are arrays of
a batch. In a loop inside of a program they are in the memory of a thread, so they must be few.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun
from jax.extend.core.primitives import closed_call_p

from rbjax.compiler.jax.derivatives import JaxprBuilder, needed
from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import Program, traced

#: the names (`checkpoint_name`) of values that a derivative may save instead of recomputing them
LEFT = ("acceleration", "factors", "contacts")
#: bytes of its own memory that a thread may use for saved values
HELD_UP_TO = 16 * 1024
#: number of times that the program which is being traced runs an equation; 0 outside of programs
_runs: ContextVar[float] = ContextVar("runs", default=0)


class SavedVjp:
    """The vjp of a program by some of its arguments, from saved values.

    forward: program from the arguments to the results and the vector of residuals.
    """

    def __init__(self, forward: Program, back: Callable):
        """back: function (args, residuals, bars) -> cotangents of the arguments."""
        self.forward, self._back = forward, back

    @classmethod
    def of(cls, program: Program, moving: tuple[bool, ...]) -> SavedVjp:
        """Build the vjp of a program, or return the cached one."""
        key = "saved_vjp", moving

        def made() -> SavedVjp:
            whole = _whole(program)
            vjps = (f(whole, moving) for f in (_vjp_of_equations, _vjp_of_checkpoint))
            return cls(*next(x for x in vjps if x is not None))

        return program.memoize(key, made)

    @property
    def residuals(self) -> Any:
        """The abstract value of the vector of residuals."""
        return self.forward.outputs[-1]

    @property
    def bytes(self) -> int:
        return self.residuals.size * self.residuals.dtype.itemsize

    def __call__(self, args: Sequence[Any], left: jax.Array, bars: Sequence[Any]) -> list[Any]:
        """Compute the cotangents of the arguments from residuals and cotangents of the results."""
        return self._back(args, left, bars)


def saving(program: Program, moving: tuple[bool, ...]) -> Program:
    """Return the program whose reverse derivative reads saved values; the given one if it has none,
    or if they are too many for the memory of a thread."""
    saved = SavedVjp.of(program, moving)
    if not saved.bytes or saved.bytes * _runs.get() > HELD_UP_TO:
        return program

    def vjp(moving: Any, args: Sequence[Any], left: Sequence[Any], bars: Sequence[Any]) -> list:
        given = zip(program.outputs, bars, strict=True)
        return saved(args, left[0], [jnp.zeros(x.shape, x.dtype) if y is None else y
                                     for x, y in given])  # fmt: skip

    def made() -> Program:
        return replace(
            _whole(program), vjp=vjp, forward_with_residuals=lambda moving: saved.forward,
            first_residual=len(program.outputs),
        )  # fmt: skip

    return program.memoize(("saving", moving), made)


def _whole(program: Program) -> Program:
    """Return a program without the programs that it calls."""
    closed = program.closed
    return program.memoize(
        "whole", lambda: Program(without_nested(closed), compile_fast=program.compile_fast)
    )


def has_saving(jaxpr: Jaxpr) -> bool:
    """Check whether a program that saves runs once in a jaxpr."""
    return _most_runs(jaxpr) == 1


@contextlib.contextmanager
def inside(program: Program | None = None) -> Iterator[None]:
    """Trace the derivative of a program, or a program whose loops are not known yet."""
    most = math.inf if program is None else _most_runs(program.closed.jaxpr)
    before = _runs.set(max(_runs.get(), 1) * most)
    try:
        yield
    finally:
        _runs.reset(before)


def _most_runs(jaxpr: Any) -> float:
    """Return the largest number of times that a jaxpr runs one program that saves."""
    most: float = 0
    for eqn in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        params = eqn.params
        if eqn.primitive.name == "threads":
            inner: float = params["program"].saves or _most_runs(params["program"].closed)
            times: float = math.prod(params["batch"])
        else:
            within = [
                x for x in jax.tree.leaves([*params.values()]) if isinstance(x, Jaxpr | ClosedJaxpr)
            ]
            inner = max(map(_most_runs, within), default=0)
            times = {"scan": params.get("length"), "while": math.inf}.get(eqn.primitive.name, 1)
        most = max(most, inner and inner * times)
    return most


class _Flat(JaxprBuilder):
    """A builder that inlines programs of one sample, except those with a derivative rule."""

    def inline(self, closed: ClosedJaxpr, args: Sequence[Any], at: JaxprEqn | None) -> list[Any]:
        eqns = [_as_call(eqn) for eqn in closed.jaxpr.eqns]
        return super().inline(ClosedJaxpr(closed.jaxpr.replace(eqns=eqns), closed.consts), args, at)


def _as_call(eqn: JaxprEqn) -> JaxprEqn:
    if eqn.primitive.name != "threads" or eqn.params["batch"]:
        return eqn
    program = eqn.params["program"]
    if program.vjp is not None or program.for_batch_size is not None:
        return eqn
    return eqn.replace(primitive=closed_call_p, params={"call_jaxpr": program.closed})


def without_nested(closed: ClosedJaxpr) -> ClosedJaxpr:
    """Replace the programs that a jaxpr calls by their equations."""
    eqns = _Flat()
    ins = [Var(v.aval) for v in closed.jaxpr.invars]
    return eqns.close(ins, eqns.inline(closed, ins, None))


def _vjp_of_equations(
    program: Program, moving: tuple[bool, ...]
) -> tuple[Program, Callable] | None:
    """Build the vjp of a program without loops, with the named values as residuals; None if the
    program cannot be transposed as equations."""
    linearised = program.linearised(moving)
    parts = None if program.closed.effects else linearised.divided()
    if parts is None:
        return None
    linear, of_values, of_tangents = parts
    along = [t for t in linearised.result_tangents if t is not None]
    of_tangents = needed(of_tangents, along, linearised.tangents)
    named = [
        eqn.outvars[0] for eqn in of_values
        if eqn.primitive.name == "name" and eqn.params["name"] in LEFT
    ]  # fmt: skip
    outs = [v for v in _variables(of_tangents) if v not in linear]
    read = {*outs, *_variables(needed(of_values, outs, named))}
    left = [v for v in named if v in read]
    shapes: list[Any] = [v.aval for v in left]
    values, n = Program(linearised.values(left)), len(program.outputs)

    @functools.cache
    def rest() -> Program:
        back: Any = program.transposed_equations(moving, (True,) * n)
        return Program(back(left))

    def forward(*args: Any) -> list[Any]:
        found = run(values, args)
        return [*found[:n], _vector(found[n:], program.outputs[0].dtype)]

    def backward(args: Sequence[Any], vector: jax.Array, bars: Sequence[Any]) -> list[Any]:
        parts, start = [], 0
        for a in shapes:
            parts.append(_part(vector, start, a))
            start += a.size
        return run(rest(), [*args, *parts, *bars])

    return traced(forward, *program.inputs), backward


def _variables(eqns: Sequence[JaxprEqn]) -> list[Var]:
    """Return the variables that equations read."""
    return [a for eqn in eqns for a in eqn.invars if isinstance(a, Var)]


def _vector(parts: Sequence[jax.Array], dtype: Any) -> jax.Array:
    return jnp.concatenate([jnp.zeros(0, dtype), *(x.ravel().astype(dtype) for x in parts)])


def _part(vector: jax.Array, start: int, like: Any) -> jax.Array:
    """Return a value of the vector of residuals; counters are saved as real numbers."""
    return vector[start : start + like.size].reshape(like.shape).astype(like.dtype)


def _vjp_of_checkpoint(program: Program, moving: Sequence[bool]) -> tuple[Program, Callable]:
    """Build the vjp of any program by `jax.checkpoint`, which saves the named values."""
    trees: list[Any] = []

    def linearised(*args: Any) -> list[Any]:
        def along(*changed: Any) -> list[Any]:
            rest = iter(changed)
            return program(*(next(rest) if m else x for m, x in zip(moving, args, strict=True)))

        keep = jax.checkpoint_policies.save_only_these_names(*LEFT)
        along = jax.checkpoint(along, prevent_cse=False, policy=keep)
        new, pullback = jax.vjp(along, *itertools.compress(args, moving))
        leaves, tree = jax.tree.flatten(pullback)
        trees.append(tree)
        return [*new, *leaves]

    closed = jax.make_jaxpr(linearised)(*program.inputs)
    n, jaxpr = len(program.outputs), closed.jaxpr
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
        return [*found[:n], _vector(left, program.outputs[0].dtype)]

    def backward(args: Sequence[Any], left: jax.Array, bars: Sequence[Any]) -> list[Any]:
        leaves, start = [], 0
        for kind, source in sources:
            if kind == "left":
                leaves.append(_part(left, start, source))
                start += source.size
            else:
                leaves.append(args[source] if kind == "argument" else source)
        return list(jax.tree.unflatten(trees[0], leaves)(list(bars)))

    return traced(forward, *program.inputs), backward
