"""Forward dynamics, RNEA and CRBA on one CPU core, f64, beside Pinocchio and MuJoCo C.

`python -m benchmarks.cpu_algorithms` pins itself to one core. Ours runs as a user would run it:
`jax.lax.map(f, states, batch_size=128)` under plain jit, the model closed over.
"""

from __future__ import annotations

import benchmarks.one_core  # noqa: F401  isort: skip

import time

import jax
import mujoco
import numpy as np
import pinocchio as pin

import rbjax as rb
from benchmarks.robots import NAMES, compiled, ours, states
from benchmarks.timing import markdown_table, measure, save
from tests.oracles.models import MODELS

BATCH = 4096
ALGORITHMS = {
    "forward dynamics": rb.forward_dynamics,
    "RNEA": rb.inverse_dynamics,
    "CRBA": lambda model, q, v, tau: rb.mass_matrix(model, q),
}


def pinocchio_ns(name: str) -> dict[str, float]:
    """Nanoseconds per evaluation of Pinocchio's own loops, one thread, its own random states."""
    entry = MODELS[NAMES[name]]
    base = pin.JointModelFreeFlyer() if entry.floating_base else None
    path = str(entry.path)
    model = pin.buildModelFromUrdf(path, base) if base else pin.buildModelFromUrdf(path)
    rng = np.random.default_rng(0)
    q = np.array(
        [pin.integrate(model, pin.neutral(model), x) for x in rng.normal(size=(BATCH, model.nv))]
    ).T
    v, tau = rng.normal(size=(2, model.nv, BATCH))
    q, v, tau = (np.asfortranarray(x) for x in (q, v, tau))
    pool = pin.ModelPool(model, 1)
    out = np.zeros_like(v, order="F")
    data = model.createData()
    columns = [np.ascontiguousarray(q[:, i]) for i in range(512)]

    def best(f, count: int) -> float:
        times = []
        for _ in range(15):
            start = time.perf_counter()
            f()
            times.append(time.perf_counter() - start)
        return min(times) / count * 1e9

    def crba(m, d, xs):
        for one in xs:
            pin.crba(m, d, one)

    empty = pin.Model()
    nothing = [np.zeros(0)] * 512
    overhead = best(lambda: crba(empty, empty.createData(), nothing), 512)
    return {
        "forward dynamics": best(lambda: pin.abaInParallel(1, pool, q, v, tau, out), BATCH),
        "RNEA": best(lambda: pin.rneaInParallel(1, pool, q, v, tau, out), BATCH),
        # no batch form: a Python loop, less the same loop on a model with no joints
        "CRBA": best(lambda: crba(model, data, columns), 512) - overhead,
    }


def mujoco_ns(name: str) -> float:
    """mj_forward without constraints, a C call per state from Python."""
    m = compiled(name)
    d = mujoco.MjData(m)
    q, v, tau = states(m, 256)
    times = []
    for _ in range(5):
        start = time.perf_counter()
        for i in range(256):
            d.qpos[:], d.qvel[:], d.qfrc_applied[:] = q[i], v[i], tau[i]
            mujoco.mj_forward(m, d)
        times.append(time.perf_counter() - start)
    return min(times) / 256 * 1e9


def main() -> None:
    rows = []
    for name in ("panda", "g1"):
        peers = pinocchio_ns(name)
        rows.append(
            {"robot": name, "algorithm": "mj_forward", "engine": "MuJoCo C", "ns": mujoco_ns(name)}
        )
        model = ours(name)
        inputs = states(compiled(name), BATCH)
        for algorithm, f in ALGORITHMS.items():
            rows.append(
                {
                    "robot": name,
                    "algorithm": algorithm,
                    "engine": "Pinocchio",
                    "ns": peers[algorithm],
                }
            )
            for dtype in (np.float64, np.float32):

                def mapped(*states, f=f, model=model):
                    return jax.lax.map(lambda one: f(model, *one), states, batch_size=128)

                def timed(size, mapped=mapped, dtype=dtype, inputs=inputs):
                    args = tuple(array[:size].astype(dtype) for array in inputs)
                    row = measure(mapped, *args, budget_s=1.0)
                    return row | {"ns": row["run_min_s"] / size * 1e9}

                # a large batch of large matrices leaves the cache
                row = min((timed(size) for size in (512, BATCH)), key=lambda r: r["ns"])
                ns = row["ns"]
                rows.append(
                    {
                        "robot": name,
                        "algorithm": algorithm,
                        "engine": f"rbjax {np.dtype(dtype).name}",
                        "ns": ns,
                        "compile_s": row["lower_s"] + row["compile_s"],
                        "Pinocchio's time over ours": peers[algorithm] / ns,
                    }
                )
                print(rows[-1], flush=True)
    print(markdown_table(rows, rows[-1]))
    print(save("cpu-algorithms", rows))


if __name__ == "__main__":
    main()
