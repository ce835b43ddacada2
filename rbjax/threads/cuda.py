"""The frame of a program on a GPU: one thread a sample.

Rows of a batch-first operand are fetched by the whole block through shared memory, so that a warp
reads and writes whole lines; other layouts are read in place. What all samples share of a result
(the cotangent of an operand without a batch) is added up over the block, one partial sum a block.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from rbjax.threads.c_source import PREAMBLE, Printer, c_type, table
from rbjax.threads.frame import Written, offset, parameters, sample_index
from rbjax.threads.program import Array

#: threads of a block, where its rows fit into shared memory; else half as many
BLOCK = 128
#: bytes of shared memory that a block stages its rows in
SHARED_BYTES = 47 * 1024
#: a row of few entries (about one sector of the cache) and one of many are read in place
SHORT, ROW = 8, 128
#: bytes of constant memory that tables may take; what is beyond is read through the cache
CONSTANT_BYTES = 48 * 1024

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
template <class T, int N, int PITCH> QUALIFIED void put_back(T* to, const T* from, int rows) {
#pragma unroll 8
  for (int k = threadIdx.x; k < rows * N; k += BLOCK) to[k] = from[PITCH == N ? k : k + k / N];
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
    """The kernel of a program."""
    size = math.prod(program.batch)
    block, rows = _staged(program)
    lines = "\n".join(_lines(program, name, size, block, rows))
    return Kernel(lines, name, block, max(-(-size // block), 1), program.summed)


def _staged(program: Written) -> tuple[int, dict[int, int]]:
    """Threads of a block, and the arrays that go through shared memory: id -> entries of a row."""
    found: list[tuple[int, Array, int]] = []
    for arrays, layouts in zip((program.operands, program.results), program.layouts, strict=True):
        for array, layout in zip(arrays, layouts, strict=True):
            row = layout.rows(program.batch)
            if row is not None and SHORT < row <= ROW and None not in layout.axes and layout.axes:
                found.append((_pitch(row) * array.dtype.itemsize, array, row))
    found.sort(key=lambda x: x[0])
    total = sum(bytes for bytes, _, _ in found)
    block = BLOCK if total * BLOCK <= SHARED_BYTES else BLOCK // 2
    used, rows = 0, {}
    for bytes, array, row in found:
        used += bytes * block
        if used <= SHARED_BYTES:
            rows[array.id] = row
    return block, rows


def _pitch(row: int) -> int:
    """Entries from row to row: odd, so that the threads of a warp meet different banks."""
    return row | 1


def _lines(
    program: Written, name: str, size: int, block: int, rows: dict[int, int]
) -> Iterator[str]:
    index = sample_index(program.batch)
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
    if any(array.id in rows for array in program.operands):
        yield "__syncthreads();"
    for k, (array, layout) in enumerate(zip(program.results, outs, strict=True)):
        names[array.id] = f"y{k}"
        kind, row = c_type(array.dtype), rows.get(array.id)
        if program.summed[k]:
            yield f"{kind} y{k}[{max(array.size, 1)}];"
        elif row is None:
            yield f"{kind}* y{k}=r{k}+({offset(layout, index)});"
        else:
            pitch = _pitch(row)
            yield f"__shared__ {kind} w{k}[{pitch * block}];"
            yield f"{kind}* y{k}=w{k}+own*{pitch};"
    yield from Printer(names).lines(program.builder.block)
    yield from _end(program, block, rows)
    yield "}"


def _end(program: Written, block: int, rows: dict[int, int]) -> Iterator[str]:
    if any(array.id in rows for array in program.results):
        yield "__syncthreads();"
    for k, array in enumerate(program.results):
        kind, row = c_type(array.dtype), rows.get(array.id)
        if row is not None:
            yield f"put_back<{kind},{row},{_pitch(row)}>(r{k}+first*{row},w{k},rows);"
        if program.summed[k] and array.size:
            warps, n = block // 32, array.size
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
