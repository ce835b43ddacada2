"""Moves work that depends on no sample out of a program: it is computed once, not by every thread.

An example is the constants of a robot's links, which depend only on a model that samples share.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from rbjax.threads.programs import Program

#: equations that only move entries, which cost a thread nothing
FREE = {
    "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "slice", "transpose", "rev",
    "concatenate", "copy", "iota", "convert_element_type", "split", "unstack", "stack",
}  # fmt: skip


def split(
    program: Program, shared: Sequence[bool], operands: Sequence[Any]
) -> tuple[Program, list[Any]]:
    """The rest of a program, as a function of the operands that samples do not share and of new
    shared operands; and these, computed here."""
    first, rest = program.parts(tuple(shared), _parts)
    given = [x for x, s in zip(operands, shared, strict=True) if s]
    return rest, jaxpr_as_fun(first)(*given)


def _parts(program: Program, shared: Sequence[bool]) -> Any:
    jaxpr, consts = program.closed.jaxpr, program.closed.consts
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
    # threads do the equations that only move entries: small operands, wide arrays
    needed: dict[Any, None] = {}
    moves: dict[int, Any] = {}

    def need(var: Any) -> None:
        if isinstance(var, Literal) or var in jaxpr.constvars or var not in uniform:
            return
        eqn = made.get(var)
        if eqn is not None and eqn.primitive.name in FREE:
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
    notes = unnamed(jaxpr)
    first = Jaxpr(jaxpr.constvars, alike, frontier, before, jaxpr.effects, notes)
    rest = Jaxpr(
        jaxpr.constvars, [*own, *frontier], jaxpr.outvars, [*moved, *after], jaxpr.effects, notes
    )
    return ClosedJaxpr(first, consts), Program(_pruned(ClosedJaxpr(rest, consts)))


def unnamed(jaxpr: Jaxpr) -> Any:
    """The debug info of a jaxpr without argument names, for a jaxpr derived from it."""
    return jaxpr.debug_info._replace(arg_names=None, result_paths=None)


def _pruned(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The jaxpr retraced, so that constants and debug info match."""
    avals = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in closed.jaxpr.invars]
    return jax.make_jaxpr(jaxpr_as_fun(closed))(*avals)
