"""The force elements of a compiled MuJoCo model.

What MuJoCo computes as a force becomes an element with MuJoCo's own numbers. What it computes as a
constraint (limits, friction loss) becomes a smooth element only where the caller asks for it.
"""

from __future__ import annotations

import jax
import mujoco
import numpy as np

from rbjax.errors import ModelError
from rbjax.forces import Element
from rbjax.loading.force_actuators import actuator_elements
from rbjax.loading.force_fluid import fluid_elements
from rbjax.loading.force_joints import joint_elements

#: leaves in which infinite means that there is no limit
_LIMITS = ("range", "limits", "windup", "slew", "drive", "current_rate", "strongest")


def elements(m: mujoco.MjModel, *, limits: bool, friction: bool) -> tuple[Element, ...]:
    """The elements beside the joints' linear springs and the affine actuators."""
    joints = joint_elements(m, limits=limits, friction=friction)
    found = (*joints, *fluid_elements(m), *actuator_elements(m))
    for element in found:
        _refuse_nan(element)
    return found


def _refuse_nan(element: Element) -> None:
    """MuJoCo compiles numbers that are not finite, and a force of them would be none."""
    for at, leaf in jax.tree_util.tree_leaves_with_path(element):
        name, values = jax.tree_util.keystr(at).lstrip("."), np.asarray(leaf)
        bad = np.isnan(values) if name.endswith(_LIMITS) else ~np.isfinite(values)
        if bad.any():
            raise ModelError(
                f"the compiled model has {type(element).__name__}.{name} = {values[bad][0]}, which "
                f"is not finite; correct that number in the file"
            )
