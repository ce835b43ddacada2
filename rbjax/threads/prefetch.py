"""What a loop will read next is asked for one turn ahead.

A thread that reads a row of an operand in each turn (the controls of a step) waits for memory at
each entry, and with a few warps a scheduler there is nothing else to do. So as soon as the address
of a turn is known, the lines of the next turn's row are fetched into the cache.
"""

from __future__ import annotations

from collections.abc import Iterator, Set

from rbjax.threads.program import Array, Block, Load, Loop, Op, Var, walk

#: bytes of a sector, the least that memory delivers
SECTOR = 32
#: sectors of a row that are fetched ahead; of a longer one the first reads start the rest
SECTORS_UP_TO = 32


#: an address: the loop, how far it moves a turn, and for each array the first and last entries read
Ahead = dict[int, tuple[Loop, int, list[tuple[Array, int, int]]]]


def ahead(block: Block, operands: Set[int]) -> Ahead:
    """By the variable of an address what is read at it, of these operands."""
    out: Ahead = {}
    for statement in walk(block):
        if isinstance(statement, Loop) and statement.count > 1:
            steps = dict(_steps(statement))
            reads: dict[int, dict[int, list[Load]]] = {}
            for x in walk(statement.body):
                if not (isinstance(x, Load) and x.array.id in operands):
                    continue
                if isinstance(x.base, Var) and steps.get(x.base.id):
                    reads.setdefault(x.base.id, {}).setdefault(x.array.id, []).append(x)
            for base, arrays in reads.items():
                found = [
                    (xs[0].array, min(x.offset for x in xs), max(x.offset for x in xs))
                    for xs in arrays.values()
                ]
                out[base] = statement, steps[base], found
    return out


def _steps(loop: Loop) -> Iterator[tuple[int, int]]:
    """Variables that a loop's own statements make linear in its counter, and by how much a turn."""
    slope: dict[int, int] = {loop.counter.id: -1 if loop.reverse else 1}
    for x in loop.body.statements:
        if not isinstance(x, Op) or x.name not in ("cast", "index_mul", "index_add"):
            continue
        of = [slope.get(a.id, 0) if isinstance(a, Var) else 0 for a in x.args]
        if not any(of):
            continue
        if x.name == "cast":
            slope[x.dest.id] = of[0]
        elif x.name == "index_add":
            slope[x.dest.id] = sum(of)
        elif not isinstance(x.args[1], Var):
            slope[x.dest.id] = of[0] * int(x.args[1])
        elif not isinstance(x.args[0], Var):
            slope[x.dest.id] = of[1] * int(x.args[0])
    yield from slope.items()


def sectors(array: Array, first: int, last: int) -> list[int]:
    """Offsets that touch each sector of a run of entries, wherever it begins."""
    each = max(SECTOR // array.dtype.itemsize, 1)
    offsets = [*range(first, last, each), last]
    return offsets if len(offsets) <= SECTORS_UP_TO else []
