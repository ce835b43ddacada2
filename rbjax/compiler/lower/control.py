"""Lowering rules for loops, branches, nested calls, and control primitives of Equinox and lineax.

A program runs one sample, so it has no batch. Equinox's reductions over the batch return
their argument.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from rbjax._jax_compat import is_error
from rbjax.compiler.ir import statements as ir
from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.statements import Unsupported
from rbjax.compiler.lower import arrays
from rbjax.compiler.lower.arrays import ThreadArray, View
from rbjax.compiler.lower.delayed import Delayed
from rbjax.compiler.lower.gather import COMBINE
from rbjax.compiler.lower.indexing import SELECT_UP_TO
from rbjax.compiler.lower.lowering import (
    Atom,
    Aval,
    Equation,
    Lowering,
    dtype_of,
    inner_jaxpr,
    placing_rule,
    rule,
)

#: the most entries of a loop's carried array that are kept in registers
REGISTERS = 256
#: the most entries of a row that a team prefetches to shared memory
ROW_UP_TO = 512
INDEXED = {"dynamic_slice", "dynamic_update_slice", "gather", *COMBINE}


def indexed(closed: ClosedJaxpr, unknown: Sequence[bool]) -> set[int]:
    """Return the positions of the inputs that a jaxpr indexes by values that are not constant."""
    jaxpr = closed.jaxpr
    varying = {v for v, u in zip(jaxpr.invars, unknown, strict=True) if u}
    origin = {v: {k} for k, v in enumerate(jaxpr.invars)}  # inputs that a variable updates
    found: set[int] = set()

    def is_varying(atom: Any) -> bool:
        return not isinstance(atom, Literal) and atom in varying

    def of(atom: Any) -> set[int]:
        return set() if isinstance(atom, Literal) else origin.get(atom, set())

    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if any(map(is_varying, eqn.invars)):
            varying.update(eqn.outvars)
        if name in INDEXED:
            index = eqn.invars[1:] if name == "dynamic_slice" else eqn.invars[1:2]
            if name == "dynamic_update_slice":
                index = eqn.invars[2:]
            if any(map(is_varying, index)):
                found |= of(eqn.invars[0])
            if name.startswith(("dynamic_update", "scatter")):
                origin[eqn.outvars[0]] = of(eqn.invars[0])
            continue
        for inner, atoms in inner_jaxprs(eqn):
            flags = [name in ("scan", "while") or is_varying(a) for a in atoms]
            for k in indexed(inner, flags):
                found |= of(atoms[k])
    return found


def inner_jaxprs(eqn: Equation) -> list[tuple[ClosedJaxpr, list]]:
    """Return the jaxprs that an equation runs, each with the operands that are its inputs."""
    P, atoms = eqn.params, list(eqn.invars)
    match eqn.primitive.name:
        case "cond":
            return [(branch, atoms[1:]) for branch in P["branches"]]
        case "while":
            nc, nb = P["cond_nconsts"], P["body_nconsts"]
            return [
                (P["cond_jaxpr"], atoms[:nc] + atoms[nc + nb :]),
                (P["body_jaxpr"], atoms[nc:]),
            ]
        case "scan":
            return [(P["jaxpr"], atoms)]
    inner = inner_jaxpr(eqn)
    return [] if inner is None or len(inner.jaxpr.invars) != len(atoms) else [(inner, atoms)]


class Carry:
    """The carried values of a loop, in registers (arrays of variables) or in local arrays."""

    def __init__(
        self, low: Lowering, init: Sequence[ThreadArray], avals: Sequence[Aval], memory: set[int]
    ):
        self.low = low
        self.values: list[Any] = []
        for k, (x, aval) in enumerate(zip(init, avals, strict=True)):
            if k in memory or aval.size > (_most(x) if low.b.in_team else REGISTERS):
                self.values.append(self._array(x, aval))
            else:
                entries, out = low.to_scalars(x), np.empty(aval.shape, object)
                for i in arrays.indices_of(aval.shape):
                    out[i] = low.b.declare(dtype_of(aval), entries[i])
                self.values.append(out)

    def _array(self, x: ThreadArray, aval: Aval) -> View:
        taken = {y.array for y in self.values if isinstance(y, View)}
        if isinstance(x, View) and x.is_updatable and x.array not in taken:
            return x
        return arrays.copy_to_memory(self.low.b, x, dtype_of(aval))

    def advance(self, new: Sequence[ThreadArray]) -> None:
        """Emit the assignment of new values to the carry, after all reads of old values."""
        b = self.low.b
        old = {v.id for x in self.values if not isinstance(x, View) for v in x.flat}
        operands = {x.array for x in self.values if isinstance(x, View)}
        moves: list[tuple[ir.Var, ir.Value]] = []
        copies: list[tuple[View, ThreadArray]] = []
        for to, x in zip(self.values, new, strict=True):
            if isinstance(to, View):
                if isinstance(x, View) and x.is_same_view(to):
                    continue
                if isinstance(x, View) and x.array in operands:
                    x = arrays.copy_to_memory(b, x, to.dtype)
                elif isinstance(x, Delayed) and not operands.isdisjoint(x.sources):
                    x = arrays.materialize_in_memory(b, x)
                copies.append((to, x))
                continue
            for var, value in zip(to.flat, self.low.to_scalars(x).flat, strict=True):
                if value is var:
                    continue
                if isinstance(value, ir.Var) and value.id in old:
                    value = b.declare(value.dtype, value)
                moves.append((var, value))
        for to, x in copies:
            arrays.write_to(b, to, x)
        for var, value in moves:
            b.assign(var, value)


def _most(x: ThreadArray) -> int:
    """Return the largest number of entries of a carried array that a team keeps in registers."""
    return (
        4 * arrays.FEW
        if isinstance(x, np.ndarray) and not arrays.is_constant(x)
        else arrays.FEW // 2
    )


@placing_rule("scan")
def _scan(low: Lowering, eqn: Equation, ins: list, places: list) -> list:
    P, b = eqn.params, low.b
    length, body = P["length"], P["jaxpr"]
    nk = len(eqn.outvars) - over_time(eqn.outvars, body.jaxpr.outvars)
    nc = len(eqn.invars) - nk - over_time(eqn.invars, body.jaxpr.invars)
    consts, init, xs = ins[:nc], ins[nc : nc + nk], ins[nc + nk :]
    avals = [v.aval for v in body.jaxpr.invars]
    ys: list[ThreadArray] = []
    rows_in = dict(zip(body.jaxpr.invars[nc + nk :], xs, strict=True))
    # for each stacked output, the input whose rows it returns unchanged
    same = [None if isinstance(v, Literal) else rows_in.get(v) for v in body.jaxpr.outvars[nk:]]
    for var, given, place in zip(eqn.outvars[nk:], same, places[nk:], strict=True):
        aval = var.aval
        if given is not None:
            ys.append(given)
        else:
            ys.append(place or View.of(b.local(dtype_of(aval), max(aval.size, 1)), aval.shape))
    if not length:
        return [*init, *ys]
    if length == 1:
        first = [x.at(b, 0, ir.I32.type(0)) if isinstance(x, View) else x[0, ...] for x in xs]
        spots = [
            y.at(b, 0, ir.I32.type(0)) if isinstance(y, View) and given is None else None
            for y, given in zip(ys, same, strict=True)
        ]
        out = low.closed(body, [*consts, *init, *first], [*[None] * nk, *spots])
        return [*out[:nk], *ys]
    unknown = [not arrays.is_constant(x) for x in consts] + [True] * (len(avals) - nc)
    wanted = indexed(body, unknown)
    consts = [
        arrays.to_memory(b, x, dtype_of(a), keep=True) if k in wanted else x
        for k, (x, a) in enumerate(zip(consts, avals[:nc], strict=True))
    ]
    xs = [arrays.to_memory(b, x, dtype_of(a)) for x, a in zip(xs, avals[nc + nk :], strict=True)]
    with low.pinned([*consts, *xs, *ys]):  # no initial carry may share memory with these
        memory = {k - nc for k in wanted if nc <= k < nc + nk}
        carry = Carry(low, init, avals[nc : nc + nk], memory)
    begin, rows_at = _fetched(b, xs, length, P["reverse"])
    begin()
    with (
        low.pinned([*consts, *xs, *ys]),
        b.loop(length, reverse=P["reverse"]) as counter,
    ):
        rows = rows_at(counter)
        spots = [
            y.at(b, 0, counter) if isinstance(y, View) and given is None else None
            for y, given in zip(ys, same, strict=True)
        ]
        out = low.closed(body, [*consts, *carry.values, *rows], [*[None] * nk, *spots])
        carry.advance(out[:nk])
    return [*carry.values, *ys]


def _fetched(b: Builder, xs: list, length: int, reverse: bool) -> tuple[Callable, Callable]:
    """Return two functions that emit a loop's row accesses.

    The first is called before the loop. The second maps the loop counter to the rows of `xs`. If a
    team runs the program, rows of operands are prefetched to shared memory, one iteration ahead.
    """
    own = [
        b.in_team and x.array.space == "operand" and x.dtype.itemsize >= 4
        and x.size > length and x.size // length <= ROW_UP_TO
        for x in xs
    ]  # fmt: skip
    if not any(own):
        return lambda: None, lambda counter: [x.at(b, 0, counter) for x in xs]
    both = [
        View.of(b.local(x.dtype, 2 * (x.size // length)), (2, *x.shape[1:])) if o else x
        for x, o in zip(xs, own, strict=True)
    ]
    one = ir.I32.type(1)

    def fetch(row: ir.Value) -> None:
        half = b.op("and", ir.I32, row, one)
        for x, to, o in zip(xs, both, own, strict=True):
            if o:
                _copied_early(b, to.at(b, 0, half), x.at(b, 0, row))

    def rows(counter: ir.Value) -> list[View]:
        b.block.statements.append(ir.Await())
        last, step = (0, -1) if reverse else (length - 1, 1)
        with b.when(b.op("ne", ir.BOOL, counter, ir.I32.type(last))):
            fetch(b.op("index_add", ir.I32, counter, ir.I32.type(step)))
        half = b.op("and", ir.I32, counter, one)
        return [to.at(b, 0, half if o else counter) for to, o in zip(both, own, strict=True)]

    return lambda: fetch(ir.I32.type(length - 1 if reverse else 0)), rows


def _copied_early(b: Builder, to: View, x: View) -> None:
    to, x = arrays.as_flat_views(to, x)
    with b.team_loop(max(x.size, 1), prefetch=True) as counter:
        index = arrays.unravel_index(b, counter, x.shape)
        arrays.store_entry(b, to, index, arrays.load_entry(b, x, index))


def over_time(outside: Sequence[Atom], inside: Sequence[Atom]) -> int:
    """Count the arguments or results of a scan that have a time axis (not stored in jax 0.11)."""
    return sum(a.aval.ndim > b.aval.ndim for a, b in zip(outside, inside, strict=True))


@rule("while")
def _while(low: Lowering, eqn: Equation, ins: list) -> list:
    P, b = eqn.params, low.b
    nc, nb = P["cond_nconsts"], P["body_nconsts"]
    test_consts, body_consts, init = ins[:nc], ins[nc : nc + nb], ins[nc + nb :]
    test, body = P["cond_jaxpr"], P["body_jaxpr"]
    memory = set[int]()
    for closed, consts in ((test, test_consts), (body, body_consts)):
        unknown = [not arrays.is_constant(x) for x in consts] + [True] * len(init)
        for k in indexed(closed, unknown):
            if k >= len(consts):
                memory.add(k - len(consts))
            elif not isinstance(consts[k], Delayed) and consts[k].size > SELECT_UP_TO:
                dtype = dtype_of(closed.in_avals[k])  # stored here, not in each iteration
                consts[k] = arrays.to_memory(b, consts[k], dtype, keep=True)
    with low.pinned([*test_consts, *body_consts]):
        carry = Carry(low, init, [v.aval for v in eqn.outvars], memory)
    loop = ir.While(ir.Block(), np.bool_(False), ir.Block())
    b.block.statements.append(loop)
    with low.pinned([*test_consts, *body_consts]):
        with b.inside(loop.test), low.pinned(carry.values):
            (goes,) = low.closed(test, [*test_consts, *carry.values])
            loop.condition = low.to_scalar(goes)
        with b.inside(loop.body):
            carry.advance(low.closed(body, [*body_consts, *carry.values]))
    return carry.values


@placing_rule("cond")
def _cond(low: Lowering, eqn: Equation, ins: list, places: list) -> list:
    branches, args = eqn.params["branches"], ins[1:]
    which = low.to_scalar(ins[0])
    # branches that do not end the run by an error of `equinox.error_if`
    going_on = [x for x in branches if not any(map(is_error, x.jaxpr.eqns))]
    if len(going_on) == 1:
        return low.closed(going_on[0], args, places)
    if not isinstance(which, ir.Var):
        chosen = branches[min(max(int(which), 0), len(branches) - 1)]
        return low.closed(chosen, args, places)
    b, outs = low.b, []
    updated = _updated_arguments(branches, args, places)
    for k, (var, place) in enumerate(zip(eqn.outvars, places, strict=True)):
        aval = var.aval
        if place is not None:
            outs.append(place)
        elif k in updated:
            outs.append(args[updated[k]])
        elif aval.size > REGISTERS:
            outs.append(View.of(b.local(dtype_of(aval), aval.size), aval.shape))
        else:
            entries = np.empty(aval.shape, object)
            for i in arrays.indices_of(aval.shape):
                entries[i] = b.declare(dtype_of(aval))
            outs.append(entries)

    def run(branch: ClosedJaxpr) -> None:
        spots = [
            x if isinstance(x, View) and k not in updated else None for k, x in enumerate(outs)
        ]
        found = [arrays.materialize(b, x) for x in low.closed(branch, args, spots)]
        for to, x in zip(outs, found, strict=True):
            if not isinstance(to, View):
                for var, value in zip(to.flat, low.to_scalars(x).flat, strict=True):
                    b.assign(var, value)
        for k in updated:  # after the other results have read the old array
            arrays.write_to(b, outs[k], found[k])

    def choose(first: int) -> None:
        if first == len(branches) - 1:
            run(branches[first])
            return
        here = (
            which if which.dtype == ir.BOOL else b.op("le", ir.BOOL, which, which.dtype.type(first))
        )
        node = ir.If(here, ir.Block(), ir.Block())
        b.block.statements.append(node)
        blocks = (node.then, node.otherwise)
        if which.dtype == ir.BOOL:  # branch 1 runs if the condition is true
            blocks = (node.otherwise, node.then)
        with b.inside(blocks[0]):
            run(branches[first])
        with b.inside(blocks[1]):
            choose(first + 1)

    with low.pinned([x for j, x in enumerate(args) if j not in updated.values()]):
        choose(0)
    return outs


def _updated_arguments(branches: Sequence[ClosedJaxpr], args: list, places: list) -> dict[int, int]:
    """Map results to the arguments that may be updated in place.
    Every branch returns such an argument unchanged or updated, and nothing reads it later."""
    out: dict[int, int] = {}
    for k, origins in enumerate(zip(*map(_versions, branches), strict=True)):
        j = origins[0]
        if j is None or set(origins) != {j} or j in out.values() or places[k] is not None:
            continue
        x = args[j]
        if isinstance(x, View) and x.is_updatable:
            others = [y for i, y in enumerate(args) if i != j and isinstance(y, View)]
            if all(y.array is not x.array for y in others):
                out[k] = j
    return out


def _versions(closed: ClosedJaxpr) -> list[int | None]:
    """Return, for each result, the position of the input that it equals or updates, or None."""
    jaxpr = closed.jaxpr
    origin: dict[Any, int | None] = {v: k for k, v in enumerate(jaxpr.invars)}

    def of(atom: Any) -> int | None:
        return None if isinstance(atom, Literal) else origin.get(atom)

    for eqn in jaxpr.eqns:
        inner = inner_jaxpr(eqn)
        if eqn.primitive.name.startswith(("dynamic_update", "scatter")):
            origin[eqn.outvars[0]] = of(eqn.invars[0])
        elif inner is not None:
            for var, k in zip(eqn.outvars, _versions(inner), strict=True):
                origin[var] = None if k is None else of(eqn.invars[k])
    return [of(v) for v in jaxpr.outvars]


@rule("platform_index")
def _platform(low: Lowering, eqn: Equation, ins: list) -> list:
    groups = eqn.params["platforms"]
    here = [k for k, group in enumerate(groups) if group is None or low.b.platform in group]
    return [np.asarray(here[0] if here else len(groups) - 1, np.int32)]


@rule("select_if_vmap", unread=(0, 2))
def _select_if_vmap(low: Lowering, eqn: Equation, ins: list) -> list:
    return [ins[1]]  # without a batch, the predicate of a running loop is true


@rule("maybe_set", "linear_solve")
def _implemented(low: Lowering, eqn: Equation, ins: list) -> list:
    f = functools.partial(eqn.primitive.impl, **eqn.params)  # a function that JAX can trace
    return low.evaluate(f, *ins, avals=[v.aval for v in eqn.invars])


@rule("pure_callback", "io_callback", "debug_callback", "debug_print")
def _callback(low: Lowering, eqn: Equation, ins: list) -> list:
    raise Unsupported(f"{eqn.primitive.name}, a call back into Python")
