"""Forward dynamics, RNEA and CRBA on one CPU core, f64, against Pinocchio and MuJoCo C.

`python -m benchmarks.cpu.algorithms` pins itself to one core. rbjax runs as a user would run it:
`jax.vmap` under plain jit, with the model closed over. G1 is rolled by default, and also unrolled.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # noqa: F401  isort: skip

import jax
import mujoco
import numpy as np
import pinocchio as pin

import rbjax as rb
from benchmarks.shared.robots import NAMES, compiled, ours, states
from benchmarks.shared.timing import fastest_ns, markdown_table, measure, save
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

    def crba(m, d, xs):
        for one in xs:
            pin.crba(m, d, one)

    empty = pin.Model()
    nothing = [np.zeros(0)] * 512
    overhead = fastest_ns(lambda: crba(empty, empty.createData(), nothing), 512)
    return {
        "forward dynamics": fastest_ns(lambda: pin.abaInParallel(1, pool, q, v, tau, out), BATCH),
        "RNEA": fastest_ns(lambda: pin.rneaInParallel(1, pool, q, v, tau, out), BATCH),
        # no batch form: a Python loop, minus the same loop on a model without joints
        "CRBA": fastest_ns(lambda: crba(model, data, columns), 512) - overhead,
    }


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


def ours_timed(f, model, inputs, dtype, size: int) -> dict:
    """Nanoseconds per evaluation of ours at one batch."""
    args = tuple(array[:size].astype(dtype) for array in inputs)
    row = measure(jax.vmap(lambda *one: f(model, *one)), *args, budget_s=1.0)
    return {
        "engine": f"rbjax {np.dtype(dtype).name}",
        "batch": size,
        "ns": row["run_min_s"] / size * 1e9,
        "compile_s": row["lower_s"] + row["compile_s"],
    }


def main() -> None:
    rows: list[dict] = []
    for name in ("panda", "g1"):
        peers = pinocchio_ns(name)
        rows.append(
            {"robot": name, "algorithm": "mj_forward", "engine": "MuJoCo C", "ns": mujoco_ns(name)}
        )
        rows += [
            {"robot": name, "algorithm": a, "engine": "Pinocchio", "ns": ns}
            for a, ns in peers.items()
        ]
        inputs = states(compiled(name), BATCH)
        for driver in ("auto", "unrolled") if name == "g1" else ("auto",):
            model = ours(name).replace(driver=driver)
            for algorithm, f in ALGORITHMS.items():
                for dtype in (np.float64, np.float32):
                    # a large batch of large matrices leaves the cache
                    timed = [ours_timed(f, model, inputs, dtype, size) for size in (512, BATCH)]
                    row = min(timed, key=lambda row: row["ns"])
                    row = {"robot": name, "algorithm": algorithm, "driver": driver} | row
                    row["Pinocchio's time over ours"] = peers[algorithm] / row["ns"]
                    row["at the larger batch"] = timed[1]["ns"]
                    rows.append(row)
                    print(row, flush=True)
    print(markdown_table(rows, rows[-1]))
    print(save("cpu-algorithms", rows))


if __name__ == "__main__":
    main()
