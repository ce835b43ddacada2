"""Actuators of a compiled model that are not affine forces at joints and sites."""

from __future__ import annotations

import mujoco

from rbjax.forces import Element


def actuator_elements(m: mujoco.MjModel) -> tuple[Element, ...]:
    """The elements of actuators with states, and of other transmissions."""
    return ()
