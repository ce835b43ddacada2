"""Fluid forces of a compiled model."""

from __future__ import annotations

import mujoco

from rbjax.forces import Element


def fluid_elements(m: mujoco.MjModel) -> tuple[Element, ...]:
    """The elements of the medium around the bodies."""
    return ()
