"""Force elements of a compiled model's tendons: springs and dampers between two sites."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np

from rbjax.forces import Element, Place, PointSpring
from rbjax.loading.mjcf.dropped import tendon_is_supported

_BITS = mujoco.mjtDisableBit


def tendon_elements(m: mujoco.MjModel) -> tuple[Element, ...]:
    """The elements of spatial tendons of two sites."""
    found = []
    for i in range(m.ntendon):
        stiffness = np.array([m.tendon_stiffness[i], *m.tendon_stiffnesspoly[i]])
        damping = np.array([m.tendon_damping[i], *m.tendon_dampingpoly[i]])
        stiffness *= not m.opt.disableflags & int(_BITS.mjDSBL_SPRING)
        damping *= not m.opt.disableflags & int(_BITS.mjDSBL_DAMPER)
        if tendon_is_supported(m, i) and (stiffness.any() or damping.any()):
            start = m.tendon_adr[i]
            a, b = (Place.on(site=int(s)) for s in m.wrap_objid[start : start + 2])
            numbers = (stiffness, damping, m.tendon_lengthspring[i])
            found.append(PointSpring(a, b, *map(jnp.asarray, numbers)))
    return tuple(found)
