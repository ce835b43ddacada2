"""Relative errors of rbjax and MJX against MuJoCo C (f64) over the whole test list, f64 and f32.

`python -m benchmarks.accuracy.against_mujoco [--full] [--only WORD]`: 100 random states of every
loadable model and of 50 random trees with --full, else of every eighth, and of the robots of the
figures. With --only it renews the models whose names have WORD, and keeps the rows of an older run
for the others. FK, mass matrix, bias and forward dynamics. An error is max |ours - theirs| / max
|theirs| of one state; the tables give the largest over quantities and states (f64), and the median
and largest (f32). For the robots of the figures they also show MJX's f32 forward dynamics.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("JAX_ENABLE_X64", "1")

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

import rbjax as rb
from benchmarks.cases.models import MODELS, SINGULAR, switch_off_constraints
from benchmarks.cases.random_trees import random_tree
from benchmarks.shared.progress import add_full, progress, sized
from benchmarks.shared.robots import NAMES, states
from benchmarks.shared.timing import markdown_table, others, save

COUNT = 100
QUANTITIES = ("position", "attitude", "mass matrix", "bias", "forward dynamics")


def reference(m: mujoco.MjModel, q, v, tau) -> list[np.ndarray]:
    """The results of MuJoCo C, one row a state."""
    d = mujoco.MjData(m)
    rows = []
    for i in range(len(q)):
        d.qpos[:], d.qvel[:], d.qfrc_applied[:] = q[i], v[i], tau[i]
        mujoco.mj_forward(m, d)
        M = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, d, M)
        rows.append([d.xpos[1:].copy(), d.xmat[1:].copy(), M, d.qfrc_bias.copy(), d.qacc.copy()])
    return [np.array(x).reshape(len(q), -1) for x in zip(*rows, strict=True)]


@jax.jit
def ours(model, q, v, tau):
    """The same of rbjax."""

    def one(x):
        q, v, tau = x
        poses = rb.forward_kinematics(model, q)
        out = (
            poses.p, poses.R, rb.mass_matrix(model, q), rb.bias_forces(model, q, v),
            rb.forward_dynamics(model, q, v, tau),
        )  # fmt: skip
        return tuple(a.reshape(-1) for a in out)

    return jax.lax.map(one, (q, v, tau), batch_size=COUNT)


def errors(mine, theirs) -> np.ndarray:
    """(quantities, states)."""
    out = []
    for a, b in zip(mine, theirs, strict=True):
        scale = np.abs(b).max(-1, initial=1e-300)
        out.append(np.abs(np.asarray(a, np.float64) - b).max(-1, initial=0.0) / scale)
    return np.array(out)


def mjx_errors(m: mujoco.MjModel, q, v, tau, qacc) -> np.ndarray:
    """MJX's forward dynamics in f32, (states,)."""
    m.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    m.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    with jax.enable_x64(False):
        mx, data = mjx.put_model(m), mjx.make_data(m)

        def one(x):
            q, v, tau = x
            return mjx.forward(mx, data.replace(qpos=q, qvel=v, qfrc_applied=tau)).qacc

        out = jax.jit(jax.vmap(one))(tuple(jnp.asarray(x, jnp.float32) for x in (q, v, tau)))
        return errors([out], [qacc])[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add_full(parser, "all models", "an eighth of them")
    parser.add_argument("--only", default="", help="a word in the names of the models to renew")
    given = parser.parse_args()
    full = given.full
    sources = {name: entry.load for name, entry in MODELS.items() if name not in SINGULAR}
    for seed in range(50):
        sources[f"random tree {seed}"] = lambda s=seed: mujoco.MjModel.from_xml_string(
            random_tree(s)
        )
    if not full:
        some = {*[*sources][::8], *NAMES.values()}
        sources = {name: load for name, load in sources.items() if name in some}
    sources = {name: load for name, load in sources.items() if given.only in name}
    if not sources:
        parser.error(f"no model has {given.only!r} in its name")
    rows = []
    for name in progress(sources):
        m = sources[name]()
        switch_off_constraints(m)
        m.opt.disableflags |= int(
            mujoco.mjtDisableBit.mjDSBL_SPRING | mujoco.mjtDisableBit.mjDSBL_DAMPER
        )
        m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        if not m.nv:
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = rb.load(m)
        q, v, tau = states(m, COUNT)
        theirs = reference(m, q, v, tau)
        double = errors(ours(model, q, v, tau), theirs)
        single = errors(ours(model, *(x.astype(np.float32) for x in (q, v, tau))), theirs)
        row = {
            "model": name,
            "nv": m.nv,
            "f64 max": double.max(),
            "f64 worst": QUANTITIES[double.max(1).argmax()],
        }
        row |= {"f32 median": float(np.median(single)), "f32 max": single.max()}
        row |= {"f32 FD median": float(np.median(single[-1])), "f32 FD max": single[-1].max()}
        row["condition"] = float(
            np.median([np.linalg.cond(M.reshape(m.nv, -1)) for M in theirs[2]])
        )
        if name in NAMES.values():
            peer = mjx_errors(m, q, v, tau, theirs[-1])
            row |= {"MJX f32 FD median": float(np.median(peer)), "MJX f32 FD max": peer.max()}
        rows.append({k: float(x) if isinstance(x, np.floating) else x for k, x in row.items()})
        jax.clear_caches()
    columns = [*rows[0], "MJX f32 FD median", "MJX f32 FD max"]
    rows.sort(key=lambda r: -r["f64 max"])
    print(markdown_table(rows[:12], dict.fromkeys(columns)))
    worst = max(r["f64 max"] for r in rows)
    over = {
        "f64 over 1e-10": [r["model"] for r in rows if r["f64 max"] > 1e-10],
        "f32 median over 5e-6": [r["model"] for r in rows if r["f32 median"] > 5e-6],
        "f32 max over 1e-4": [r["model"] for r in rows if r["f32 max"] > 1e-4],
    }
    middle = float(np.median([r["f32 median"] for r in rows]))
    print(f"{len(rows)} models, f64 max {worst:.1e}, median of f32 medians {middle:.1e}", over)
    name = sized("accuracy", full)
    print(save(name, rows + (others(name, rows, ["model"]) if given.only else [])))


if __name__ == "__main__":
    main()
