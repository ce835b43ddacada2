"""A CUDA kernel's source run on the host: the threads of a block are threads of the host.

They run together, or one at a time: each from barrier to barrier, in a given order. A missing
barrier then shows every time.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rbjax.compiler.cuda.kernels import Kernel
from tests.compiler.host import library

BEYOND, POISON = 4096, 77

HEAD = """
#include <atomic>
#include <barrier>
#include <cmath>
#include <cstring>
#include <memory>
#include <semaphore>
#include <thread>
#include <vector>
#define __device__
#define __global__
#define __constant__
#define __restrict__
#define __launch_bounds__(...)
#define __shared__ static
struct Index { int x; };
struct alignas(16) uint4 { unsigned x, y, z, w; };
static thread_local Index threadIdx, blockIdx;
static std::unique_ptr<std::barrier<>> whole;
static std::vector<std::unique_ptr<std::barrier<>>> warps;
static double passed[THREADS];
static float __int_as_float(int bits) { float x; memcpy(&x, &bits, 4); return x; }
static float rsqrtf(float x) { return 1 / sqrtf(x); }
static double rsqrt(double x) { return 1 / sqrt(x); }
using std::isfinite;
template <class T> static void __stcs(T* to, T x) { *to = x; }
template <class T> static T __ldcs(const T* from) { return *from; }
#ifdef IN_TURN  // 1, or -1 for the last first
static std::counting_semaphore<1> turns[THREADS]{@ZEROS@};
static void pass_on() { turns[(threadIdx.x + THREADS + IN_TURN) % THREADS].release(); }
static void wait_for_turn() { turns[threadIdx.x].acquire(); }
static void __syncthreads() { pass_on(); wait_for_turn(); }
static void __syncwarp() { __syncthreads(); }
#else
static void pass_on() {}
static void wait_for_turn() {}
static void __syncthreads() { whole->arrive_and_wait(); }
static void __syncwarp() { warps[threadIdx.x / 32]->arrive_and_wait(); }
#endif
static std::atomic<int> votes;
static bool __syncthreads_or(bool x) {
  votes += x;
  __syncthreads();
  const bool out = votes > 0;
  __syncthreads();
  if (threadIdx.x == 0) votes = 0;
  __syncthreads();
  return out;
}
template <class T> static T __shfl_down_sync(unsigned, T x, int by) {
  passed[threadIdx.x] = x;
  __syncwarp();
  const T out = threadIdx.x % 32 + by < 32 ? (T)passed[threadIdx.x + by] : x;
  __syncwarp();
  return out;
}
#undef NAN
#undef INFINITY
"""

LAUNCH = """
extern "C" void run(int blocks, void** p) {{
  for (int k = 0; k < THREADS / 32; k++)
    warps.push_back(std::make_unique<std::barrier<>>(32));
  for (int b = 0; b < blocks; b++) {{  // one after the other: they share the statics
    whole = std::make_unique<std::barrier<>>(THREADS);
    std::vector<std::thread> all;
    for (int t = 0; t < THREADS; t++)
      all.emplace_back([=] {{
        blockIdx.x = b;
        threadIdx.x = t;
        wait_for_turn();
        {name}({pointers});
        whole->arrive_and_drop();  // a barrier waits for threads that have not returned
        if (t != LAST) pass_on();
      }});
    START;
    for (auto& thread : all) thread.join();
  }}
}}
"""


def emulated(
    kernel: Kernel, operands: Sequence[Any], results: Sequence[Any], in_turn: int = 0
) -> list[np.ndarray]:
    """What the kernel writes: arrays of these shapes and types; partial sums one a block. in_turn:
    1 or -1, one thread at a time, the first or the last thread of the block first."""
    signature = kernel.source.split(f"{kernel.name}(", 1)[1].split("){", 1)[0]
    types = [p.replace("const ", "").split("*")[0].strip() for p in signature.split(",")]
    pointers = ",".join(f"({kind}*)p[{k}]" for k, kind in enumerate(types))
    first, last = (0, kernel.block - 1)[:: in_turn or 1]
    turns = f"#define IN_TURN {in_turn}\n#define START turns[{first}].release()"
    dynamic = f"static uint4 dynamic[{kernel.shared_bytes // 16}]"
    code = kernel.source.replace("extern __shared__ uint4 dynamic[]", dynamic)
    zeros = ",".join(["std::counting_semaphore<1>(0)"] * kernel.block)
    source = "\n".join([
        f"#define THREADS {kernel.block}\n#define LAST {last}",
        turns if in_turn else "#define START",
        HEAD.replace("@ZEROS@", zeros), code,
        LAUNCH.format(name=kernel.name, pointers=pointers),
    ])  # fmt: skip
    run = library(source, ("-std=c++20", "-O1", "-ffp-contract=off", "-pthread")).run
    ins = [np.ascontiguousarray(x) for x in operands]
    shapes = [
        (kernel.parts, *x.shape) if summed else x.shape
        for x, summed in zip(results, kernel.summed, strict=True)
    ]
    # poisoned, and longer than they should be
    outs = [
        np.full(math.prod(s) + BEYOND, POISON, x.dtype)
        for s, x in zip(shapes, results, strict=True)
    ]
    every = (*ins, *outs)
    run(kernel.grid, (ctypes.c_void_p * len(every))(*(x.ctypes.data for x in every)))
    poison = [x.dtype.type(POISON) for x in outs]
    beyond = all((x[-BEYOND:] == p).all() for x, p in zip(outs, poison, strict=True))
    assert beyond, "written beyond the end"
    found = [x[:-BEYOND].reshape(s) for x, s in zip(outs, shapes, strict=True)]
    return [x.sum(0) if summed else x for x, summed in zip(found, kernel.summed, strict=True)]
