"""The reference of the comparison: MuJoCo C in f64, restricted to features that rbjax has.

`smooth` disables the features that rbjax omits from a model. Then

    v+ = v + dt a(q, v, u);   q+ = q (+) dt v+

is the Euler step of both MuJoCo (without its implicit joint damping) and `rollout`.
"""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from rbjax.loading import compile_model
from rbjax.loading.mjcf.cables import switch_off_cables
from rbjax.loading.mjcf.dropped import dropped_features
from rbjax.loading.mjcf.fields import is_at_joint, is_at_tendon, reason_left_out

Array = np.ndarray

#: the part of MuJoCo's Euler step beyond the equation above
_EULER = "implicit joint damping in MuJoCo's Euler step"
_ZEROED = (
    "dof_frictionloss", "tendon_frictionloss", "tendon_armature", "flex_stiffness", "flex_damping",
    "flex_edgestiffness", "flex_edgedamping",
)  # fmt: skip


def smooth(source: Any, *, floating_base: bool = False) -> tuple[mujoco.MjModel, tuple[str, ...]]:
    """Return an `MjModel` with only the features that rbjax has, and the names of the disabled
    ones. A given MjModel is copied, not changed.

        >>> from rbjax.validation.reference import smooth
        >>> smooth("pendulum")[1]
        ("implicit joint damping in MuJoCo's Euler step",)
    """
    m = copy.copy(compile_model(source, floating_base=floating_base))
    off = (*dropped_features(m), *switch_off_cables(m), _EULER)
    bits = mujoco.mjtDisableBit
    for bit in (bits.mjDSBL_CONSTRAINT, bits.mjDSBL_CONTACT, bits.mjDSBL_LIMIT):
        m.opt.disableflags |= int(bit)
    for bit in (bits.mjDSBL_FRICTIONLOSS, bits.mjDSBL_EQUALITY, bits.mjDSBL_EULERDAMP):
        m.opt.disableflags |= int(bit)
    m.geom_contype[:] = m.geom_conaffinity[:] = 0  # MJX rejects some pairs of shapes
    m.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    m.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    m.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    for i in range(m.nactuator):
        if reason_left_out(m, i):
            loosen(m, i)
        if not is_at_joint(m, i):
            m.actuator_armature[i] = 0.0
            if not is_at_tendon(m, i):
                m.actuator_damping[i] = m.actuator_dampingpoly[i] = 0.0
    for field in _ZEROED:
        values = getattr(m, field, None)  # several are new in MuJoCo 4
        if values is not None:
            values[:] = 0.0
    return m, off


def loosen(m: mujoco.MjModel, i: int) -> None:
    """Disconnect actuator i from the joints."""
    first = m.actuator_outadr[i]
    m.actuator_gear[first : first + m.actuator_outnum[i]] = 0.0
    if m.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_SO3:  # no gear acts on its torques
        m.actuator_gainprm[i] = m.actuator_biasprm[i] = 0.0


@dataclass(frozen=True)
class StateSamples:
    """States q (N, nq), v (N, nv) and constant controls ctrl (N, nu), all exact in f32."""

    q: Array
    v: Array
    ctrl: Array

    def __getitem__(self, rows: slice) -> StateSamples:
        return StateSamples(self.q[rows], self.v[rows], self.ctrl[rows])


def random_samples(m: mujoco.MjModel, count: int, seed: int) -> StateSamples:
    """Draw random states: coordinates within 1 of the file's, uniform attitudes, normal velocities.
    Controls are in the inner fifth of their ranges."""
    rng = np.random.default_rng(seed)
    q = m.qpos0 + rng.uniform(-1.0, 1.0, (count, m.nq))
    for kind, at in zip(m.jnt_type, m.jnt_qposadr, strict=True):
        free = int(kind) == int(mujoco.mjtJoint.mjJNT_FREE)
        if free or int(kind) == int(mujoco.mjtJoint.mjJNT_BALL):
            start = at + 3 * free
            turn = rng.normal(size=(count, 4))
            q[:, start : start + 4] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    limited = m.actuator_ctrllimited.astype(bool)
    low = np.where(limited, m.actuator_ctrlrange[:, 0], -1.0)
    high = np.where(limited, m.actuator_ctrlrange[:, 1], 1.0)
    middle, half = (low + high) / 2, (high - low) / 2
    ctrl = middle + 0.2 * half * rng.uniform(-1.0, 1.0, (count, m.nu))
    drawn = (q, rng.normal(size=(count, m.nv)), ctrl)
    return StateSamples(*(x.astype(np.float32).astype(np.float64) for x in drawn))


def quantities(m: mujoco.MjModel, samples: StateSamples) -> dict[str, Array]:
    """Compute the quantities of MuJoCo at each state. They are poses, velocities, M, bias forces,
    acceleration and the next state."""
    data, rows = mujoco.MjData(m), []
    for q, v, ctrl in zip(samples.q, samples.v, samples.ctrl, strict=True):
        mujoco.mj_resetData(m, data)
        data.qpos, data.qvel, data.ctrl = q, v, ctrl
        mujoco.mj_forward(m, data)
        M = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, data, M)
        pose = np.concatenate([data.xmat[1:], data.xpos[1:]], -1)
        row = {"poses": pose, "velocities": _velocities(m, data), "mass matrix": M}
        row |= {"bias forces": data.qfrc_bias.copy(), "forward dynamics": data.qacc.copy()}
        mujoco.mj_step(m, data)
        rows.append(row | {"one step": np.concatenate([data.qpos, data.qvel])})
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def _velocities(m: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Compute the twists (nb, 6) in world axes at the bodies' origins."""
    out = np.zeros((m.nbody - 1, 6))
    for b in range(1, m.nbody):
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(m, data, mujoco.mjtObj.mjOBJ_XBODY, b, twist, 0)
        out[b - 1] = twist
    return out


def trajectory(
    m: mujoco.MjModel, q: Array, v: Array, ctrl: Array, steps: int
) -> tuple[Array, Array]:
    """Simulate by MuJoCo: states (steps + 1, nq), (steps + 1, nv) for ctrl (nu,) or (steps, nu)."""
    data = mujoco.MjData(m)
    data.qpos, data.qvel = q, v
    ctrls = np.broadcast_to(ctrl, (steps, m.nu))
    qs, vs = np.empty((steps + 1, m.nq)), np.empty((steps + 1, m.nv))
    qs[0], vs[0] = q, v
    for i in range(steps):
        data.ctrl = ctrls[i]
        mujoco.mj_step(m, data)
        qs[i + 1], vs[i + 1] = data.qpos, data.qvel
    return qs, vs


def final_gradient(
    m: mujoco.MjModel, samples: StateSamples, steps: int, weights: Array, *, step: float = 1e-4
) -> Array:
    """Compute d(weights . final state) / d(v0, ctrl) (N, nv + nu) by central differences. f' = (8
    (f(h) - f(-h)) - (f(2h) - f(-2h))) / 12 h: truncation h^4, rounding eps / h."""

    def loss(q: Array, x: Array) -> float:
        qs, vs = trajectory(m, q, x[: m.nv], x[m.nv :], steps)
        return float(weights @ np.concatenate([qs[-1], vs[-1]]))

    out = np.zeros((len(samples.q), m.nv + m.nu))
    for row, (q, v, ctrl) in enumerate(zip(samples.q, samples.v, samples.ctrl, strict=True)):
        x = np.concatenate([v, ctrl])
        for i, e in enumerate(np.eye(len(x))):
            near = loss(q, x + step * e) - loss(q, x - step * e)
            far = loss(q, x + 2 * step * e) - loss(q, x - 2 * step * e)
            out[row, i] = (8 * near - far) / (12 * step)
    return out


def forward_seconds(m: mujoco.MjModel, samples: StateSamples) -> float:
    """Measure the median time of `mj_forward` over all samples, sequentially on one thread, s."""
    data, times = mujoco.MjData(m), []
    for _ in range(5):
        begin = time.perf_counter()
        for q, v in zip(samples.q, samples.v, strict=True):
            data.qpos, data.qvel = q, v
            mujoco.mj_forward(m, data)
        times.append(time.perf_counter() - begin)
    return float(np.median(times))
