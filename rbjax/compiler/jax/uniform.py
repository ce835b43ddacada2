"""Moves work that depends on no sample out of a program: it is computed once, not by every thread.

An example is the constants of a robot's links, which depend only on a model that samples share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from rbjax._jax_compat import without_names
from rbjax.compiler.jax.equations import needed
from rbjax.compiler.jax.programs import Program

#: equations that only move entries, which cost a thread nothing
FREE = {
    "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "slice", "transpose", "rev",
    "concatenate", "copy", "iota", "convert_element_type", "split", "unstack", "stack",
}  # fmt: skip
#: equations of work on the numbers of a model
LIGHT = FREE | {
    "add", "sub", "mul", "div", "neg", "integer_pow", "square", "sqrt", "rsqrt", "select_n", "eq",
    "ne", "lt", "le", "gt", "ge", "and", "or", "not", "max", "min", "sign", "abs", "reduce_sum",
    "pad", "gather", "scatter-add", "sincos", "sin", "cos", "fusion_barrier", "add_any",
}  # fmt: skip
#: equations from which on, and entries up to which, shared work is a program of its own
LONG_ENOUGH, SHORT = 30, 50_000
#: entries up to which threads do shared work, too: a kernel of its own takes a microsecond
FEW = 64


def divided(
    program: Program, shared: Sequence[bool], operands: Sequence[jax.Array | None], run: Callable
) -> tuple[Program, list[Any]]:
    """The rest of a program, as a function of the operands that samples do not share and of new
    shared operands; and these, computed here. Work that is short is a program of its own, which
    `run` evaluates: machine code compiles sooner than XLA."""
    rest, plain, short = program.parts(tuple(shared), _parts)
    given = [x for x, s in zip(operands, shared, strict=True) if s]
    return rest, plain(*given) if short is None else run(short, given)


def _parts(program: Program, shared: Sequence[bool]) -> tuple[Program, Callable, Program | None]:
    jaxpr = program.closed.jaxpr
    own = [v for v, s in zip(jaxpr.invars, shared, strict=True) if not s]
    alike = [v for v, s in zip(jaxpr.invars, shared, strict=True) if s]
    uniform = {*alike, *jaxpr.constvars}
    before, after = [], []
    for eqn in jaxpr.eqns:
        ins = [v for v in eqn.invars if not isinstance(v, Literal)]
        once = ins and all(v in uniform for v in ins) and not eqn.effects
        if once and any(v not in jaxpr.constvars for v in ins):
            uniform.update(eqn.outvars)
            before.append(eqn)
        else:
            after.append(eqn)
    made = {v: eqn for eqn in before for v in eqn.outvars}
    size = _size(before)
    free = None if size is not None and size <= FEW else FREE  # None: all of it
    # threads do the equations that only move entries (small operands, wide arrays), and few others
    needed: dict[Any, None] = {}
    moves: dict[int, Any] = {}

    def need(var: Any) -> None:
        if isinstance(var, Literal) or var in jaxpr.constvars or var not in uniform:
            return
        eqn = made.get(var)
        if eqn is not None and (free is None or eqn.primitive.name in free):
            if id(eqn) not in moves:
                moves[id(eqn)] = eqn
                for v in eqn.invars:
                    need(v)
            return
        needed.setdefault(var)

    for eqn in after:
        for v in eqn.invars:
            need(v)
    for v in jaxpr.outvars:
        need(v)
    frontier = list(needed)
    moved = [eqn for eqn in before if id(eqn) in moves]
    first = _closed(before, alike, frontier, program)
    closed = _closed([*moved, *after], [*own, *frontier], jaxpr.outvars, program)
    rest = Program(closed, team=program.team)
    plain = jaxpr_as_fun(first)
    return rest, plain, Program(first, once=True) if _is_short(first.jaxpr) else None


def halves(program: Program) -> tuple[Program, Program]:
    """The programs of the first and the second half of the results."""
    jaxpr = program.closed.jaxpr
    ins, outs = list(jaxpr.invars), jaxpr.outvars
    half = len(outs) // 2
    first, second = (
        _closed(jaxpr.eqns, ins, some, program) for some in (outs[:half], outs[half:])
    )
    return Program(first), Program(second)


def _closed(eqns: list, ins: list, outs: Sequence[Any], program: Program) -> ClosedJaxpr:
    """Some equations of a program, as a function."""
    jaxpr, consts = program.closed.jaxpr, program.closed.consts
    eqns = needed(eqns, outs, ins, jaxpr.effects)
    read = {v for eqn in eqns for v in eqn.invars if not isinstance(v, Literal)}
    read.update(v for v in outs if not isinstance(v, Literal))
    held = [(v, c) for v, c in zip(jaxpr.constvars, consts, strict=True) if v in read]
    notes = without_names(jaxpr)
    some = Jaxpr([v for v, _ in held], ins, list(outs), eqns, jaxpr.effects, notes)
    return ClosedJaxpr(some, [c for _, c in held])


def _is_short(jaxpr: Jaxpr) -> bool:
    """Whether a thread computes it in some microseconds, and XLA would compile it for longer."""
    size = _size(jaxpr.eqns)
    return size is not None and len(jaxpr.eqns) >= LONG_ENOUGH and size <= SHORT


def _size(eqns: Sequence[Any]) -> int | None:
    """The entries that equations compute; None with a loop, a product of matrices or the like."""
    size = 0
    for eqn in eqns:
        outs: list[Any] = eqn.outvars
        if eqn.primitive.name == "jit":
            inner = _size(eqn.params["jaxpr"].jaxpr.eqns)
        else:
            inner = sum(v.aval.size for v in outs) if eqn.primitive.name in LIGHT else None
        if inner is None:
            return None
        size += inner
    return size
