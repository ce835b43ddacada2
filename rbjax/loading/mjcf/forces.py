"""The force elements of a compiled MuJoCo model.

What MuJoCo computes as a force becomes an element with MuJoCo's own numbers. What it computes as a
constraint (limits, friction loss) becomes a smooth element only where the caller asks for it.
"""

from __future__ import annotations

import mujoco

from rbjax.forces import Element
from rbjax.loading.mjcf.finite import refuse_nan
from rbjax.loading.mjcf.fluid import fluid_elements
from rbjax.loading.mjcf.joint_forces import joint_elements


def elements(m: mujoco.MjModel, *, limits: bool, friction: bool) -> tuple[Element, ...]:
    """The force elements other than the joints' linear springs and the actuators."""
    joints = joint_elements(m, limits=limits, friction=friction)
    found = (*joints, *fluid_elements(m))
    for element in found:
        refuse_nan(element)
    return found
