"""A loop of independent turns, with derivatives in both modes.

Each turn reads rows of the operands and adds rows to the results:

    results[writes(at)] += term(at, *operands[reads(at)])

The number of turns may depend on values, so JAX cannot transpose the loop. Its transpose is a loop
over the same turns, which adds the cotangents of each turn to the rows that it reads. It saves no
values from one loop to the other.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import Moving, Program, traced

#: blocks of consecutive rows, each with its first row and its number of rows; None for the array
Rows = Sequence[tuple[Any, int]] | None


@dataclass(frozen=True, eq=False)
class Turns:
    """The turns of a loop. Its functions must not close over traced values.

    loop: function (visit, carry, counters), which returns carry after carry = visit(at, carry) for
        the place `at` of each turn. It is called for values and for cotangents.
    reads: function (at) -> the rows that the turn reads, for each operand.
    writes: function (at) -> the rows that the turn adds to, for each result.
    term: function (at, *rows) -> the rows that it adds.
    """

    loop: Callable[[Callable, Any, Sequence[Any]], Any]
    reads: Callable[[Any], Sequence[Rows]]
    writes: Callable[[Any], Sequence[Rows]]
    term: Callable[..., Sequence[Any]]

    def __call__(
        self, operands: Sequence[Any], counters: Sequence[Any], results: Sequence[tuple[int, ...]]
    ) -> list[jax.Array]:
        """Run the loop.

        operands: arrays of real numbers.
        counters: arrays of integers, which `loop` reads.
        results: the shape of each result.
        """
        operands = [jnp.asarray(x) for x in operands]
        counters = [jnp.asarray(x) for x in counters]
        dtype, n = operands[0].dtype, len(operands)

        def forward(*args: Any) -> list[jax.Array]:
            def visit(at: Any, sums: list) -> list:
                new = self.term(at, *_taken(args[:n], self.reads(at)))
                return _added(sums, new, self.writes(at))

            return self.loop(visit, [jnp.zeros(x, dtype) for x in results], args[n:])

        def vjp(moving: Moving, args: Sequence[Any], _: Any, bars: Sequence[Any]) -> list:
            bars = [
                jnp.zeros(x, dtype) if bar is None else bar
                for x, bar in zip(results, bars, strict=True)
            ]

            def some(xs: Sequence[Any]) -> list:
                return list(itertools.compress(xs, moving[:n]))

            def visit(at: Any, sums: list) -> list:
                reads = self.reads(at)
                rows = _taken(args[:n], reads)

                def term(*changed: Any) -> list:
                    rest = iter(changed)
                    both = zip(moving[:n], rows, strict=True)
                    return [*self.term(at, *(next(rest) if m else x for m, x in both))]

                _, back = jax.vjp(term, *some(rows))
                return _added(sums, back(_taken(bars, self.writes(at))), some(reads))

            return self.loop(visit, [jnp.zeros_like(x) for x in some(args[:n])], args[n:])

        avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in (*operands, *counters)]
        return run(Program(traced(forward, *avals).closed, vjp=vjp), [*operands, *counters])


def _taken(xs: Sequence[jax.Array], rows: Sequence[Rows]) -> list[jax.Array]:
    return [x if at is None else _take(x, at) for x, at in zip(xs, rows, strict=True)]


def _take(x: jax.Array, rows: Sequence[tuple[Any, int]]) -> jax.Array:
    parts = [jax.lax.dynamic_slice_in_dim(x, start, size) for start, size in rows]
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


def _added(xs: Sequence[jax.Array], new: Sequence[Any], rows: Sequence[Rows]) -> list[jax.Array]:
    return [x + y if at is None else _add(x, y, at) for x, y, at in zip(xs, new, rows, strict=True)]


def _add(x: jax.Array, new: jax.Array, rows: Sequence[tuple[Any, int]]) -> jax.Array:
    done = 0
    for start, size in rows:
        old = jax.lax.dynamic_slice_in_dim(x, start, size)
        x = jax.lax.dynamic_update_slice_in_dim(x, old + new[done : done + size], start, 0)
        done += size
    return x
