"""The frame of a program on a GPU: one thread a sample.

Rows of a batch-first operand are fetched by the whole block through shared memory, so that a warp
reads whole lines; a batch-first result is written back by warps, 32 entries of their 32 rows at a
time. Other layouts are read and written in place. What all samples share of a result (the cotangent
of an operand without a batch) is added up over the block, one partial sum a block.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rbjax.threads.c_source import PREAMBLE, Printer, c_type, table
from rbjax.threads.frame import Written, offset, parameters, sample_index
from rbjax.threads.lowering import Unsupported
from rbjax.threads.program import Array, Block, Load, Loop, Op, Store, Var, walk

#: threads of a block, where its rows fit into shared memory; else half as many
BLOCK = 128
#: bytes of shared memory that a block stages its rows in
SHARED_BYTES = 47 * 1024
#: a row of few entries (about one sector of the cache) and one of many are read in place
SHORT, ROW = 8, 128
#: entries of a result's row that leave through the warp's tile where they are not the whole row
RUN = 16
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
    through = {s.array.id for s in walk(program.builder.block) if id(s) in streams}
    tile = 33 * max((a.dtype.itemsize for a in program.results if a.id in through), default=0)
    block, rows = _staged(program, tile)
    source = "\n".join(_lines(program, name, block, rows, (streams, through), tile))
    grid = max(-(-math.prod(program.batch) // block), 1)
    return Kernel(source, name, block, grid, program.summed)


def _pitch(row: int) -> int:
    """Entries from row to row: odd, so that the threads of a warp meet different banks."""
    return row | 1


@dataclass(frozen=True)
class Spot:
    """Where a value waits in its warp's tile: column `at` of `width`, which go to memory from
    `first` on once the last has come."""

    at: int
    width: int
    first: int


def _streamed(program: Written) -> dict[int, Spot]:
    """The stores that go through the tile of their warp, by id: runs of consecutive entries of a
    batch-first result that is never read, where all threads pass, with no other such result
    between; whole rows, or long ones."""
    read = {s.array.id for s in walk(program.builder.block) if isinstance(s, Load)}
    rows = {
        array.id: layout.rows(program.batch) or 0
        for array, layout in zip(program.results, program.layouts[1], strict=True)
        if array.id not in read
    }
    alike = _alike(program)
    found = {}
    for run in _runs(program.builder.block, rows):
        row = rows[run[0].array.id]
        if row > 1 and len(run) >= min(row, RUN) and run[0].base in alike:
            for k, store in enumerate(run):
                at = k % 32
                width = min(32, len(run) - k + at)
                found[id(store)] = Spot(at, width, store.offset - at)
    return found


def _alike(program: Written) -> set[Any]:
    """The places in an array that are the same for all threads: those made of loops' counters."""
    found: set[Any] = {None}
    for s in walk(program.builder.block):
        if isinstance(s, Loop):
            found.add(s.counter)
        elif isinstance(s, Op) and all(x in found for x in s.args if isinstance(x, Var)):
            found.add(s.dest)
    return found


def _runs(block: Block, rows: dict[int, int]) -> Iterator[list[Store]]:
    """Stores of consecutive entries of one of these results."""
    run: list[Store] = []
    for s in block.statements:
        if isinstance(s, Store) and s.array.id in rows:
            last = run[-1] if run else s
            follows = s.array is last.array and s.base is last.base
            if run and not (follows and s.offset == last.offset + 1):
                yield run
                run = []
            run.append(s)
        elif isinstance(s, Loop):
            if run:
                yield run
                run = []
            yield from _runs(s.body, rows)
    if run:
        yield run


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
    """Prints statements; those that are streamed fill the warp's tile and empty it."""

    def __init__(
        self, names: dict[int, str], streams: dict[int, Spot], rows: dict[int, tuple[int, int]]
    ):
        super().__init__(names)
        self.streams, self.rows = streams, rows

    def _lines(self, statement: Any) -> Iterator[str]:
        spot = self.streams.get(id(statement))
        if spot is None:
            yield from super()._lines(statement)
            return
        k, row = self.rows[statement.array.id]
        yield f"w{k}[threadIdx.x%32*33+{spot.at}]={self.value(statement.value)};"
        if spot.at == spot.width - 1:
            kind, base = c_type(statement.array.dtype), statement.base
            to = f"v{k}+{spot.first}" if base is None else f"v{k}+{self.value(base)}+{spot.first}"
            yield f"flush<{kind},{row},{spot.width}>({to},w{k},warp_rows);"


def _lines(
    program: Written, name: str, block: int, rows: dict[int, int],
    streamed: tuple[dict[int, Spot], set[int]], tile: int,
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
    streams, through = streamed
    if streams:
        yield f"__shared__ double tiles[{-(-tile * block // 8)}];"
        yield "const int warp=threadIdx.x/32;"
        yield "const int warp_rows=rows-32*warp<32?rows-32*warp:32;"
    places: dict[int, tuple[int, int]] = {}
    for k, (array, layout) in enumerate(zip(program.results, outs, strict=True)):
        names[array.id] = f"y{k}"
        kind = c_type(array.dtype)
        if program.summed[k]:
            yield f"{kind} y{k}[{max(array.size, 1)}];"
            continue
        yield f"{kind}* y{k}=r{k}+({offset(layout, index)});"
        if array.id in through:
            places[array.id] = k, array.size
            yield f"{kind}* const w{k}=({kind}*)tiles+warp*{33 * 32};"
            yield f"{kind}* const v{k}=r{k}+(first+32*warp)*{array.size};"
    yield from KernelPrinter(names, streams, places).lines(program.builder.block)
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
