"""Comparison of contacts, limits, friction loss and equalities with MuJoCo C.

The states are those of MuJoCo's own motion from the first keyframe of the file, or its default
configuration, with constant random controls. At each of them both engines solve the contact problem
and make one step.
"""

from __future__ import annotations

import copy
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rbjax.contact.contact_solution import solve
from rbjax.loading import compile_model, load
from rbjax.loading.mjcf.cables import switch_off_cables
from rbjax.loading.mjcf.contact_pairs import contact_pairs
from rbjax.loading.mjcf.contacts import closed_pairs
from rbjax.loading.mjcf.fields import reason_left_out
from rbjax.model import Model, State
from rbjax.model.record import cast_floats
from rbjax.motion.step import step
from rbjax.validation.ours import quick
from rbjax.validation.reference import Array, StateSamples, loosen, random_samples

#: tolerances of all quantities; the f32 forces of a stiff contact follow from rounded positions
TOLERANCES = {"rbjax f64": 1e-10, "rbjax f32": 2e-2}
#: least size of the quantities of a state, to which errors are relative: robots at rest have none
FLOOR = 1.0
#: iterations and tolerance of MuJoCo's line search, which make its solution exact
_STEPS, _SLOPE = 200, 1e-10


def with_contacts(
    source: Any, *, floating_base: bool = False
) -> tuple[mujoco.MjModel, Model, tuple[str, ...]]:
    """Return a file in both engines with its contacts, and the features that are disabled in both.

    Geoms of pairs without a closed form do not touch. MuJoCo's solver runs to convergence.
    """
    m = copy.copy(compile_model(source, floating_base=floating_base))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the features that are left out are in the report
        off = (*switch_off_cables(m), *load(m, contacts=True).dropped)
        pairs, closed = contact_pairs(m), set(closed_pairs(m))
        for k, pair in enumerate(pairs):
            if k not in closed:
                m.geom_contype[list(pair)] = m.geom_conaffinity[list(pair)] = 0
        for i in range(m.nactuator):
            if reason_left_out(m, i):
                loosen(m, i)
        m.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        m.opt.tolerance, m.opt.ls_tolerance = 0.0, _SLOPE
        m.opt.iterations = m.opt.ls_iterations = _STEPS
        return m, load(m, contacts=True), off


def states_of_motion(m: mujoco.MjModel, count: int, seed: int, seconds: float) -> StateSamples:
    """Simulate by MuJoCo and return states at even times, all exact in f32."""
    data, drawn = mujoco.MjData(m), random_samples(m, 1, seed)
    if m.nkey:
        mujoco.mj_resetDataKeyframe(m, data, 0)
    data.ctrl, found = drawn.ctrl[0], []
    data.qvel += 0.1 * drawn.v[0]
    every = max(1, round(seconds / m.opt.timestep / count))
    for _ in range(count):
        for _ in range(every):
            mujoco.mj_step(m, data)
        found.append((data.qpos.copy(), data.qvel.copy(), drawn.ctrl[0]))
    rows = (np.stack(x) for x in zip(*found, strict=True))
    return StateSamples(*(x.astype(np.float32).astype(np.float64) for x in rows))


def reference_quantities(
    m: mujoco.MjModel, pairs: tuple[tuple[int, int], ...], samples: StateSamples
) -> dict[str, Array]:
    """Compute the quantities of MuJoCo at each state."""
    data, rows, place = mujoco.MjData(m), [], {pair: k for k, pair in enumerate(pairs)}
    for q, v, ctrl in zip(samples.q, samples.v, samples.ctrl, strict=True):
        mujoco.mj_resetData(m, data)
        data.qpos, data.qvel, data.ctrl = q, v, ctrl
        mujoco.mj_forward(m, data)
        counts, forces = np.zeros(len(pairs)), np.zeros((len(pairs), 3))
        for i, contact in enumerate(data.contact):
            k, own = place[tuple(contact.geom.tolist())], np.zeros(6)
            mujoco.mj_contactForce(m, data, i, own)
            counts[k] += 1
            forces[k] += contact.frame.reshape(3, 3).T @ own[:3]
        row = {"contacts": counts, "forward dynamics": data.qacc.copy()}
        row |= {"constraint forces": data.qfrc_constraint.copy(), "contact forces": forces}
        mujoco.mj_step(m, data)
        rows.append(row | {"one step": np.concatenate([data.qpos, data.qvel])})
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def quantities(
    model: Model, pairs: tuple[tuple[int, int], ...], samples: StateSamples, dtype: Any
) -> tuple[dict[str, Array], str]:
    """Compute the quantities of rbjax in a dtype, one row a state, and a report of the solver."""

    def one(q: jax.Array, v: jax.Array, ctrl: jax.Array) -> tuple[dict[str, jax.Array], Any]:
        state, u = State(q, v), ctrl if model.nu else None
        found, after = solve(model, state, u), step(model, state, u)
        own = found.contacts
        of_pair = np.array([[x == pair for x in own.geoms] for pair in pairs], bool)
        of_pair = of_pair.reshape(len(pairs), len(own.geoms))
        return {
            "contacts": (of_pair & own.exists).sum(-1),
            "forward dynamics": found.acceleration,
            "constraint forces": found.constraint,
            "contact forces": jnp.where(of_pair[:, :, None], own.world_force, 0.0).sum(1),
            "one step": jnp.concatenate([after.q, after.v]),
        }, (found.iterations, found.success)

    model, q, v, ctrl = cast_floats((model, samples.q, samples.v, samples.ctrl), dtype)
    run = jax.jit(jax.vmap(one), compiler_options=quick())
    out, (iterations, converged) = run(q, v, ctrl)
    name = "f64" if dtype == np.float64 else "f32"
    report = f"{int(iterations.max())} Newton steps or fewer in {name}"
    if lost := int((~converged).sum()):
        report += f", {lost} of {len(converged)} states not converged"
    return {name: np.asarray(x, np.float64) for name, x in out.items()}, report
