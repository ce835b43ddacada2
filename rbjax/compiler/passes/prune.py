"""Dead code elimination."""

from __future__ import annotations

from rbjax.compiler.ir.statements import (
    Await,
    Barrier,
    Block,
    If,
    Load,
    Loop,
    Name,
    Op,
    Reserve,
    Statement,
    Store,
    While,
    walk,
)


def prune(block: Block) -> None:
    """Remove the statements that no result and no condition depends on."""
    _keep(block, _needed(block))


def _needed(block: Block) -> set[Name]:
    """The variables and arrays that results and conditions depend on."""
    sources: dict[Name, list[Name]] = {}
    reached: list[Name] = []
    for statement in walk(block):
        if isinstance(statement, If | While):
            reached.extend(statement.reads())
        elif isinstance(statement, Store) and statement.array.space == "result":
            reached.extend((statement.array, *statement.reads()))
        else:
            for x in statement.writes():
                sources.setdefault(x, []).extend(statement.reads())
    needed: set[Name] = set()
    while reached:
        x = reached.pop()
        if x not in needed:
            needed.add(x)
            reached.extend(sources.get(x, ()))
    return needed


def _keep(block: Block, needed: set[Name]) -> None:
    """Remove the other statements of a block and its inner blocks."""
    kept = []
    for statement in block.statements:
        for inner in () if statement.is_leaf else statement.children():
            _keep(inner, needed)
        if not needed.isdisjoint(statement.writes()) or _is_needed(statement, needed):
            kept.append(statement)
    block.statements = kept


def _is_needed(statement: Statement, needed: set[Name]) -> bool:
    """Whether a statement that changes nothing needed is needed nevertheless."""
    match statement:
        case Op() | Load() | Store():
            return False
        case Loop() | If():
            return any(inner.statements for inner in statement.children())
        case Reserve(array=array):
            return array in needed
    return isinstance(statement, While | Await | Barrier)
