"""Force elements of a compiled model's joints and bodies."""

from __future__ import annotations

import mujoco

from rbjax.forces import Element


def joint_elements(m: mujoco.MjModel, *, limits: bool, friction: bool) -> tuple[Element, ...]:
    """The elements of joints, and gravity compensation."""
    return ()
