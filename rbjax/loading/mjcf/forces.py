"""Force elements of a compiled model: joints, gravity compensation, fluid, cables.

Limits and friction loss are soft constraints in MuJoCo:

    a_ref = -b v - k d(r) r,    f = (a_ref - a) / R at the solution,    R = (1 - d) / d * A

r is the penetration, d its impedance, A the inverse inertia at the dof (`dof_invweight0`), and k, b
follow from `solref` (MuJoCo, *Computation*, constraint model). They become elements only by an
option of `load`. At rest a = v = 0, so a stop carries f = d^2 k r / ((1 - d) A), a spring. The
stiffness of the element is taken at half the width of the impedance. Its damper has solref's
damping ratio for this spring and the inertia 1 / A. Friction loss creeps at v = f R / b under a
load f, so v_0 = F_c R / b in `JointFriction`, but at least 2 h F_c A for a time step h, so that
explicit steps are stable.

A body with geoms of fluidshape="ellipsoid" has the fluid forces of these geoms. Any other body has
the fluid forces of its inertia box.
"""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np

from rbjax.forces import (
    Element,
    EllipsoidFluid,
    GravityCompensation,
    InertiaBoxFluid,
    JointFriction,
    JointLimits,
    JointPolynomials,
)
from rbjax.forces.impedance import impedance, stiffness_and_damping
from rbjax.loading.checks import check_finite
from rbjax.loading.mjcf.cables import cable_elements
from rbjax.loading.mjcf.dropped import inverted_limits
from rbjax.loading.mjcf.fields import (
    ALIGNED,
    Off,
    inertial_frame,
    is_on,
    leaf,
    reflected,
    safe_solref,
)

_SIZES = {int(mujoco.mjtJoint.mjJNT_FREE): 6, int(mujoco.mjtJoint.mjJNT_BALL): 3}


def force_elements(m: mujoco.MjModel, *, limits: bool, friction: bool) -> tuple[Element, ...]:
    """Read the force elements other than actuators and the linear springs of joints."""
    found: list[Element] = [*_polynomials(m)]
    if limits and is_on(m, Off.mjDSBL_CONSTRAINT, Off.mjDSBL_LIMIT):
        found += _limits(m)
    if friction and is_on(m, Off.mjDSBL_CONSTRAINT, Off.mjDSBL_FRICTIONLOSS):
        found += _friction(m)
    found += [*_gravity_compensation(m), *fluid_elements(m), *cable_elements(m)]
    for element in found:
        check_finite(element)
    return tuple(found)


def _of(m: mujoco.MjModel, joints: np.ndarray) -> np.ndarray:
    """Return the indices of all dofs of the given joints, in their order."""
    spans = [m.jnt_dofadr[j] + np.arange(_SIZES.get(int(m.jnt_type[j]), 1)) for j in joints]
    return np.concatenate([np.zeros(0, int), *spans])


def _polynomials(m: mujoco.MjModel) -> list[Element]:
    stiffness = m.jnt_stiffnesspoly * is_on(m, Off.mjDSBL_SPRING)
    damping = (m.dof_dampingpoly + reflected(m)[2]) * is_on(m, Off.mjDSBL_DAMPER)
    has = stiffness.any(-1)
    has[m.dof_jntid[damping.any(-1)]] = True
    joints = np.flatnonzero(has)
    if not len(joints):
        return []
    numbers = (leaf(stiffness[joints]), leaf(damping[_of(m, joints)]))
    return [JointPolynomials(*numbers, tuple(joints.tolist()))]


def _limits(m: mujoco.MjModel) -> list[Element]:
    joints = np.flatnonzero(m.jnt_limited & ~inverted_limits(m))
    if not len(joints):
        return []
    rows = [_stop(m, int(j)) for j in joints]
    stiffness, damping, width = map(leaf, zip(*rows, strict=True))
    margin = leaf(m.jnt_margin[joints])
    return [JointLimits(stiffness, damping, margin, width, tuple(joints.tolist()))]


def _stop(m: mujoco.MjModel, joint: int) -> tuple[float, float, float]:
    """Compute stiffness, damping and width of the stop of a joint.

    The width is a tenth of the width of `solimp`.
    """
    mobility = max(m.dof_invweight0[m.jnt_dofadr[joint]], mujoco.mjMINVAL)
    width = max(m.jnt_solimp[joint, 2], mujoco.mjMINVAL)
    solref, solimp = safe_solref(m, m.jnt_solref[joint]), m.jnt_solimp[joint]
    k, b = stiffness_and_damping(solref, solimp)
    d = impedance(width / 2, solimp)
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
        d = impedance(0.0, m.dof_solimp[i])
        _, damping = stiffness_and_damping(safe_solref(m, m.dof_solref[i]), m.dof_solimp[i])
        soft = (1 - d) / d / max(damping, mujoco.mjMINVAL)
        creep.append(m.dof_invweight0[i] * max(soft, 2 * m.opt.timestep))
    return [
        JointFriction(
            coulomb=leaf(loss),
            breakaway=None,
            stribeck=jnp.ones(len(at)),
            smoothing=leaf(np.where(loss > 0, loss * np.array(creep), 1.0)),
            viscous=jnp.zeros(len(at)),
            joints=tuple(joints.tolist()),
        )
    ]


def _gravity_compensation(m: mujoco.MjModel) -> list[Element]:
    """Read the gravity compensation; none if springs and dampers are disabled, as in MuJoCo."""
    bodies = np.flatnonzero(m.body_gravcomp[1:])
    if not len(bodies) or not (is_on(m, Off.mjDSBL_SPRING) or is_on(m, Off.mjDSBL_DAMPER)):
        return []
    fraction, at = leaf(m.body_gravcomp[1:][bodies]), tuple(bodies.tolist())
    driven = np.flatnonzero(m.jnt_actgravcomp)
    if not len(driven):
        return [GravityCompensation(fraction, at)]
    passive = np.flatnonzero(~m.jnt_actgravcomp.astype(bool))
    found: list[Element] = []
    if len(passive):
        found.append(GravityCompensation(fraction, at, tuple(passive.tolist())))
    if m.nactuator and is_on(m, Off.mjDSBL_ACTUATION):  # else MuJoCo drops the actuated part
        found.append(GravityCompensation(fraction, at, tuple(driven.tolist()), actuated=True))
    return found


Array = np.ndarray


def fluid_elements(m: mujoco.MjModel) -> tuple[Element, ...]:
    """Read the fluid forces on the bodies."""
    bits = mujoco.mjtDisableBit
    out: list[Element] = []
    off = int(bits.mjDSBL_SPRING) | int(bits.mjDSBL_DAMPER)
    rho, mu = float(m.opt.density), float(m.opt.viscosity)
    if m.opt.disableflags & off == off or max(rho, mu) <= 0:  # both disabled: no passive forces
        return ()
    moving = (m.body_weldid != 0) & (m.body_mass >= mujoco.mjMINVAL)
    shaped = m.geom_fluid[:, 0] > 0
    boxes = np.flatnonzero(moving & ~np.isin(np.arange(m.nbody), m.geom_bodyid[shaped])).tolist()
    geoms = np.flatnonzero(moving[m.geom_bodyid] & shaped).tolist()
    wind = leaf(m.opt.wind)
    if boxes:
        orientation = leaf([inertial_frame(m, b)[1] for b in boxes])
        medium = leaf(max(rho, 0.0)), leaf(max(mu, 0.0))
        out.append(InertiaBoxFluid(*medium, wind, orientation, tuple(b - 1 for b in boxes)))
    if geoms:
        frames = [_geom_frame(m, g) for g in geoms]
        fluid = leaf(m.geom_fluid[geoms])
        out.append(
            EllipsoidFluid(
                density=leaf(rho),
                viscosity=leaf(mu),
                wind=wind,
                semi_axes=leaf([_semi_axes(m, g) for g in geoms]),
                position=leaf([p for p, _ in frames]),
                orientation=leaf([q for _, q in frames]),
                blunt_drag=fluid[:, 1],
                slender_drag=fluid[:, 2],
                angular_drag=fluid[:, 3],
                kutta_lift=fluid[:, 4],
                magnus_lift=fluid[:, 5],
                virtual_mass=fluid[:, 6:9],
                virtual_inertia=fluid[:, 9:12],
                interaction=fluid[:, 0],
                bodies=tuple(int(m.geom_bodyid[g]) - 1 for g in geoms),
            )
        )
    return tuple(out)


def _semi_axes(m: mujoco.MjModel, g: int) -> Array:
    """Return the semi-axes of the equivalent ellipsoid of a geom."""
    kinds, (x, y, _) = mujoco.mjtGeom, m.geom_size[g]
    axes = {
        int(kinds.mjGEOM_SPHERE): [x, x, x],
        int(kinds.mjGEOM_CAPSULE): [x, x, x + y],
        int(kinds.mjGEOM_CYLINDER): [x, x, y],
    }
    return np.array(axes.get(int(m.geom_type[g]), m.geom_size[g]))


def _geom_frame(m: mujoco.MjModel, g: int) -> tuple[Array, Array]:
    """Return the frame of a geom in its body as MuJoCo uses it."""
    same, kinds = int(m.geom_sameframe[g]), mujoco.mjtSameFrame
    position, attitude = inertial_frame(m, m.geom_bodyid[g])
    if same == int(kinds.mjSAMEFRAME_BODY):
        return np.zeros(3), ALIGNED
    if same == int(kinds.mjSAMEFRAME_INERTIA):
        return position, attitude
    if same == int(kinds.mjSAMEFRAME_BODYROT):
        return m.geom_pos[g], ALIGNED
    return m.geom_pos[g], attitude if same == int(kinds.mjSAMEFRAME_INERTIAROT) else m.geom_quat[g]
