"""Stores batch-first results through shared memory, in whole memory sectors.

Short rows are staged as a whole, because the 32 rows of a warp are consecutive in memory. Their
entries may be written in any order. A longer row that is written once and in order is stored in
chunks through a tile of shared memory. Chunks start at a sector in every row: the tile keeps the
last entries of the previous chunk, and a row's chunk is shifted by its misalignment. In other long
rows, runs of consecutive stores go through the tile, from any start.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rbjax.compiler.cuda.c_source import Printer
from rbjax.compiler.ir import statements as ir
from rbjax.compiler.ir.c_text import c_type
from rbjax.compiler.ir.program import Written

#: rows of more than `SHORT` entries (about a sector) and at most `WHOLE` are staged whole
SHORT, WHOLE = 8, 128
#: 4-byte entries in a chunk of a longer row
TILE = 256
#: entries of a run that is stored through the tile
RUN = 32
#: bytes of a memory sector; chunks start at its multiples
ALIGN = 32

HEAD = """
// stores a warp's whole rows, of N entries, to memory without gaps
template <class T, int N, int PITCH> QUALIFIED void store_rows(T* to, const T* from, int rows) {
  const int lane = LANE;
  __syncwarp();
  if (PITCH == N && rows == 32) {
    constexpr int wide = 32 * N * sizeof(T) / 16;
#pragma unroll
    for (int k = 0; k < wide; k += 32)
      if (k + lane < wide) ((uint4*)to)[k + lane] = ((const uint4*)from)[k + lane];
  } else {
#pragma unroll 8
    for (int k = lane; k < rows * N; k += 32) to[k] = from[PITCH == N ? k : k + k / N];
  }
  __syncwarp();
}
// stores entries FROM to UPTO of row r, both shifted by the row's misalignment to aligned memory
template <class T, int N, int FROM, int UPTO, int MARGIN, int PITCH>
QUALIFIED void store_chunk(T* to, const T* tile, int r, int misalignment) {
  const int lane = LANE, upto = UPTO < N ? UPTO - misalignment : N;
#pragma unroll
  for (int c = 0; c < UPTO - FROM + MARGIN; c += 32) {
    const int k = FROM - misalignment + c + lane;
    if (k < upto && (FROM || k >= 0)) to[r * N + k] = tile[r * PITCH + MARGIN + k - FROM];
  }
}
// entries FROM to UPTO of each row of a warp, of N, from its tile to memory; the tile has room for
// MARGIN entries before them; the pieces of a row begin at multiples of ALIGN entries
template <class T, int N, int FROM, int UPTO, int ALIGN, int MARGIN, int PITCH>
QUALIFIED void flush(T* to, T* tile, int rows) {
  __syncwarp();
  if (rows == 32) {
#pragma unroll 1
    for (int r = 0; r < 32; r += 8)
#pragma unroll
      for (int i = 0; i < 8; i++)  // misalignments repeat after eight rows
        store_chunk<T, N, FROM, UPTO, MARGIN, PITCH>(to, tile, r + i, i * N % ALIGN);
  } else {
#pragma unroll 1
    for (int r = 0; r < rows; r++)
      store_chunk<T, N, FROM, UPTO, MARGIN, PITCH>(to, tile, r, r * N % ALIGN);
  }
  __syncwarp();
  if (UPTO < N)
    for (int c = 0; c < MARGIN; c++) {
      T* const row = tile + LANE * PITCH;
      row[c] = row[c + UPTO - FROM];
    }
}
"""


@dataclass(frozen=True)
class RowTile:
    """The layout of a result's rows in shared memory.

    dtype: dtype of an entry.
    size: entries of a row.
    width: entries of a chunk; `size` if a row is stored whole.
    align: chunks start at multiples of this number of entries.
    margin: entries that are kept from the previous chunk.
    pitch: entries from a thread's row to the next.
    """

    dtype: np.dtype
    size: int
    width: int
    align: int
    margin: int
    pitch: int

    @property
    def bytes(self) -> int:
        """The size of a thread's row, in bytes."""
        return self.pitch * self.dtype.itemsize


def is_staged(row: int) -> bool:
    """Return whether rows of this length are staged in shared memory as a whole."""
    return SHORT < row <= WHOLE


def whole_rows(dtype: np.dtype, size: int) -> RowTile:
    """Return the layout of rows that are stored whole, without gaps if bank conflicts are few."""
    return RowTile(dtype, size, size, 1, 0, size if size % 4 else size | 1)


def chunked_rows(dtype: np.dtype, size: int) -> RowTile:
    """Return the layout of rows that are stored in chunks, or whole if they fit into one chunk."""
    width = TILE * 4 // max(dtype.itemsize, 4)
    if size <= width:
        return whole_rows(dtype, size)
    align = ALIGN // max(dtype.itemsize, 4)  # groups of 32 rows start at aligned memory
    margin = 0 if size % align == 0 else align - 1
    return RowTile(dtype, size, width, margin + 1, margin, (width + margin) | 1)


def rows_of_runs(dtype: np.dtype, size: int) -> RowTile:
    """Return the layout of chunks that may start at any entry of a row."""
    width = min(TILE * 4 // max(dtype.itemsize, 4), size)
    return RowTile(dtype, size, width, 1, 0, width | 1)


def row_sizes(program: Written) -> dict[int, int]:
    """Return the entries of a row of each batch-first result, by its id."""
    found = {}
    for array, layout in zip(program.results, program.layouts[1], strict=True):
        row = layout.rows(program.batch)
        if row:
            found[array.id] = row
    return found


@dataclass(frozen=True)
class TileSlot:
    """The place in the tile that one store fills.

    at: column of the tile.
    first, upto: the range of entries to store, counted from the base of the store.
    last: whether the store completes the range, so that the tile is then written to memory.
    """

    at: int
    first: int
    upto: int
    last: bool


def assign_tile(
    program: Written, rows: dict[int, int]
) -> tuple[dict[int, RowTile], dict[int, TileSlot]]:
    """Return the results that are stored through the tile, and the slots of their stores, by id.

    rows: entries of a row of each candidate result. A result is stored through the tile only if no
        thread reads it and all threads reach its stores.
    """
    runs, whole = _runs(program, rows)
    alike, found = _uniform_indices(program), {}
    slots: dict[int, TileSlot] = {}
    for run in runs:
        array, row = run[0].array, rows[run[0].array.id]
        at_once = array.id in whole
        if not at_once and (len(run) < min(row, RUN) or run[0].base not in alike):
            continue
        form = chunked_rows(array.dtype, row) if at_once else rows_of_runs(array.dtype, row)
        found[array.id] = form
        for k, store in enumerate(run):
            at, upto = k % form.width, store.offset + 1
            last = at == form.width - 1 or k == len(run) - 1
            slots[id(store)] = TileSlot(form.margin + at, store.offset - at, upto, last)
    return found, slots


def written_at_once(program: Written, rows: dict[int, int]) -> set[int]:
    """Return the ids of the results of `rows` whose entries are written once, in order, without a
    store to another result between them, and not read."""
    return _runs(program, rows)[1]


def _runs(program: Written, rows: dict[int, int]) -> tuple[list[list[ir.Store]], set[int]]:
    """Return the runs of stores to results of `rows` that no thread reads, and the ids of the
    results that one run writes."""
    read = read_arrays(program)
    rows = {key: n for key, n in rows.items() if n > 1 and key not in read}
    runs = list(_consecutive_stores(program.builder.block, rows))
    stores = [s for s in ir.walk(program.builder.block) if isinstance(s, ir.Store)]
    counts = Counter(s.array.id for s in stores)
    whole = {
        run[0].array.id for run in runs
        if len(run) == rows[run[0].array.id] == counts[run[0].array.id] and run[0].base is None
    }  # fmt: skip
    return runs, whole


def read_arrays(program: Written) -> set[int]:
    """Return the ids of the arrays from which a program loads."""
    return {s.array.id for s in ir.walk(program.builder.block) if isinstance(s, ir.Load)}


def _uniform_indices(program: Written) -> set[ir.Var | None]:
    """Return the indices that are equal in all threads: they depend only on loop counters."""
    found: set[ir.Var | None] = {None}
    for s in ir.walk(program.builder.block):
        if isinstance(s, ir.Loop):
            found.add(s.counter)
        elif isinstance(s, ir.Op) and all(x in found for x in s.args if isinstance(x, ir.Var)):
            found.add(s.dest)
    return found


def _consecutive_stores(block: ir.Block, rows: dict[int, int]) -> Iterator[list[ir.Store]]:
    """Yield runs of stores to consecutive entries of a result of `rows`."""
    run: list[ir.Store] = []
    for s in block.statements:
        if isinstance(s, ir.Store) and s.array.id in rows:
            last = run[-1] if run else s
            follows = s.array is last.array and s.base is last.base
            if run and not (follows and s.offset == last.offset + 1):
                yield run
                run = []
            run.append(s)
        elif isinstance(s, ir.Loop) and any(
            isinstance(x, ir.Store) and x.array.id in rows for x in ir.walk(s.body)
        ):
            if run:
                yield run
                run = []
            yield from _consecutive_stores(s.body, rows)
    if run:
        yield run


def streaming_arrays(program: Written) -> set[int]:
    """Return the ids of long batch-last float arrays, whose entries are accessed once."""
    found = set()
    for arrays, layouts in zip((program.operands, program.results), program.layouts, strict=True):
        for array, layout in zip(arrays, layouts, strict=True):
            first = len(layout.shape) - len(layout.axes)
            last = layout.axes and layout.axes == tuple(range(first, len(layout.shape)))
            if last and array.size > WHOLE and array.dtype.kind == "f":
                found.add(array.id)
    return found


class StorePrinter(Printer):
    """A printer of statements, with stores through the tile, and streaming loads and stores.
    Entries of streaming arrays (`streaming_arrays`) do not stay in the cache."""

    def __init__(
        self, names: dict[int, str], tiles: dict[int, tuple[int, RowTile]],
        slots: dict[int, TileSlot], streaming: set[int], in_step: set[int],
        shared: dict[int, str],
    ):  # fmt: skip
        super().__init__(names, in_step, shared)
        self.tiles, self.slots, self.streaming = tiles, slots, streaming

    def _lines(self, statement: ir.Statement) -> Iterator[str]:
        slot = self.slots.get(id(statement))
        if isinstance(statement, ir.Store) and slot is not None:
            yield from self._through_tile(statement, slot)
        elif isinstance(statement, (ir.Load, ir.Store)) and statement.array.id in self.streaming:
            at = f"&{self.place(statement.array, statement.base, statement.offset)}"
            if isinstance(statement, ir.Store):
                yield f"__stcs({at},{self.value(statement.value)});"
            else:
                dest = statement.dest
                yield f"const {c_type(dest.dtype)} {self.value(dest)}=__ldcs({at});"
        else:
            yield from super()._lines(statement)

    def _through_tile(self, store: ir.Store, slot: TileSlot) -> Iterator[str]:
        k, rows = self.tiles[store.array.id]
        kind, pitch = c_type(rows.dtype), rows.pitch
        yield f"w{k}[LANE*{pitch}+{slot.at}]={self.value(store.value)};"
        if not slot.last:
            return
        to = f"v{k}" if store.base is None else f"v{k}+{self.value(store.base)}"
        if rows.width == rows.size == slot.upto - slot.first:
            yield f"store_rows<{kind},{rows.size},{pitch}>({to},w{k},rows);"
        else:
            sizes = (rows.size, slot.first, slot.upto, rows.align, rows.margin, pitch)
            yield f"flush<{kind},{','.join(map(str, sizes))}>({to},w{k},rows);"
