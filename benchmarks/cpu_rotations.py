"""Rotations beside scipy's `Rotation`, a batch of a million, one core, f64.

`python -m benchmarks.cpu_rotations`: what both have, `jit` of ours on batch-first arrays against
scipy's method; run time only, the least of many. The allocator is told to keep what is freed, for
both sides alike: by default results above 32 MB come from fresh pages on every call, and faulting
these in takes longer than any of the arithmetic. What then moves much and computes little
(as_matrix, as_mrp, inv) is bound by memory: copying as_matrix's 72 MB alone takes 2.4 ms here.
"""

from __future__ import annotations

import ctypes
import os
import sys

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false " + os.environ.get("XLA_FLAGS", "")
os.environ.setdefault("JAX_ENABLE_X64", "1")
if sys.platform == "linux":  # M_MMAP_MAX, M_TRIM_THRESHOLD, M_ARENA_MAX of glibc's malloc.h
    for option, value in ((-4, 0), (-1, 2**31 - 1), (-8, 1)):
        ctypes.CDLL(None).mallopt(option, value)

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.timing import markdown_table, measure, save
from rbjax.rotations import quaternion, representations

BATCH = 1_000_000


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


def main() -> None:
    rows = []
    for name, ours, arguments, theirs in cases():
        arguments = tuple(jnp.asarray(x) for x in arguments)
        fast = measure(jax.jit(ours), *arguments, budget_s=1.0)
        slow = measure(theirs, budget_s=1.0, jit=False)
        row = {
            "operation": name,
            "rbjax ns": fast["run_min_s"] / BATCH * 1e9,
            "scipy ns": slow["run_min_s"] / BATCH * 1e9,
            "ratio": slow["run_min_s"] / fast["run_min_s"],
            "compile_s": fast["compile_s"],
        }
        rows.append(row)
        print(row, flush=True)
    print(markdown_table(rows, rows[0]))
    print(save("cpu-rotations", rows))


if __name__ == "__main__":
    main()
