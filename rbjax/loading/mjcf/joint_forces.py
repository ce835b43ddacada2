"""Force elements of a compiled model's joints and bodies, with MuJoCo's own numbers.

Limits and friction loss are constraints in MuJoCo, solved for softly:

    a_ref = -b v - k d(r) r,    f = (a_ref - a) / R at the solution,    R = (1 - d) / d * A

with r the depth, d its impedance, A the inverse inertia at the coordinate (`dof_invweight0`), and
k, b made of `solref` (MuJoCo, *Computation*, constraint model). At rest a = v = 0, so that a stop
bears f = d^2 k r / ((1 - d) A): a spring, whose stiffness here is that in the middle of the width
over which d grows. Its damper has solref's damping ratio for that spring and the inertia 1 / A.
Friction loss creeps at v = f R / b under a load f, so that v_0 = F_c R / b for `JointFriction`; or
2 h F_c A for a time step h where that is more, which an explicit step follows.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rbjax.forces import (
    Element,
    GravityCompensation,
    JointFriction,
    JointLimits,
    JointPolynomials,
)
from rbjax.loading.mjcf.actuator_kinds import reflected
from rbjax.loading.mjcf.dropped import inverted_limits
from rbjax.loading.mjcf.tendons import tendon_elements

_BITS = mujoco.mjtDisableBit
_IMPEDANCES = (1e-4, 0.9999)  # within which MuJoCo holds d
_SIZES = {int(mujoco.mjtJoint.mjJNT_FREE): 6, int(mujoco.mjtJoint.mjJNT_BALL): 3}


def joint_elements(m: mujoco.MjModel, *, limits: bool, friction: bool) -> tuple[Element, ...]:
    """The elements of joints, gravity compensation, and springs between two sites."""
    found: list[Element] = [*_polynomials(m)]
    if limits and _on(m, _BITS.mjDSBL_CONSTRAINT, _BITS.mjDSBL_LIMIT):
        found += _limits(m)
    if friction and _on(m, _BITS.mjDSBL_CONSTRAINT, _BITS.mjDSBL_FRICTIONLOSS):
        found += _friction(m)
    return (*found, *_gravity_compensation(m), *tendon_elements(m))


def _on(m: mujoco.MjModel, *bits: mujoco.mjtDisableBit) -> bool:
    return not any(m.opt.disableflags & int(bit) for bit in bits)


def _array(x: Any) -> jax.Array:
    return jnp.asarray(np.asarray(x, np.float64))


def _of(m: mujoco.MjModel, joints: np.ndarray) -> np.ndarray:
    """The velocity coordinates of these joints, in their order."""
    spans = [m.jnt_dofadr[j] + np.arange(_SIZES.get(int(m.jnt_type[j]), 1)) for j in joints]
    return np.concatenate([np.zeros(0, int), *spans])


def _polynomials(m: mujoco.MjModel) -> list[Element]:
    stiffness = m.jnt_stiffnesspoly * _on(m, _BITS.mjDSBL_SPRING)
    damping = (m.dof_dampingpoly + reflected(m)[2]) * _on(m, _BITS.mjDSBL_DAMPER)
    has = stiffness.any(-1)
    has[m.dof_jntid[damping.any(-1)]] = True
    joints = np.flatnonzero(has)
    if not len(joints):
        return []
    numbers = (_array(stiffness[joints]), _array(damping[_of(m, joints)]))
    return [JointPolynomials(*numbers, tuple(joints.tolist()))]


def _limits(m: mujoco.MjModel) -> list[Element]:
    joints = np.flatnonzero(m.jnt_limited & ~inverted_limits(m))
    if not len(joints):
        return []
    rows = [_stop(m, int(j)) for j in joints]
    stiffness, damping, width = map(_array, zip(*rows, strict=True))
    margin = _array(m.jnt_margin[joints])
    return [JointLimits(stiffness, damping, margin, width, tuple(joints.tolist()))]


def _stop(m: mujoco.MjModel, joint: int) -> tuple[float, float, float]:
    """Stiffness, damping and onset of the stop of a joint: see above. The onset is a tenth of the
    impedance's width."""
    mobility = max(m.dof_invweight0[m.jnt_dofadr[joint]], mujoco.mjMINVAL)
    width = max(m.jnt_solimp[joint, 2], mujoco.mjMINVAL)
    k, b = _reference(m, m.jnt_solref[joint], m.jnt_solimp[joint])
    d = _impedance(m.jnt_solimp[joint], width / 2)
    stiffness = d * d * k / ((1 - d) * mobility)
    ratio = b / (2 * np.sqrt(k))
    return stiffness, 2 * ratio * np.sqrt(stiffness / mobility), max(width / 10, 1e-6)


def _friction(m: mujoco.MjModel) -> list[Element]:
    joints = np.unique(m.dof_jntid[m.dof_frictionloss > 0])
    if not len(joints):
        return []
    at = _of(m, joints)
    loss, creep = m.dof_frictionloss[at], []
    for i in at:
        d = _impedance(m.dof_solimp[i], 0.0)
        soft = (1 - d) / d / _reference(m, m.dof_solref[i], m.dof_solimp[i])[1]
        creep.append(m.dof_invweight0[i] * max(soft, 2 * m.opt.timestep))
    return [
        JointFriction(
            coulomb=_array(loss),
            breakaway=None,
            stribeck=jnp.ones(len(at)),
            smoothing=_array(np.where(loss > 0, loss * np.array(creep), 1.0)),
            viscous=jnp.zeros(len(at)),
            joints=tuple(joints.tolist()),
        )
    ]


def _reference(m: mujoco.MjModel, solref: np.ndarray, solimp: np.ndarray) -> tuple[float, float]:
    """k and b of a_ref = -b v - k d r."""
    top = float(np.clip(solimp[1], *_IMPEDANCES))
    if solref[0] <= 0:
        return -solref[0] / top**2, -solref[1] / top
    time, ratio = solref
    if _on(m, _BITS.mjDSBL_REFSAFE):
        time = max(time, 2 * m.opt.timestep)
    return 1 / max(mujoco.mjMINVAL, (top * time * ratio) ** 2), 2 / max(mujoco.mjMINVAL, top * time)


def _impedance(solimp: np.ndarray, depth: float) -> float:
    """d at a depth: from solimp's first number to its second over its width, by two powers that
    meet at its midpoint."""
    low, high = np.clip(solimp[:2], *_IMPEDANCES)
    width, middle = max(solimp[2], 0.0), float(np.clip(solimp[3], *_IMPEDANCES))
    power = max(solimp[4], 1.0)
    if low == high or width <= mujoco.mjMINVAL:
        return float(low + high) / 2
    x = min(depth / width, 1.0)
    share = x
    if power > 1 and x < 1:
        near = x <= middle
        share = x**power / middle ** (power - 1)
        share = share if near else 1 - (1 - x) ** power / (1 - middle) ** (power - 1)
    return float(low + share * (high - low))


def _gravity_compensation(m: mujoco.MjModel) -> list[Element]:
    """Without springs and dampers MuJoCo computes no passive forces, of which this is one."""
    bodies = np.flatnonzero(m.body_gravcomp[1:])
    if not len(bodies) or not (_on(m, _BITS.mjDSBL_SPRING) or _on(m, _BITS.mjDSBL_DAMPER)):
        return []
    fraction, at = _array(m.body_gravcomp[1:][bodies]), tuple(bodies.tolist())
    driven = np.flatnonzero(m.jnt_actgravcomp)
    if not len(driven):
        return [GravityCompensation(fraction, at)]
    passive = np.flatnonzero(~m.jnt_actgravcomp.astype(bool))
    found: list[Element] = []
    if len(passive):
        found.append(GravityCompensation(fraction, at, tuple(passive.tolist())))
    if m.nactuator and _on(m, _BITS.mjDSBL_ACTUATION):  # else MuJoCo loses the actuators' share
        found.append(GravityCompensation(fraction, at, tuple(driven.tolist()), actuated=True))
    return found
