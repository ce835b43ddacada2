"""Prints a program as a CUDA kernel with one thread per sample.

The warp loads rows of a batch-first operand through shared memory, so that it reads whole cache
lines. Batch-first results are stored in the same way (`stores`). Other layouts are read and written
in place. A result that all samples share (the cotangent of an operand without a batch) is summed
over the warp, which stores one partial sum. A block is one warp, so that no warp waits for another;
or several warps, if a long program is faster when they run it in step (`lockstep`). The local
arrays that a loop uses most are in shared memory too (`shared_arrays`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rbjax.compiler.cuda import lockstep, stores
from rbjax.compiler.cuda.c_source import PREAMBLE, offset, parameters, sample_index, table
from rbjax.compiler.cuda.driver import shared_bytes_of
from rbjax.compiler.cuda.shared_arrays import MOST_LOCAL, SharedArrays, arrays_in_shared_memory
from rbjax.compiler.ir.c_text import c_type
from rbjax.compiler.ir.program import Written
from rbjax.compiler.ir.statements import Unsupported

WARP = 32
#: bytes of shared memory in which the warps of a block stage their rows
SHARED_BYTES = 47 * 1024
#: bytes of shared memory that the driver reserves for each block
DRIVERS_BYTES = 1024
#: programs of more statements use all registers, so that a multiprocessor holds few warps
FILLS_REGISTERS = 3_000
#: bytes of constant memory for tables; further tables are read through the cache
CONSTANT_BYTES = 48 * 1024
#: larger programs compile slowly: NVRTC needs a second per thousand statements
STATEMENTS_UP_TO = 100_000
#: the driver reserves a thread's arrays for all threads that the device can hold: 17 GB in total
ARRAY_BYTES_UP_TO = 64 * 1024

BASICS = """
#define QUALIFIED static __device__ inline
#define NAN __int_as_float(0x7fffffff)
#define INFINITY __int_as_float(0x7f800000)
#define RSQRTf(x) rsqrtf(x)
#define RSQRT(x) rsqrt(x)
typedef float c_float;
typedef double c_double;
"""
HEAD = """
#define LANE ((int)threadIdx.x % 32)
#define AT_ONCE 16
// registers spill to shared memory, because local memory that does not fit into L1 is in L2
#if __CUDACC_VER_MAJOR__ >= 13
#define SPILL_TO_SHARED asm volatile(".pragma \\"enable_smem_spilling\\";");
#else
#define SPILL_TO_SHARED
#endif
template <class T, int N, int PITCH> QUALIFIED void load_rows(T* to, const T* from, int rows) {
  if (rows < 32) {
    for (int k = LANE; k < rows * N; k += 32) to[PITCH == N ? k : k + k / N] = from[k];
    return;
  }
  for (int first = 0; first < N; first += AT_ONCE) {  // many reads are in flight
    T held[AT_ONCE];
#pragma unroll
    for (int j = 0; j < AT_ONCE; j++)
      if (first + j < N) held[j] = from[(first + j) * 32 + LANE];
#pragma unroll
    for (int j = 0; j < AT_ONCE; j++) {
      const int k = (first + j) * 32 + LANE;
      if (first + j < N) to[PITCH == N ? k : k + k / N] = held[j];
    }
  }
}
template <class T> QUALIFIED T over_warp(T x) {
  for (int k = 16; k; k >>= 1) x += __shfl_down_sync(0xffffffffu, x, k);
  return x;
}
"""


@dataclass(frozen=True)
class Kernel:
    """The CUDA source of a program, and its launch parameters.

    parts: number of parts of the batch. Each summed result has one row per part.
    summed: for each result, whether it is summed over the batch.
    shared_bytes: dynamic shared memory of a block, in bytes.
    """

    source: str
    name: str
    block: int
    grid: int
    parts: int
    summed: tuple[bool, ...]
    shared_bytes: int = 0


def kernel(
    program: Written,
    name: str = "threads",
    multiprocessor_bytes: Callable[[], int] | None = None,
) -> Kernel:
    """Return the kernel of a program. Raise `Unsupported` if it is too large for a thread.

    multiprocessor_bytes: function that returns the shared memory of a multiprocessor, for all its
        blocks. It is called for long programs only. None for the shared memory of an H100.
    """
    if program.statements > STATEMENTS_UP_TO:
        raise Unsupported(f"{program.statements} statements, more than {STATEMENTS_UP_TO}")
    sums = (a for a, s in zip(program.results, program.summed, strict=True) if s)
    bytes = program.array_bytes + sum(a.size * a.dtype.itemsize for a in sums)
    if bytes > ARRAY_BYTES_UP_TO:
        raise Unsupported(f"{bytes} bytes of arrays in a thread, more than {ARRAY_BYTES_UP_TO}")
    parts = max(-(-math.prod(program.batch) // WARP), 1)
    loops = lockstep.loops_in_step(program)
    for most in (lockstep.MOST_WARPS, lockstep.MOST_WARPS // 2):
        warps = lockstep.warps_of_block(parts, most) if loops else 1
        grid, threads = -(-parts // warps), WARP * warps
        available, shared = SHARED_BYTES, SharedArrays({}, 0, 0.0)
        if program.statements > FILLS_REGISTERS:
            blocks = min(most // warps, -(-grid // lockstep.MULTIPROCESSORS))
            every = multiprocessor_bytes() if multiprocessor_bytes else shared_bytes_of("9.0")
            of_block = max(every // blocks - DRIVERS_BYTES, 0)
            shared = arrays_in_shared_memory(program.builder.block, threads, of_block)
            if shared.places:
                available = min(available, of_block - shared.bytes)
        if not loops or shared.local <= MOST_LOCAL:
            break
    plan = _plan_shared_memory(program, available // threads)
    in_step = loops if warps > 1 else set()
    source = "\n".join(_lines(program, name, plan, warps, parts, in_step, shared))
    return Kernel(source, name, threads, grid, parts, program.summed, shared.bytes)


@dataclass(frozen=True)
class SharedMemoryPlan:
    """The allocation of a warp's shared memory. Arrays are identified by their id.

    staged: for each operand that is loaded through shared memory, the entries of a row.
    whole: results whose rows are staged as a whole.
    tiled: results that are stored in chunks through the tile.
    slots: the tile slots of their stores, by the id of the store.
    tile: bytes of the tile per thread.
    """

    staged: dict[int, int]
    whole: dict[int, stores.RowTile]
    tiled: dict[int, stores.RowTile]
    slots: dict[int, stores.TileSlot]
    tile: int


def _pitch(row: int) -> int:
    """Return the row pitch, an odd number, with which the threads of a warp use different banks."""
    return row | 1


def _plan_shared_memory(program: Written, available: int) -> SharedMemoryPlan:
    """Allocate shared memory to results staged as a whole, to the tile, and then to the operands
    that are read. Rows that are written at once and in order go through the tile, which they share.
    While the results do not fit, the largest one goes through the tile instead.

    available: bytes for a thread."""
    kinds = {a.id: a.dtype for a in program.results}
    rows = stores.row_sizes(program)
    at_once = stores.written_at_once(program, rows)
    short = [key for key, row in rows.items() if stores.is_staged(row) and key not in at_once]
    whole = {key: stores.whole_rows(kinds[key], rows[key]) for key in short}
    while True:
        tiled, slots = stores.assign_tile(
            program, {k: n for k, n in rows.items() if k not in whole}
        )
        tile = max((r.bytes for r in tiled.values()), default=0)
        total = tile + sum(r.bytes for r in whole.values())
        if total <= available or not whole:
            break
        del whole[max(whole, key=lambda k: whole[k].bytes)]
    if total > available:
        tiled, slots, tile, total = {}, {}, 0, 0
    wanted, read = {}, stores.read_arrays(program)
    for array, layout in zip(program.operands, program.layouts[0], strict=True):
        row = layout.rows(program.batch)
        if row is not None and stores.is_staged(row) and array.id in read:
            wanted[array.id] = row, _pitch(row) * array.dtype.itemsize
    staged = {}
    for key, (row, bytes) in sorted(wanted.items(), key=lambda x: x[1][1]):
        if total + bytes <= available:
            total += bytes
            staged[key] = row
    return SharedMemoryPlan(staged, whole, tiled, slots, tile)


def _lines(
    program: Written,
    name: str,
    plan: SharedMemoryPlan,
    warps: int,
    parts: int,
    in_step: set[int],
    shared: SharedArrays,
) -> Iterator[str]:
    size, index = math.prod(program.batch), sample_index(program.batch)
    ins, outs = program.layouts
    yield BASICS + HEAD + stores.HEAD + PREAMBLE
    if shared.places:
        yield f"#define THREADS {WARP * warps}"
        yield "extern __shared__ uint4 dynamic[];"
    constant = CONSTANT_BYTES
    for array in program.builder.tables:
        constant -= array.size * array.dtype.itemsize
        yield table(array, "static __constant__" if constant >= 0 else "static __device__ const")
    # without one block a multiprocessor the driver may limit a thread to 32 registers
    bounds = f"{WARP * warps},1" if warps > 1 else f"{WARP}"
    yield f'extern "C" __global__ void __launch_bounds__({bounds}) {name}('
    yield parameters(program, "__restrict__") + ("){" if shared.places else "){SPILL_TO_SHARED")
    yield f"const int warp={'(int)threadIdx.x/32' if warps > 1 else '0'};"
    yield f"const long long part=(long long)blockIdx.x*{warps}+warp;"
    if parts % warps:
        yield f"if(part>={parts})return;"  # barriers wait for threads that have not returned
    yield "const long long first=part*32;"
    yield f"const int rows={size}ll-first<32?(int)({size}ll-first):32;"
    # a thread beyond the batch repeats the last sample, which has no effect
    yield "const int own=LANE<rows?LANE:rows-1;"
    yield "const long long b=first+own;"
    names: dict[int, str] = {}
    for k, (array, layout) in enumerate(zip(program.operands, ins, strict=True)):
        names[array.id] = f"x{k}"
        kind, row = c_type(array.dtype), plan.staged.get(array.id)
        if row is None:
            yield f"const {kind}* __restrict__ x{k}=p{k}+({offset(layout, index)});"
        else:
            pitch = _pitch(row)
            yield f"__shared__ {kind} all_s{k}[{pitch * WARP * warps}];"
            yield f"{kind}* const s{k}=all_s{k}+warp*{pitch * WARP};"
            yield f"load_rows<{kind},{row},{pitch}>(s{k},p{k}+first*{row},rows);"
            yield f"const {kind}* x{k}=s{k}+own*{pitch};"
    if plan.staged:
        yield "__syncwarp();"
    if plan.tiled:
        words_of_tile = plan.tile * WARP // 16
        yield f"__shared__ uint4 tiles[{words_of_tile * warps}];"
        yield f"uint4* const tile=tiles+warp*{words_of_tile};"
    tiles: dict[int, tuple[int, stores.RowTile]] = {}
    store_calls = []
    for k, (array, layout) in enumerate(zip(program.results, outs, strict=True)):
        names[array.id] = f"y{k}"
        kind, key = c_type(array.dtype), array.id
        if program.summed[k]:
            yield f"{kind} y{k}[{max(array.size, 1)}];"
        elif key in plan.whole:
            n, pitch = plan.whole[key].size, plan.whole[key].pitch
            words = plan.whole[key].bytes * WARP // 16
            yield f"__shared__ uint4 all_o{k}[{words * warps}];"
            yield f"uint4* const o{k}=all_o{k}+warp*{words};"
            yield f"{kind}* const y{k}=({kind}*)o{k}+LANE*{pitch};"
            store_calls.append(
                f"store_rows<{kind},{n},{pitch}>(r{k}+first*{n},({kind}*)o{k},rows);"
            )
        elif key in plan.tiled:
            tiles[key] = k, plan.tiled[key]
            yield f"{kind}* const w{k}=({kind}*)tile;"
            yield f"{kind}* const v{k}=r{k}+first*{plan.tiled[key].size};"
            yield f"{kind}* y{k}=r{k}+({offset(layout, index)});"
        else:
            yield f"{kind}* y{k}=r{k}+({offset(layout, index)});"
    streaming = stores.streaming_arrays(program)
    printer = stores.StorePrinter(names, tiles, plan.slots, streaming, in_step, shared.places)
    yield from printer.lines(program.builder.block)
    yield from store_calls
    yield from _sums(program)
    yield "}"


def _sums(program: Written) -> Iterator[str]:
    """Print the code that sums results over the samples of a warp."""
    for k, array in enumerate(program.results):
        if not program.summed[k] or not array.size:
            continue
        kind, n = c_type(array.dtype), array.size
        yield "" if n <= 64 else "#pragma unroll 1"
        yield f"for(int i=0;i<{n};i++){{"
        yield f"const {kind} t=over_warp<{kind}>(LANE<rows?y{k}[i]:({kind})0);"
        yield f"if(LANE==0)r{k}[part*{n}+i]=t;"
        yield "}"
