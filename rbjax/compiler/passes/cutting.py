"""Splits long straight-line code into functions, because LLVM's compile time is superlinear.

Values that one function computes and another reads lie in a frame, to which all functions have a
pointer. The bodies of long loops are not split, because they would run slower and compile as long.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from rbjax.compiler.ir import statements as ir

#: the most statements of a block that is not split; the statements of a function
CUT_ABOVE, EACH = 20_000, 1_500


@dataclass
class Cuts:
    """The functions into which a program is split: 0, which calls the others, and 1, 2, ...

    runs: for each block that is split, by its id, a list of (function, statements).
    home: the function that computes each variable.
    shared: variables that other functions also read.
    arrays: the local arrays.
    """

    runs: dict[int, list[tuple[int, list[ir.Statement]]]] = field(default_factory=dict)
    home: dict[ir.Var, int] = field(default_factory=dict)
    shared: dict[ir.Var, None] = field(default_factory=dict)
    arrays: dict[ir.Array, None] = field(default_factory=dict)


def split_block(block: ir.Block, branches: bool) -> Cuts | None:
    """Split a block into functions. Return None if it is short.
    branches: whether to split the blocks of branches and of `while` loops too."""
    cuts, used, count = Cuts(), dict[ir.Var, set[int]](), 0

    def note(statement: ir.Statement, here: int) -> None:
        read = statement.reads()
        if isinstance(statement, ir.Assign):  # the variable was declared before
            read = (statement.var, *read)
        else:
            cuts.home.update((x, here) for x in statement.writes() if isinstance(x, ir.Var))
        for x in read:
            if isinstance(x, ir.Var):
                used.setdefault(x, set()).add(here)
        if isinstance(statement, ir.Reserve):
            cuts.arrays[statement.array] = None

    def every(statements: list[ir.Statement], here: int) -> None:
        for statement in ir.walk(ir.Block(statements)):
            note(statement, here)

    def visit(block: ir.Block) -> None:
        nonlocal count
        sizes = [_size(s) for s in block.statements]
        if sum(n for n in sizes if n <= EACH) <= CUT_ABOVE:
            pieces = [(0, block.statements)]
        else:
            pieces = list(_pieces(block.statements, sizes))
        numbered = []
        for long, statements in pieces:
            if long:
                count += 1
                every(statements, count)
                numbered.append((count, statements))
                continue
            numbered.append((0, statements))
            for statement in statements:
                note(statement, 0)
                for inner in statement.children():
                    if branches or isinstance(statement, ir.Loop):
                        visit(inner)
                    else:
                        every(inner.statements, 0)
        if len(numbered) > 1:
            cuts.runs[id(block)] = numbered

    visit(block)
    if not count:
        return None
    cuts.shared = {v: None for v, where in used.items() if where - {cuts.home[v]}}
    return cuts


def _pieces(
    statements: list[ir.Statement], sizes: list[int]
) -> Iterator[tuple[bool, list[ir.Statement]]]:
    """Split statements into pieces of about `EACH` operations. Yield (flag, statements) of each
    piece. The flag is False for a single longer statement, and for a short last piece."""
    piece: list[ir.Statement] = []
    length = 0
    for statement, n in zip(statements, sizes, strict=True):
        if n > EACH:
            if piece:
                yield True, piece
            yield False, [statement]
            piece, length = [], 0
            continue
        piece.append(statement)
        length += n
        if length >= EACH:
            yield True, piece
            piece, length = [], 0
    if piece:
        yield length > EACH // 4, piece


def _size(statement: ir.Statement) -> int:
    return sum(1 for _ in ir.walk(ir.Block([statement])))


class FrameLayout:
    """The byte offsets of shared variables and of arrays in a frame. size_of: bytes of each."""

    def __init__(self, cuts: Cuts, size_of: Callable[[ir.Name], int], alignment: int):
        self.cuts, self.bytes = cuts, 0
        self.places: dict[ir.Name, int] = {}
        every: tuple[ir.Name, ...] = (*cuts.arrays, *cuts.shared)
        for x in every:
            size = size_of(x)
            step = alignment if isinstance(x, ir.Array) else min(alignment, size)
            self.places[x] = -(-self.bytes // step) * step
            self.bytes = self.places[x] + size
