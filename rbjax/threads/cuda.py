"""The frame of a program on a GPU: one thread a sample.

Rows of a batch-first operand are fetched by the whole block through shared memory, so that a warp
reads whole lines; a batch-first result is written back by warps, 32 entries of their 32 rows at a
time. Other layouts are read and written in place. What all samples share of a result (the cotangent
of an operand without a batch) is added up over the block, one partial sum a block.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rbjax.threads.c_source import PREAMBLE, Printer, c_type, table
from rbjax.threads.frame import Written, offset, parameters, sample_index
from rbjax.threads.lowering import Unsupported
from rbjax.threads.program import Array, Load, Store, walk

#: threads of a block, where its rows fit into shared memory; else half as many
BLOCK = 128
#: bytes of shared memory that a block stages its rows in
SHARED_BYTES = 47 * 1024
#: a row of few entries (about one sector of the cache) and one of many are read in place
SHORT, ROW = 8, 128
PASSING = True
#: bytes of constant memory that tables may take; what is beyond is read through the cache
CONSTANT_BYTES = 48 * 1024
#: NVRTC takes a minute for more statements
STATEMENTS_UP_TO = 60_000
#: the driver reserves a thread's arrays for all threads that the device can hold at once: 17 GB
ARRAY_BYTES_UP_TO = 64 * 1024

HEAD = """
#define QUALIFIED static __device__ inline
#define NAN __int_as_float(0x7fffffff)
#define INFINITY __int_as_float(0x7f800000)
#define RSQRTf(x) rsqrtf(x)
#define RSQRT(x) rsqrt(x)
#define AT_ONCE 16
typedef float c_float;
typedef double c_double;
template <class T, int N, int PITCH> QUALIFIED void fetch(T* to, const T* from, int rows) {
  if (rows < BLOCK) {
    for (int k = threadIdx.x; k < rows * N; k += BLOCK) to[PITCH == N ? k : k + k / N] = from[k];
    return;
  }
  for (int first = 0; first < N; first += AT_ONCE) {  // many reads on their way at a time
    T held[AT_ONCE];
#pragma unroll
    for (int j = 0; j < AT_ONCE; j++)
      if (first + j < N) held[j] = from[(first + j) * BLOCK + threadIdx.x];
#pragma unroll
    for (int j = 0; j < AT_ONCE; j++) {
      const int k = (first + j) * BLOCK + threadIdx.x;
      if (first + j < N) to[PITCH == N ? k : k + k / N] = held[j];
    }
  }
}
// W entries of each row of a warp, of N entries, from its tile to memory
template <class T, int N, int W> QUALIFIED void flush(T* to, const T* tile, int rows) {
  const int lane = threadIdx.x % 32;
  __syncwarp();
  if (rows == 32) {
#pragma unroll
    for (int j = 0; j < W; j++) {
      const int k = 32 * j + lane;
      to[k / W * N + k % W] = tile[k / W * 33 + k % W];
    }
  } else {
    for (int k = lane; k < rows * W; k += 32) to[k / W * N + k % W] = tile[k / W * 33 + k % W];
  }
  __syncwarp();
}
template <class T> QUALIFIED T over_warp(T x) {
  for (int k = 16; k; k >>= 1) x += __shfl_down_sync(0xffffffffu, x, k);
  return x;
}
"""


@dataclass(frozen=True)
class Kernel:
    """CUDA source of a program and how to launch it."""

    source: str
    name: str
    block: int
    grid: int
    #: for each result whether it comes as one partial sum a block
    summed: tuple[bool, ...]


def kernel(program: Written, name: str = "threads") -> Kernel:
    """The kernel of a program; `Unsupported` where it is too large for a thread."""
    if program.statements > STATEMENTS_UP_TO:
        raise Unsupported(f"{program.statements} statements, of at most {STATEMENTS_UP_TO}")
    if program.array_bytes > ARRAY_BYTES_UP_TO:
        raise Unsupported(
            f"{program.array_bytes} bytes of arrays in a thread, of at most {ARRAY_BYTES_UP_TO}"
        )
    streams = _streamed(program)
    tile = 33 * max((a.dtype.itemsize for a in program.results if a.id in streams), default=0)
    block, rows = _staged(program, tile)
    source = "\n".join(_lines(program, name, block, rows, streams, tile))
    grid = max(-(-math.prod(program.batch) // block), 1)
    return Kernel(source, name, block, grid, program.summed)


def _pitch(row: int) -> int:
    """Entries from row to row: odd, so that the threads of a warp meet different banks."""
    return row | 1


def _streamed(program: Written) -> dict[int, int]:
    """The batch-first results that are written once, from the first entry to the last, where all
    threads pass, with no other result between, and never read: id -> entries of a row."""
    results = {a.id for a in program.results}
    stores = [
        (s.array.id, s.base, s.offset)
        for s in program.builder.block.statements
        if isinstance(s, Store) and s.array.id in results
    ]
    used = Counter(s.array.id for s in walk(program.builder.block) if isinstance(s, (Load, Store)))
    first = {key: n for n, (key, _, _) in reversed([*enumerate(stores)])}
    found = {}
    for array, layout in zip(program.results, program.layouts[1], strict=True):
        row, start = layout.rows(program.batch), first.get(array.id, 0)
        order = [(array.id, None, k) for k in range(row or 0)]
        if row and row > 1 and stores[start : start + row] == order and used[array.id] == row:
            found[array.id] = row
    return found


def _passing(program: Written) -> set[int]:
    """Long arrays of floats that have the batch last: read or written once, line by line."""
    found = set()
    for arrays, layouts in zip((program.operands, program.results), program.layouts, strict=True):
        for array, layout in zip(arrays, layouts, strict=True):
            first = len(layout.shape) - len(layout.axes)
            last = layout.axes and layout.axes == tuple(range(first, len(layout.shape)))
            if last and array.size > ROW and array.dtype.kind == "f":
                found.add(array.id)
    return found if PASSING else set()


def _staged(program: Written, tile: int) -> tuple[int, dict[int, int]]:
    """Threads of a block, and the operands that go through shared memory: id -> entries of a row;
    `tile` bytes a thread are taken."""
    found: list[tuple[int, Array, int]] = []
    for array, layout in zip(program.operands, program.layouts[0], strict=True):
        row = layout.rows(program.batch)
        if row is not None and SHORT < row <= ROW:
            found.append((_pitch(row) * array.dtype.itemsize, array, row))
    found.sort(key=lambda x: x[0])
    total = tile + sum(bytes for bytes, _, _ in found)
    block = BLOCK if total * BLOCK <= SHARED_BYTES else BLOCK // 2
    used, rows = tile * block, {}
    for bytes, array, row in found:
        used += bytes * block
        if used <= SHARED_BYTES:
            rows[array.id] = row
    return block, rows


class KernelPrinter(Printer):
    """Prints statements; those that write a streamed result fill the warp's tile and empty it.
    Entries of passing arrays do not stay in the cache, which has better use for its lines."""

    def __init__(
        self, names: dict[int, str], streams: dict[int, tuple[int, int]], passing: set[int]
    ):
        super().__init__(names)
        self.streams, self.passing = streams, passing

    def _lines(self, statement: Any) -> Iterator[str]:
        if isinstance(statement, (Load, Store)) and statement.array.id in self.passing:
            at = f"&{self.place(statement.array, statement.base, statement.offset)}"
            if isinstance(statement, Store):
                yield f"__stcs({at},{self.value(statement.value)});"
            else:
                dest = statement.dest
                yield f"const {c_type(dest.dtype)} {self.value(dest)}=__ldcs({at});"
            return
        if not (isinstance(statement, Store) and statement.array.id in self.streams):
            yield from super()._lines(statement)
            return
        k, row = self.streams[statement.array.id]
        kind, at = c_type(statement.array.dtype), statement.offset % 32
        yield f"w{k}[threadIdx.x%32*33+{at}]={self.value(statement.value)};"
        if at == 31 or statement.offset == row - 1:
            first = statement.offset - at
            yield f"flush<{kind},{row},{at + 1}>(y{k}+{first},w{k},warp_rows);"


def _lines(
    program: Written, name: str, block: int, rows: dict[int, int], streams: dict[int, int],
    tile: int,
) -> Iterator[str]:  # fmt: skip
    size, index = math.prod(program.batch), sample_index(program.batch)
    ins, outs = program.layouts
    yield f"#define BLOCK {block}"
    yield HEAD + PREAMBLE
    left = CONSTANT_BYTES
    for array in program.builder.tables:
        left -= array.size * array.dtype.itemsize
        yield table(array, "static __constant__" if left >= 0 else "static __device__ const")
    yield f'extern "C" __global__ void __launch_bounds__({block}) {name}('
    yield parameters(program, "__restrict__") + "){"
    yield f"const long long first=(long long)blockIdx.x*{block};"
    yield f"const int rows={size}ll-first<{block}?(int)({size}ll-first):{block};"
    # a thread beyond the batch repeats the last sample, which does no harm
    yield "const int own=(int)threadIdx.x<rows?(int)threadIdx.x:rows-1;"
    yield "const long long b=first+own;"
    names: dict[int, str] = {}
    for k, (array, layout) in enumerate(zip(program.operands, ins, strict=True)):
        names[array.id] = f"x{k}"
        kind, row = c_type(array.dtype), rows.get(array.id)
        if row is None:
            yield f"const {kind}* __restrict__ x{k}=p{k}+({offset(layout, index)});"
        else:
            pitch = _pitch(row)
            yield f"__shared__ {kind} s{k}[{pitch * block}];"
            yield f"fetch<{kind},{row},{pitch}>(s{k},p{k}+first*{row},rows);"
            yield f"const {kind}* x{k}=s{k}+own*{pitch};"
    if rows:
        yield "__syncthreads();"
    if streams:
        yield f"__shared__ double tiles[{-(-tile * block // 8)}];"
        yield "const int warp=threadIdx.x/32;"
        yield "const int warp_rows=rows-32*warp<32?rows-32*warp:32;"
    places: dict[int, tuple[int, int]] = {}
    for k, (array, layout) in enumerate(zip(program.results, outs, strict=True)):
        names[array.id] = f"y{k}"
        kind, row = c_type(array.dtype), streams.get(array.id)
        if program.summed[k]:
            yield f"{kind} y{k}[{max(array.size, 1)}];"
        elif row is None:
            yield f"{kind}* y{k}=r{k}+({offset(layout, index)});"
        else:
            places[array.id] = k, row
            yield f"{kind}* const w{k}=({kind}*)tiles+warp*{33 * 32};"
            yield f"{kind}* const y{k}=r{k}+(first+32*warp)*{row};"
    yield from KernelPrinter(names, places, _passing(program)).lines(program.builder.block)
    yield from _sums(program, block)
    yield "}"


def _sums(program: Written, block: int) -> Iterator[str]:
    """Results of the whole batch: one partial sum a block."""
    for k, array in enumerate(program.results):
        if not program.summed[k] or not array.size:
            continue
        kind, warps, n = c_type(array.dtype), block // 32, array.size
        yield f"__shared__ {kind} u{k}[{warps}];"
        yield "" if n <= 64 else "#pragma unroll 1"
        yield f"for(int i=0;i<{n};i++){{"
        yield f"const {kind} t=over_warp<{kind}>((int)threadIdx.x<rows?y{k}[i]:({kind})0);"
        yield "__syncthreads();"
        yield f"if(threadIdx.x%32==0)u{k}[threadIdx.x/32]=t;"
        yield "__syncthreads();"
        total = "+".join(f"u{k}[{w}]" for w in range(warps))
        yield f"if(threadIdx.x==0)r{k}[(long long)blockIdx.x*{n}+i]={total};"
        yield "}"
