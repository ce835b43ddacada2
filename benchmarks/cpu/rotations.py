"""Rotations against scipy's `Rotation`, a batch of a million: on one core and on all, f64 and f32.

`python -m benchmarks.cpu.rotations` measures the operations that both have: `jit` of rbjax on
batch-first arrays, with the compiler options of a call outside of any trace, against scipy's
method. It takes run time only, the minimum of many alternating runs. A first process is pinned to
one core, a second has all cores and XLA's own threads (scipy uses only one core and only f64). Then
both run again with rbjax in f32, the default of JAX.
The allocator keeps freed memory, for both sides. By default results above 32 MB come from fresh
pages on every call, and these page faults take longer than the arithmetic.

Operations that move much and compute little are limited by memory. So the tables also give the
bytes that an operation must read and write, and the times of a copy and a fill of 72 MB (the size
of as_matrix's result).
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

if sys.argv[1:2] == ["one"]:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false " + os.environ.get(
        "XLA_FLAGS", ""
    )
if sys.argv[1:]:
    os.environ["JAX_ENABLE_X64"] = str(int(sys.argv[2] == "f64"))
if sys.platform == "linux":  # M_MMAP_MAX, M_TRIM_THRESHOLD, M_ARENA_MAX of glibc's malloc.h
    for option, value in ((-4, 0), (-1, 2**31 - 1), (-8, 1)):
        ctypes.CDLL(None).mallopt(option, value)

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.shared.timing import markdown_table, save
from rbjax.compiling import wide_vectors
from rbjax.rotations import quaternion, representations

CORES, DTYPE = sys.argv[1:] or ("", "")  # of a measuring process
BATCH = 1_000_000
SECONDS, TURN = 1.5, 5  # for each operation; calls in a row


def cases() -> list[tuple[str, object, tuple, object]]:
    """Name, ours, its arguments, scipy's."""
    rng = np.random.default_rng(0)
    a, b = (Rotation.random(BATCH, rng=rng) for _ in range(2))
    q, p = (jnp.asarray(r.as_quat(scalar_first=True)) for r in (a, b))
    R, v, phi = a.as_matrix(), rng.normal(size=(BATCH, 3)), a.as_rotvec()
    s = rng.uniform(size=BATCH)
    reps = representations()
    zyx, xyx, mrp = (reps[n] for n in ("intrinsic_zyx", "extrinsic_xyx", "mrp"))
    euler, proper, m = a.as_euler("ZYX"), a.as_euler("xyx"), a.as_mrp()
    ends = Slerp([0.0, 1.0], Rotation.concatenate([a[0], b[0]]))
    quat = quaternion
    return [
        ("as_matrix", quat.to_matrix, (q,), a.as_matrix),
        ("from_matrix", quat.from_matrix, (R,), lambda: Rotation.from_matrix(R)),
        ("as_rotvec", quat.log, (q,), a.as_rotvec),
        ("from_rotvec", quat.exp, (phi,), lambda: Rotation.from_rotvec(phi)),
        ("as_euler ZYX", zyx.from_quaternion, (q,), lambda: a.as_euler("ZYX")),
        ("from_euler ZYX", zyx.to_quaternion, (euler,), lambda: Rotation.from_euler("ZYX", euler)),
        ("as_euler xyx", xyx.from_quaternion, (q,),
         lambda: a.as_euler("xyx")),
        ("from_euler xyx", xyx.to_quaternion, (proper,),
         lambda: Rotation.from_euler("xyx", proper)),
        ("as_mrp", mrp.from_quaternion, (q,), a.as_mrp),
        ("from_mrp", mrp.to_quaternion, (m,), lambda: Rotation.from_mrp(m)),
        ("multiply", quat.multiply, (q, p), lambda: a * b),
        ("inv", quat.conjugate, (q,), a.inv),
        ("magnitude", quat.angle, (q,), a.magnitude),
        ("apply", quat.rotate, (q, v), lambda: a.apply(v)),
        ("slerp", lambda s: quat.interpolate(q[0], p[0], s), (s,), lambda: ends(s)),
    ]  # fmt: skip


def least(seconds: float, *calls: Callable[[], Any]) -> list[float]:
    """The minimum time of each, in alternating runs."""
    best = [float("inf")] * len(calls)
    deadline = time.perf_counter() + seconds
    while time.perf_counter() < deadline:
        for i, call in enumerate(calls):
            for _ in range(TURN):  # the first call of a turn has the other's data in the cache
                start = time.perf_counter()
                jax.block_until_ready(call())
                best[i] = min(best[i], time.perf_counter() - start)
    return best


def rows() -> list[dict[str, Any]]:
    """One row an operation; times per rotation."""
    source, target = np.ones((2, BATCH, 9))
    copy, fill = least(SECONDS, lambda: np.copyto(target, source), lambda: target.fill(1.0))
    out: list[dict[str, Any]] = [
        {"cores": CORES, "operation": "copy of 72 MB", "scipy ns": copy / BATCH * 1e9, "MB": 144},
        {"cores": CORES, "operation": "fill of 72 MB", "scipy ns": fill / BATCH * 1e9, "MB": 72},
    ]
    for name, ours, arguments, theirs in cases():
        arguments = tuple(jnp.asarray(x) for x in arguments)
        start = time.perf_counter()
        compiled = jax.jit(ours, compiler_options=wide_vectors()).lower(*arguments).compile()
        compile_s = time.perf_counter() - start
        result = jax.block_until_ready(compiled(*arguments))
        moved = sum(x.nbytes for x in jax.tree.leaves((arguments, result)))

        def call(compiled=compiled, arguments=arguments):
            return compiled(*arguments)

        fast, slow = least(SECONDS, call, theirs)
        out.append({
            "cores": CORES,
            "dtype": DTYPE,
            "operation": name,
            "rbjax ns": fast / BATCH * 1e9,
            "scipy ns": slow / BATCH * 1e9,
            "ratio": slow / fast,
            "MB": moved / 1e6,
            "rbjax GB/s": moved / fast / 1e9,
            "compile_s": compile_s,
        })  # fmt: skip
    return out


def main() -> None:
    if CORES:
        print(json.dumps(rows()))
        return
    found = []
    for dtype in ("f64", "f32"):
        for cores in ("one", "all"):
            command = [sys.executable, "-m", "benchmarks.cpu.rotations", cores, dtype]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            found += json.loads(done.stdout.splitlines()[-1])
    print(markdown_table(found, found[-1]))
    print(save("cpu-rotations", found))


if __name__ == "__main__":
    main()
