"""Hoisting of uniform work: values that are equal for all samples are computed once per batch.

An example is the constants of a robot's links, which depend only on a model that samples share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun

from rbjax.compiler.jax.derivatives import Atom, close, needed
from rbjax.compiler.jax.programs import Program

#: primitives that only move entries, at almost no cost for a thread
FREE = {
    "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "slice", "transpose", "rev",
    "concatenate", "copy", "iota", "convert_element_type", "split", "unstack", "stack",
}  # fmt: skip
#: primitives of work on the parameters of a model
LIGHT = FREE | {
    "add", "sub", "mul", "div", "neg", "integer_pow", "square", "sqrt", "rsqrt", "select_n", "eq",
    "ne", "lt", "le", "gt", "ge", "and", "or", "not", "max", "min", "sign", "abs", "reduce_sum",
    "pad", "gather", "scatter-add", "sincos", "sin", "cos", "fusion_barrier", "add_any",
}  # fmt: skip
#: the least equations and the most entries of uniform work that becomes a separate program
LONG_ENOUGH, SHORT = 30, 50_000
#: the most entries of uniform work that each thread repeats, because a launch takes a microsecond
FEW = 64


def hoist_uniform(
    program: Program, shared: Sequence[bool], operands: Sequence[jax.Array | None], run: Callable
) -> tuple[Program, list[jax.Array]]:
    """Split off the work that depends only on shared operands, and evaluate it.

    Returns the remaining program and its new shared operands, the results of the hoisted work. The
    inputs of the remaining program are the operands that are not shared, then the new ones. Short
    work becomes a program that `run` evaluates, because machine code compiles faster than XLA.
    shared: for each operand, whether all samples share it.
    """
    key = "uniform", tuple(shared)
    rest, plain, short = program.memoize(key, lambda: _divide(program, shared))
    given = [x for x, s in zip(operands, shared, strict=True) if s]
    return rest, plain(*given) if short is None else run(short, given)


def _divide(program: Program, shared: Sequence[bool]) -> tuple[Program, Callable, Program | None]:
    jaxpr = program.closed.jaxpr
    own = [v for v, s in zip(jaxpr.invars, shared, strict=True) if not s]
    given = [v for v, s in zip(jaxpr.invars, shared, strict=True) if s]
    uniform = {*given, *jaxpr.constvars}
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
    free = None if size is not None and size <= FEW else FREE  # None: threads do all of it
    # threads repeat the equations that only move entries, or all equations if there are few
    frontier: dict[Var, None] = {}
    moves: dict[int, JaxprEqn] = {}

    def need(var: Atom) -> None:
        if isinstance(var, Literal) or var in jaxpr.constvars or var not in uniform:
            return
        eqn = made.get(var)
        if eqn is not None and (free is None or eqn.primitive.name in free):
            if id(eqn) not in moves:
                moves[id(eqn)] = eqn
                for v in eqn.invars:
                    need(v)
            return
        frontier.setdefault(var)

    for eqn in after:
        for v in eqn.invars:
            need(v)
    for v in jaxpr.outvars:
        need(v)
    outside = list(frontier)
    moved = [eqn for eqn in before if id(eqn) in moves]
    first = _close(before, given, outside, program)
    rest = _close([*moved, *after], [*own, *outside], jaxpr.outvars, program)
    # one thread runs short equations in microseconds, but XLA compiles them slowly
    size, count = _size(first.jaxpr.eqns), len(first.jaxpr.eqns)
    is_short = size is not None and count >= LONG_ENOUGH and size <= SHORT
    short = Program(first, compile_fast=True) if is_short else None
    return Program(rest, team=program.team, saves=program.saves), jaxpr_as_fun(first), short


def split_results(program: Program, count: int) -> list[Program]:
    """Split a program into programs of `count` equally long parts of its results."""
    jaxpr = program.closed.jaxpr
    n = len(jaxpr.outvars) // count
    parts = (jaxpr.outvars[k * n : (k + 1) * n] for k in range(count))
    return [Program(_close(jaxpr.eqns, jaxpr.invars, outs, program)) for outs in parts]


def _close(
    eqns: list[JaxprEqn], ins: list[Var], outs: Sequence[Atom], program: Program
) -> ClosedJaxpr:
    """Return the equations of a program that compute `outs`, as a function of `ins`."""
    jaxpr = program.closed.jaxpr
    consts = dict(zip(jaxpr.constvars, program.closed.consts, strict=True))
    kept = needed(eqns, outs, ins, bool(jaxpr.effects))
    return close(kept, ins, outs, consts, frozenset(jaxpr.effects))


def _size(eqns: Sequence[JaxprEqn]) -> int | None:
    """Return the number of entries that equations compute; None if one is not in `LIGHT`."""
    total = 0
    for eqn in eqns:
        if eqn.primitive.name == "jit":
            size = _size(eqn.params["jaxpr"].jaxpr.eqns)
        elif eqn.primitive.name in LIGHT:
            size = sum(v.aval.size for v in eqn.outvars if isinstance(v.aval, ShapedArray))
        else:
            size = None
        if size is None:
            return None
        total += size
    return total
