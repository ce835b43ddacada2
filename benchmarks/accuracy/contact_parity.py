"""Accelerations with contacts against MuJoCo C at tolerance 0, f64, entry by entry.

    python -m benchmarks.accuracy.contact_parity [cube humanoid humanoid_feet FILE.xml ...]

An error is |ours - theirs| / (1 + |theirs|), of the largest entries of a state ("whole") or entry
by entry. The change of both engines by a rounding of q, v and ctrl shows the attainable error;
states at which MuJoCo changes by more than 1e-6, where a row starts or ends, are left out. The
corrected acceleration a + H^-1 (tau + J^T f - M a - b) has M a from the inverse dynamics, where the
solver sums the changes of M a over its steps.
"""

from __future__ import annotations

import os

os.environ.setdefault("JAX_ENABLE_X64", "1")

import sys
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from benchmarks.cases.standing import on_floor, random_controls
from benchmarks.shared.timing import markdown_table, save
from rbjax.contact.problem.assemble import Assembly
from rbjax.contact.soft import SoftContact, detected
from rbjax.contact.solver.linear_solution import linear_solver
from rbjax.contact.solver.newton import solve
from rbjax.forces.inputs import Inputs
from rbjax.lanes import pack
from rbjax.motion.field import Field

#: a light cube on a stiff floor, which slides and tips
CUBE = """<mujoco><option cone="elliptic" impratio="10"/>
  <default><geom solref=".01" solimp=".99 .995 .01"/></default><worldbody>
  <geom type="plane" size="0 0 1"/><body pos=".5 .3 .05" quat=".9 .2 .1 .3"><freejoint/>
  <geom type="box" size=".02 .02 .03" mass=".1"/></body></worldbody></mujoco>"""
STEPS, TRIALS = 1000, 6


def reference(name: str) -> mujoco.MjModel:
    m = mujoco.MjModel.from_xml_string(CUBE) if name == "cube" else on_floor(name)
    m.opt.tolerance, m.opt.ls_tolerance = 0, 1e-12
    m.opt.iterations, m.opt.ls_iterations = 300, 200
    return m


def trajectory(m: mujoco.MjModel) -> list[np.ndarray]:
    """q, v, act, ctrl and the acceleration at each step under random controls."""
    d, rng, rows = mujoco.MjData(m), np.random.default_rng(0), []
    if m.nkey:
        mujoco.mj_resetDataKeyframe(m, d, 0)
    d.qvel[:] = 0.1 * rng.standard_normal(m.nv)
    for k in range(STEPS):
        if k % 20 == 0:
            d.ctrl[:] = random_controls(m, rng, 1)[0]
        mujoco.mj_forward(m, d)
        rows.append([x.copy() for x in (d.qpos, d.qvel, d.act, d.ctrl, d.qacc)])
        mujoco.mj_step(m, d)
    return [np.stack(x) for x in zip(*rows, strict=True)]


def program(model: rb.Model) -> Any:
    """The acceleration of a batch of states, as solved and corrected."""
    field = Field(model, SoftContact())

    def one(q: jax.Array, v: jax.Array, x: jax.Array, u: jax.Array) -> tuple:
        state = rb.State(q, v, x) if x.size else rb.State(q, v)
        tau, f_ext, _ = field.applied(0.0, state, Inputs(ctrl=u))
        problem = detected(model, q, v, tau, f_ext)
        found, assembly = solve(problem), Assembly(model, q, v, iterative=True)
        forces = pack(problem.constraint_forces(found.x, problem.in_use), tau)
        left = tau + forces - assembly.inverse_dynamics(found.x, f_ext)
        return found.x, found.x + linear_solver(problem, found)(left)

    return jax.jit(jax.vmap(rb.threads(one)))


def row_of(name: str) -> dict[str, Any]:
    m = reference(name)
    *given, theirs = trajectory(m)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ours = program(rb.load(m, contacts=True))
    found, corrected = map(np.asarray, ours(*map(jnp.asarray, given)))
    entry, better = (np.abs(x - theirs) / (1 + np.abs(theirs)) for x in (found, corrected))
    whole = np.abs(found - theirs).max(1) / (1 + np.abs(theirs).max(1))

    d, rng, changed = mujoco.MjData(m), np.random.default_rng(0), []
    for _ in range(TRIALS):
        q, v, x, u = given
        q, v, u = (y + np.spacing(y) * rng.integers(-1, 2, y.shape) for y in (q, v, u))
        a = np.asarray(ours(*map(jnp.asarray, (q, v, x, u)))[0]), np.zeros_like(theirs)
        for k in range(STEPS):
            mujoco.mj_resetData(m, d)
            d.qpos[:], d.qvel[:], d.act[:], d.ctrl[:] = q[k], v[k], x[k], u[k]
            d.qacc_warmstart[:] = theirs[k]
            mujoco.mj_forward(m, d)
            a[1][k] = d.qacc
        changed.append([np.abs(y - z) for y, z in zip(a, (found, theirs), strict=True)])
    by_rounding = np.max(changed, 0) / (1 + np.abs(theirs))
    smooth = by_rounding[1].max(1) < 1e-6
    whole, entry, better = (y[smooth] for y in (whole, entry, better))
    mine, own = (y[smooth].max() for y in by_rounding)
    return {
        "robot": Path(name).stem, "states": int(smooth.sum()), "whole": whole.max(),
        "entry": entry.max(), "dof": int(entry.max(0).argmax()), "entry, corrected": better.max(),
        "MuJoCo, by a rounding": own, "rbjax, by a rounding": mine,
    }  # fmt: skip


if __name__ == "__main__":
    rows = [row_of(name) for name in sys.argv[1:] or ("cube", "humanoid", "humanoid_feet")]
    print(markdown_table(rows, tuple(rows[0])))
    save("contact-parity", rows)
