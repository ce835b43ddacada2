"""Chooses the loops that the warps of a block run in step.

A program that is longer than the instruction cache is bound by the fetch of its instructions from
the second cache. Warps that are at the same instructions share a fetch. So they wait for one
another at each turn of a rollout, and at each iteration of a solver in it. The price is that a
block waits for the slowest of its samples: a loop that is not in a counted loop, as one over the
steps of an adaptive solver, is left as it is.

`python -m benchmarks.gpu.contact` measures rollouts with contacts.
"""

from __future__ import annotations

from collections.abc import Iterator

from rbjax.compiler.ir import statements as ir
from rbjax.compiler.ir.program import Written

#: the number of operations above which a program runs in step; the same for a program with a
#: `while` loop, in which warps drift further apart
LONG_PROGRAM, LONG_ITERATION = 8_000, 4_000
#: the same for its counted loops, and for its `while` loops in them. In the reverse pass of a Go1 a
#: loop over contacts has 346: with it in step 84 million steps a second, without 56 (H200)
LONG_LOOP, LONG_WHILE = 800, 300
#: the most warps of a block: with 255 registers a thread, all that a multiprocessor holds
MOST_WARPS = 8
#: the multiprocessors of a large GPU; a small batch is spread over all of them
MULTIPROCESSORS = 132


def loops_in_step(program: Written) -> set[int]:
    """Return the loops whose turns the warps of a block begin together, by `id`."""
    found = [*_long_loops(program.builder.block, counted=False)]
    iterates = any(isinstance(s, ir.While) for s in found)
    long = program.statements > (LONG_ITERATION if iterates else LONG_PROGRAM)
    return {id(s) for s in found} if long else set()


def warps_of_block(warps: int, most: int = MOST_WARPS) -> int:
    """Return the number of warps of a block, at most `most`, for a batch of this number of
    warps."""
    return min(-(-warps // MULTIPROCESSORS), most)


def _long_loops(block: ir.Block, *, counted: bool) -> Iterator[ir.Statement]:
    """Yield long loops that all threads of a block enter: in no branch and in no `while` loop."""
    for s in block.statements:
        if isinstance(s, ir.While):
            if counted and _length(s) > LONG_WHILE:
                yield s
        elif isinstance(s, ir.Loop):
            if _length(s) > LONG_LOOP:
                yield s
            yield from _long_loops(s.body, counted=True)


def _length(s: ir.Statement) -> int:
    """Return the number of operations in a statement's blocks."""
    return sum(isinstance(x, ir.Op) for block in s.children() for x in ir.walk(block))
