"""Fluid forces of a compiled model.

A body with geoms of fluidshape="ellipsoid" meets the fluid with these geoms; any other body meets
it with its inertia box.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from rbjax.forces import Element, EllipsoidFluid, InertiaBoxFluid

Array = np.ndarray
_ALIGNED = np.array([1.0, 0.0, 0.0, 0.0])


def fluid_elements(m: mujoco.MjModel) -> tuple[Element, ...]:
    """The elements of the medium around the bodies."""
    bits = mujoco.mjtDisableBit
    out: list[Element] = []
    off = int(bits.mjDSBL_SPRING) | int(bits.mjDSBL_DAMPER)
    rho, mu = float(m.opt.density), float(m.opt.viscosity)
    if m.opt.disableflags & off == off or max(rho, mu) <= 0:  # without either nothing is passive
        return ()
    moving = (m.body_weldid != 0) & (m.body_mass >= mujoco.mjMINVAL)
    shaped = m.geom_fluid[:, 0] > 0
    boxes = np.flatnonzero(moving & ~np.isin(np.arange(m.nbody), m.geom_bodyid[shaped])).tolist()
    geoms = np.flatnonzero(moving[m.geom_bodyid] & shaped).tolist()
    wind = jnp.asarray(m.opt.wind)
    if boxes:
        orientation = _rows([inertial_frame(m, b)[1] for b in boxes])
        medium = jnp.asarray(max(rho, 0.0)), jnp.asarray(max(mu, 0.0))
        out.append(InertiaBoxFluid(*medium, wind, orientation, tuple(b - 1 for b in boxes)))
    if geoms:
        frames = [_geom_frame(m, g) for g in geoms]
        fluid = jnp.asarray(m.geom_fluid[geoms])
        out.append(
            EllipsoidFluid(
                density=jnp.asarray(rho),
                viscosity=jnp.asarray(mu),
                wind=wind,
                semi_axes=_rows([_semi_axes(m, g) for g in geoms]),
                position=_rows([p for p, _ in frames]),
                orientation=_rows([q for _, q in frames]),
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


def _rows(rows: list[Array]) -> Any:
    return jnp.asarray(np.array(rows, np.float64))


def _semi_axes(m: mujoco.MjModel, g: int) -> Array:
    """Of the ellipsoid in a geom's place."""
    kinds, (x, y, _) = mujoco.mjtGeom, m.geom_size[g]
    axes = {
        int(kinds.mjGEOM_SPHERE): [x, x, x],
        int(kinds.mjGEOM_CAPSULE): [x, x, x + y],
        int(kinds.mjGEOM_CYLINDER): [x, x, y],
    }
    return np.array(axes.get(int(m.geom_type[g]), m.geom_size[g]))


def inertial_frame(m: mujoco.MjModel, b: int) -> tuple[Array, Array]:
    """The inertial frame of a body as MuJoCo uses it: frames that coincide within 1e-6 are one."""
    same, kinds = int(m.body_sameframe[b]), mujoco.mjtSameFrame
    if same == int(kinds.mjSAMEFRAME_BODY):
        return np.zeros(3), _ALIGNED
    turned = same != int(kinds.mjSAMEFRAME_BODYROT)
    return m.body_ipos[b], m.body_iquat[b] if turned else _ALIGNED


def _geom_frame(m: mujoco.MjModel, g: int) -> tuple[Array, Array]:
    """The frame of a geom in its body as MuJoCo uses it."""
    same, kinds = int(m.geom_sameframe[g]), mujoco.mjtSameFrame
    position, attitude = inertial_frame(m, m.geom_bodyid[g])
    if same == int(kinds.mjSAMEFRAME_BODY):
        return np.zeros(3), _ALIGNED
    if same == int(kinds.mjSAMEFRAME_INERTIA):
        return position, attitude
    if same == int(kinds.mjSAMEFRAME_BODYROT):
        return m.geom_pos[g], _ALIGNED
    return m.geom_pos[g], attitude if same == int(kinds.mjSAMEFRAME_INERTIAROT) else m.geom_quat[g]
