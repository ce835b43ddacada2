"""The scenes of the speed-accuracy charts: robots, a sample of starts, and their ends.

Every engine gets the same MjModel: only smooth dynamics (no contacts, limits, friction), and no
geoms, which would cost time in MJX and MuJoCo but not in rbjax. Controls are constant.

The distance of two states, in radians and metres, relative where the state is large:

    max( |q - q*| / max(1, |positions of q*|), |v - v*| / max(1, |v*|) )

with q - q* taken on the manifold and | | the largest entry; the error of a batch is the largest
distance over the sample.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.special import ellipj, ellipkinc

import rbjax as rb
from benchmarks.shared.robots import as_model
from rbjax.validation.reference import smooth

FOLDER = Path(rb.loading.__file__).parent / "scenes"
SAMPLE = 32
Array = np.ndarray


@dataclass(frozen=True)
class Scene:
    """A robot, seconds to simulate, a keyframe near which to start, and the spread around it."""

    title: str
    source: str
    seconds: float
    keyframe: str | None
    spread: float
    stiff: bool = False


def chain(stiffness: float, damping: float, links: int = 6) -> str:
    """A hanging rod of `links` links of 0.15 m and 0.1 kg: the first swings freely, the others are
    held straight by springs."""

    def body(k: int) -> str:
        if k == links:
            return ""
        held = f'stiffness="{stiffness!r}" damping="{damping!r}"' if k else ""
        return (
            f'<body pos="0 0 {-0.15 if k else 0}"><joint axis="0 1 0" {held}/>'
            '<inertial pos="0 0 -0.075" mass="0.1" diaginertia="2e-4 2e-4 2e-5"/>'
            f"{body(k + 1)}</body>"
        )

    return f"<mujoco><worldbody>{body(0)}</worldbody></mujoco>"


SCENES = {
    "pendulum": Scene("pendulum", "pendulum", 2.0, None, 1.0),
    "double_pendulum": Scene("double pendulum", "double_pendulum", 2.0, "swing", 0.3),
    "arm7": Scene("7-joint arm with servos", "arm7", 0.2, "home", 1.0),
    "humanoid": Scene("humanoid in flight", "humanoid", 0.5, "squat", 0.5),
    "spinning_top": Scene("heavy top, 100 rad/s", "spinning_top", 0.5, "spinning", 0.5),
    "chain": Scene("stiff spring chain", chain(500.0, 0.5), 1.0, None, 0.3, True),
    "quadrotor": Scene("quadrotor", "quadrotor", 1.0, "hover", 1.0),
    "free_body": Scene("free tumbling body", "free_body", 2.0, "flip", 0.5),
}


def bare(source: str) -> mujoco.MjModel:
    """The smooth dynamics of a scene, inertias written out, no geoms."""
    if source.startswith("<"):
        m = mujoco.MjModel.from_xml_string(source)
    else:
        spec = mujoco.MjSpec.from_file(str(FOLDER / f"{source}.xml"))
        whole = spec.compile()
        for body in spec.bodies[1:]:
            i = whole.body(body.name).id
            body.ipos, body.iquat = whole.body_ipos[i], whole.body_iquat[i]
            body.mass, body.inertia = whole.body_mass[i], whole.body_inertia[i]
            body.explicitinertial = True
        for thing in (*spec.geoms, *spec.lights, *spec.cameras, *spec.materials, *spec.textures):
            spec.delete(thing)
        m = spec.compile()
    m = smooth(m)[0]
    m.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    m.opt.iterations = m.opt.ls_iterations = 1
    if source == "pendulum":  # without damping it has a closed form
        m.dof_damping[:] = 0
    return m


@functools.cache
def prepared(
    name: str, precision: str = "f64"
) -> tuple[mujoco.MjModel, rb.Model, Array, Array, Array]:
    """MjModel, Model (in the current precision), starts q (SAMPLE, nq) and v, controls (nu,)."""
    scene = SCENES[name]
    m = bare(scene.source)
    model = as_model(m)
    rng = np.random.default_rng(0)
    q0, v0, ctrl = m.qpos0, np.zeros(m.nv), np.zeros(m.nu)
    if scene.keyframe is not None:
        key = m.key(scene.keyframe)
        q0, v0, ctrl = key.qpos, key.qvel, key.ctrl
    dq = 0.3 * scene.spread * rng.normal(size=(SAMPLE, m.nv))
    q = np.empty((SAMPLE, m.nq))
    for row, d in zip(q, dq, strict=True):
        row[:] = q0
        mujoco.mj_integratePos(m, row, d, 1.0)
    v = v0 + scene.spread * rng.normal(size=(SAMPLE, m.nv))
    return m, model, q, v, ctrl


def reference(name: str) -> tuple[Array, Array, float]:
    """The end of the sample, q and v, and a bound of its error."""
    m, model, q, v, ctrl = prepared(name)
    seconds, size = SCENES[name].seconds, 64
    ctrls = jnp.broadcast_to(jnp.asarray(ctrl), (size, m.nu))

    @jax.jit
    def some(state, dt):
        path = rb.rollout(
            model, state, ctrls, dt, integrator="dopri8", save_every=size, kernel=False
        )
        return path.state(-1)

    def end(chunks):
        state = rb.State(jnp.asarray(q), jnp.asarray(v))
        for _ in range(chunks):
            state = some(state, seconds / (chunks * size))
        return np.asarray(state.q), np.asarray(state.v)

    chunks, before = 4, end(2)
    while True:
        now = end(chunks)
        bound = distance(model, before, now)
        if bound < 1e-11 or chunks > 512:
            break
        chunks, before = 2 * chunks, now
    if name == "pendulum":
        exact = pendulum(m, q, v, seconds)
        bound, now = distance(model, now, exact), exact
    if name == "free_body":
        bound = max(bound, free_body_error(m, (q, v), now, seconds))
    return *now, bound


def reference_by_cpu(name: str) -> tuple[Array, Array, float]:
    """The same from its own process, for a caller whose arrays are on an accelerator."""
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/end.npz"
        here = {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_X64": "1"}
        command = [sys.executable, "-m", "benchmarks.work.scenes", name, path]
        subprocess.run(command, check=True, env=os.environ | here)
        with np.load(path) as end:
            return end["q"], end["v"], float(end["bound"])


def distance(model: rb.Model, state: Any, exact: Any) -> float:
    """The largest distance over the sample, in f64; infinite if a state is not finite."""
    (q, v), (q1, v1) = ([np.asarray(x, np.float64) for x in pair] for pair in (state, exact))
    if not (np.isfinite(q).all() and np.isfinite(v).all()):
        return float("inf")
    with jax.enable_x64(True):
        dq = np.abs(_differences(model, jnp.asarray(q1), jnp.asarray(q)))
    straight = np.ones(model.nq, bool)
    for start in model.topology.quaternion_starts:
        straight[start : start + 4] = False
    turns = [i for s in model.topology.turn_starts for i in range(s, s + 3)]
    size = np.maximum(1.0, np.abs(q1[:, straight]).max(-1, initial=0.0))
    if turns:  # angles of attitudes are at most pi: not relative
        rest = np.delete(dq, turns, -1).max(-1, initial=0.0) / size
        first = np.maximum(rest, dq[:, turns].max(-1))
    else:
        first = dq.max(-1) / size
    second = np.abs(v - v1).max(-1) / np.maximum(1.0, np.abs(v1).max(-1))
    return float(np.maximum(first, second).max())


_differences = jax.jit(jax.vmap(rb.difference, (None, 0, 0)))


def pendulum(m: mujoco.MjModel, q: Array, v: Array, t: float) -> tuple[Array, Array]:
    """sin(q/2) = k sn(w t + u0 | k^2) of an undamped pendulum that swings, k^2 = energy."""
    mass, arm = m.body_mass[1], -m.body_ipos[1, 2]
    inertia = m.body_inertia[1, 1] + mass * arm**2 + m.dof_armature[0]
    w = np.sqrt(mass * -m.opt.gravity[2] * arm / inertia)
    k2 = np.sin(q / 2) ** 2 + (v / (2 * w)) ** 2
    assert (k2 < 1).all(), "one of them goes round"
    k = np.sqrt(k2)
    phase = np.arctan2(np.sin(q / 2), v / (2 * w))  # sn = sin phase, cn = cos phase
    sn, cn, _, _ = ellipj(w * t + ellipkinc(phase, k2), k2)
    return 2 * np.arcsin(k * sn), 2 * w * k * cn


def free_body_error(m: mujoco.MjModel, start: Any, end: Any, t: float) -> float:
    """The error of torque-free motion, from Euler's closed form of the angular velocity (Landau &
    Lifshitz, *Mechanics*, 37) and the conserved angular momentum. These leave only a rotation about
    the momentum free."""
    I = np.asarray(m.body_inertia[1])
    w0, w1 = start[1][:, 3:], end[1][:, 3:]
    H0, H1 = (_rotated(q[:, 3:7], I * w) for q, w in ((start[0], w0), (end[0], w1)))
    momentum = np.abs(H1 - H0).max(-1) / np.abs(H0).max(-1)
    speed = [np.abs(_euler(I, a, t) - b).max() for a, b in zip(w0, w1, strict=True)]
    return float(max(momentum.max(), np.max(speed)))


def _rotated(q: Array, x: Array) -> Array:
    w, u = q[:, :1], q[:, 1:]
    t = 2 * np.cross(u, x)
    return x + w * t + np.cross(u, t)


def _euler(I: Array, w: Array, t: float) -> Array:
    """Angular velocity at t of principal moments I1 < I2 < I3."""
    energy2, momentum2 = (I * w**2).sum(), (I**2 * w**2).sum()
    order = [0, 1, 2] if momentum2 > energy2 * I[1] else [2, 1, 0]
    I1, I2, I3 = I[order]
    a1 = np.sqrt((energy2 * I3 - momentum2) / (I1 * (I3 - I1)))
    a2 = np.sqrt((energy2 * I3 - momentum2) / (I2 * (I3 - I2)))
    a3 = np.sqrt((momentum2 - energy2 * I1) / (I3 * (I3 - I1)))
    rate = np.sqrt((I3 - I2) * (momentum2 - energy2 * I1) / (I1 * I2 * I3))
    k2 = (I2 - I1) * (energy2 * I3 - momentum2) / ((I3 - I2) * (momentum2 - energy2 * I1))
    x, y, z = w[order]
    side = np.sign(z)
    phase = np.arctan2(side * y / a2, x / a1)
    sn, cn, dn, _ = ellipj(rate * t + ellipkinc(phase, k2), k2)
    out = np.empty(3)
    out[order] = a1 * cn, side * a2 * sn, side * a3 * dn
    return out


if __name__ == "__main__":
    q, v, bound = reference(sys.argv[1])
    np.savez(f"{sys.argv[2]}.part.npz", q=q, v=v, bound=bound)
    os.replace(f"{sys.argv[2]}.part.npz", sys.argv[2])  # atomic
