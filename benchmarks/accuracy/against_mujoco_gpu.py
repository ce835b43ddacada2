"""f32 forward dynamics of rbjax and of MJX against MuJoCo C in f64, model by model.

`python -m benchmarks.accuracy.against_mujoco_gpu --processes 8 --limit 400`: 100 random states of
every loadable model of the test list, with springs, dampers and actuators off. MJX runs on models
of up to 40 velocities. Writes the rows finished after `--limit` seconds to
results/gpu-accuracy-<device>.json.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import multiprocessing
import time

import mujoco
import numpy as np

from benchmarks.shared.timing import markdown_table, save

COUNT = 100
ENGINES, WHAT = ("rbjax", "MJX"), ("median", "max")


def plain(name: str) -> mujoco.MjModel:
    """A model of the test list without constraints, springs, dampers and actuators."""
    from benchmarks.cases.models import MODELS, switch_off_constraints

    m = MODELS[name].load()
    switch_off_constraints(m)
    bits = mujoco.mjtDisableBit
    for bit in (bits.mjDSBL_SPRING, bits.mjDSBL_DAMPER, bits.mjDSBL_ACTUATION):
        m.opt.disableflags |= int(bit)
    return m


def reference(m: mujoco.MjModel) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """States and forces in f32, and MuJoCo C's accelerations of them in f64."""
    from benchmarks.shared.robots import states

    q, v, tau = (x.astype(np.float32) for x in states(m, COUNT))
    data, want = mujoco.MjData(m), []
    for i in range(COUNT):
        data.qpos, data.qvel, data.qfrc_applied = q[i], v[i], tau[i]
        mujoco.mj_forward(m, data)
        want.append(data.qacc.copy())
    return (q, v, tau), np.array(want)


def errors(name: str) -> dict:
    """One model's row."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    import rbjax as rb
    from benchmarks.shared.robots import as_model, relative

    m = plain(name)
    row: dict = {"model": name, "nv": m.nv}
    if not m.nv:
        return row
    given, want = reference(m)
    model = as_model(m)

    def ours(q, v, tau):
        return jax.vmap(rb.forward_dynamics, in_axes=(None, 0, 0, 0))(model, q, v, tau)

    def theirs(q, v, tau):
        mx, blank = mjx.put_model(m), mjx.make_data(m)

        def one(q, v, tau):
            return mjx.forward(mx, blank.replace(qpos=q, qvel=v, qfrc_applied=tau)).qacc

        return jax.vmap(one)(q, v, tau)

    for engine, f in zip(ENGINES, (ours, theirs), strict=True):
        if engine == "MJX" and m.nv > 40:
            continue
        try:
            got = jax.jit(f)(*(jnp.asarray(x) for x in given))
            error = relative(got, want)
            row |= {f"{engine} median": float(np.median(error)), f"{engine} max": error.max()}
        except Exception as error:  # MJX refuses some
            row[f"{engine} note"] = f"{type(error).__name__}: {str(error)[:80]}"
    jax.clear_caches()
    return row


def main() -> None:
    from benchmarks.cases.models import MODELS, SINGULAR

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--processes", type=int, default=8)
    parser.add_argument("--limit", type=float, default=400.0)
    opts = parser.parse_args()
    deadline = time.monotonic() + opts.limit
    pool = concurrent.futures.ProcessPoolExecutor(
        opts.processes, mp_context=multiprocessing.get_context("spawn")
    )
    jobs = {pool.submit(errors, name): name for name in MODELS if name not in SINGULAR}
    rows, failed = [], {}
    try:
        for job in concurrent.futures.as_completed(jobs, timeout=deadline - time.monotonic()):
            try:
                rows.append(job.result())
            except Exception as error:  # a model that fails is a row, not the end
                failed[jobs[job]] = repr(error)[:150]
    except TimeoutError:
        print("out of time; left:", sorted(name for job, name in jobs.items() if not job.done()))
    rows = [row for row in rows if row["nv"]]
    report(rows, failed)
    for process in list((pool._processes or {}).values()):
        process.kill()


def report(rows: list[dict], failed: dict) -> None:
    """Save, and print the comparison."""
    rows.sort(key=lambda row: -row.get("rbjax max", np.inf))
    rows += [{"model": k, "note": v} for k, v in failed.items()]
    save("gpu-accuracy", rows)
    print(markdown_table(rows, ("model", "nv", *(f"{e} {w}" for e in ENGINES for w in WHAT))))
    both = [row for row in rows if "MJX median" in row and "rbjax median" in row]
    for what in WHAT:
        better = sum(row[f"rbjax {what}"] <= row[f"MJX {what}"] for row in both)
        worse = [row["model"] for row in both if row[f"rbjax {what}"] > row[f"MJX {what}"]]
        print(f"{what}: rbjax no worse than MJX on {better} of {len(both)}; worse on {worse}")
    got = [row for row in rows if "rbjax median" in row]
    over = [row["model"] for row in got if row["rbjax median"] > 5e-6 or row["rbjax max"] > 1e-4]
    print(f"{len(got)} models; over 5e-6 median or 1e-4 max: {over}; failed: {failed}")


if __name__ == "__main__":
    main()
