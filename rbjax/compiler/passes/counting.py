"""How often the statements of a program run."""

from __future__ import annotations

from collections import Counter

from rbjax.compiler.ir.statements import Block, If, Load, Loop, Op, Store, While


def operations(block: Block, turns: int = 1) -> int:
    """The operations that run: the longer branch, a loop's once a turn, a `while` `turns` times."""
    total = 0
    for statement in block.statements:
        match statement:
            case Op():
                total += 1
            case Loop(count=count, body=body):
                total += count * operations(body, turns)
            case While(test=test, body=body):
                total += turns * (operations(test, turns) + operations(body, turns))
            case If(then=then, otherwise=otherwise):
                total += max(operations(then, turns), operations(otherwise, turns))
    return total


def accesses(block: Block) -> Counter[int]:
    """How often each array is read or written; in a `while` each statement counts once."""
    total: Counter[int] = Counter()
    for statement in block.statements:
        match statement:
            case Load(array=array) | Store(array=array):
                total[array.id] += 1
            case Loop(count=count, body=body):
                total.update({k: count * n for k, n in accesses(body).items()})
            case While(test=test, body=body):
                total += accesses(test) + accesses(body)
            case If(then=then, otherwise=otherwise):
                total += accesses(then) + accesses(otherwise)
    return total
