"""Dead code elimination."""

from __future__ import annotations

from typing import Any

from rbjax.compiler.ir.program import (
    Array,
    Assign,
    Await,
    Block,
    Declare,
    If,
    Load,
    Loop,
    Op,
    Reserve,
    Store,
    Var,
    While,
    walk,
)


def prune(block: Block) -> None:
    """Removes the statements that no result and no condition depends on."""
    needed = _needed(block)
    _keep(block, needed)


def _needed(block: Block) -> set[Var | Array]:
    """The variables and arrays that results and conditions depend on."""
    made_of: dict[Any, list] = {}
    reached: list = []
    for statement in walk(block):
        match statement:
            case Op(dest=dest, args=args):
                made_of.setdefault(dest, []).extend(args)
            case Load(dest=dest, array=array, base=base):
                made_of.setdefault(dest, []).extend((array, base))
            case Declare(var=var, value=value) | Assign(var=var, value=value):
                made_of.setdefault(var, []).append(value)
            case Store(array=array, base=base, value=value):
                where = reached if array.space == "result" else made_of.setdefault(array, [])
                where.extend((array, base, value))
            case If(condition=condition) | While(condition=condition):
                reached.append(condition)
    needed: set = set()
    while reached:
        x = reached.pop()
        if isinstance(x, Var | Array) and x not in needed:
            needed.add(x)
            reached.extend(made_of.get(x, ()))
    return needed


def _keep(block: Block, needed: set[Var | Array]) -> None:
    kept = []
    for statement in block.statements:
        match statement:
            case Op(dest=x) | Load(dest=x) | Declare(var=x) | Assign(var=x):
                keep = x in needed
            case Store(array=x) | Reserve(array=x):
                keep = x in needed
            case Loop(body=body):
                _keep(body, needed)
                keep = bool(body.statements)
            case While(test=test, body=body):
                _keep(test, needed)
                _keep(body, needed)
                keep = True
            case If(then=then, otherwise=otherwise):
                _keep(then, needed)
                _keep(otherwise, needed)
                keep = bool(then.statements or otherwise.statements)
            case Await():
                keep = True
            case _:
                raise TypeError(f"no such statement: {statement}")
        if keep:
            kept.append(statement)
    block.statements = kept
