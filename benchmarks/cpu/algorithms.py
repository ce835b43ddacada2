"""Forward dynamics, RNEA and CRBA on one CPU core, f64, against Pinocchio and MuJoCo C.

`python -m benchmarks.cpu.algorithms` pins itself to one core. rbjax runs as a user would run it:
`jax.vmap` under plain jit, with the model closed over. Pinocchio and rbjax take turns of a
millisecond or less, and the best of each counts, so that other processes disturb neither.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # noqa: F401  isort: skip

import time
from collections.abc import Callable

import jax
import mujoco
import numpy as np
import pinocchio as pin

import rbjax as rb
from benchmarks.cases.models import MODELS
from benchmarks.shared.progress import progress
from benchmarks.shared.robots import NAMES, compiled, ours, states
from benchmarks.shared.timing import fastest_ns, markdown_table, others, save

SIZES = 512, 4096
TURNS, SECONDS = 20, 2.5
ALGORITHMS = {
    "forward dynamics": rb.forward_dynamics,
    "RNEA": rb.inverse_dynamics,
    "CRBA": lambda model, q, v, tau: rb.mass_matrix(model, q),
}


def pinocchio(name: str) -> dict[str, list[Callable[[], object]]]:
    """Pinocchio's own loops, one thread, over random states of its own; and what to subtract."""
    entry = MODELS[NAMES[name]]
    base = pin.JointModelFreeFlyer() if entry.floating_base else None
    path = str(entry.path)
    model = pin.buildModelFromUrdf(path, base) if base else pin.buildModelFromUrdf(path)
    rng, count = np.random.default_rng(0), SIZES[0]
    q = np.array(
        [pin.integrate(model, pin.neutral(model), x) for x in rng.normal(size=(count, model.nv))]
    ).T
    v, tau = rng.normal(size=(2, model.nv, count))
    q, v, tau = (np.asfortranarray(x) for x in (q, v, tau))
    pool = pin.ModelPool(model, 1)
    out = np.zeros_like(v, order="F")
    data = model.createData()
    columns = [np.ascontiguousarray(x) for x in q.T]

    def crba(m, d, xs):
        for one in xs:
            pin.crba(m, d, one)

    empty = pin.Model()
    nothing, no_data = [np.zeros(0)] * count, empty.createData()
    return {
        "forward dynamics": [lambda: pin.abaInParallel(1, pool, q, v, tau, out)],
        "RNEA": [lambda: pin.rneaInParallel(1, pool, q, v, tau, out)],
        # no batch form: a Python loop, minus the same loop on a model without joints
        "CRBA": [lambda: crba(model, data, columns), lambda: crba(empty, no_data, nothing)],
    }


def by_turns(fs: list[Callable[[], object]]) -> list[float]:
    """The best seconds of each."""
    best = [np.inf] * len(fs)
    end, turns = time.perf_counter() + SECONDS, 0
    while turns < TURNS or time.perf_counter() < end:
        for k, f in enumerate(fs):
            start = time.perf_counter()
            f()
            best[k] = min(best[k], time.perf_counter() - start)
        turns += 1
    return best


def mujoco_ns(name: str) -> float:
    """mj_forward without constraints, a C call per state from Python."""
    m = compiled(name)
    d = mujoco.MjData(m)
    q, v, tau = states(m, 256)

    def forward() -> None:
        for i in range(256):
            d.qpos[:], d.qvel[:], d.qfrc_applied[:] = q[i], v[i], tau[i]
            mujoco.mj_forward(m, d)

    return fastest_ns(forward, 256, runs=5)


def beside(peer: list[Callable[[], object]], f, model, inputs, dtype) -> dict:
    """Nanoseconds per evaluation of ours, at its better batch, and of the peer."""
    runs, compile_s = [], 0.0
    for size in SIZES:
        args = tuple(array[:size].astype(dtype) for array in inputs)
        jitted = jax.jit(jax.vmap(lambda *one: f(model, *one)))
        start = time.process_time()
        jax.block_until_ready(jitted(*args))
        compile_s = time.process_time() - start
        runs.append(lambda jitted=jitted, args=args: jax.block_until_ready(jitted(*args)))
    *ours, whole, empty = by_turns([*runs, *peer, *([lambda: None] if len(peer) == 1 else [])])
    each = [seconds / size * 1e9 for seconds, size in zip(ours, SIZES, strict=True)]
    theirs = (whole - empty) / SIZES[0] * 1e9
    return {
        "engine": f"rbjax {np.dtype(dtype).name}", "batch": SIZES[int(np.argmin(each))],
        "ns": min(each), "compile_s": compile_s, "Pinocchio's ns": theirs,
        "Pinocchio's time over ours": theirs / min(each), "at the larger batch": each[-1],
    }  # fmt: skip


def main() -> None:
    rows: list[dict] = []
    for dtype in (np.float64, np.float32):
        for name in ("panda", "g1"):
            inputs, peers = states(compiled(name), max(SIZES)), pinocchio(name)
            if dtype is np.float64:
                one = {"robot": name, "algorithm": "mj_forward", "engine": "MuJoCo C"}
                rows.append(one | {"ns": mujoco_ns(name)})
            for driver in ("auto", "unrolled") if name == "g1" else ("auto",):
                model = ours(name).replace(driver=driver)
                for algorithm, f in progress(ALGORITHMS.items(), lambda x: x[0]):
                    row = {"robot": name, "algorithm": algorithm, "driver": driver}
                    rows.append(row | beside(peers[algorithm], f, model, inputs, dtype))
                    print(rows[-1], flush=True)
        kept = others("cpu-algorithms", rows, ("robot", "algorithm", "driver", "engine"))
        path = save("cpu-algorithms", [*(x for x in kept if x["engine"] != "Pinocchio"), *rows])
    print(markdown_table(rows, rows[-1]))
    print(path)


if __name__ == "__main__":
    main()
