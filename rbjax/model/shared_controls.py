"""A warning about force elements that read the control of an actuator that also exerts a force."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import numpy as np


def with_warning(model: Any, elements: tuple) -> tuple:
    """Warn about each force element that reads the control of an acting actuator.

    An actuator acts if its gain or bias is not zero. The elements are returned unchanged.
    """
    acting = _acting(model.actuators)
    for one in elements:
        taken = getattr(one, "controls", ()) if getattr(one, "actuates", False) else ()
        twice = [model.actuator_names[k] for k in taken if 0 <= k < len(acting) and acting[k]]
        if twice:
            warnings.warn(
                f"with_forces: {type(one).__name__} reads the controls of the actuators {twice}, "
                "which still act; if the element replaces them, set their rows of "
                "model.actuators.gain and model.actuators.bias to zero",
                stacklevel=4,
            )
    return elements


def _acting(actuators: Any) -> np.ndarray:
    """Return the mask (nu,) of actuators that exert forces, empty if their leaves are traced."""
    if any(isinstance(x, jax.core.Tracer) for x in (actuators.gain, actuators.bias)):
        return np.zeros(0, bool)
    rows = np.concatenate([np.asarray(actuators.gain), np.asarray(actuators.bias)], -1)
    return (rows != 0).any(-1) if rows.ndim == 2 else np.zeros(0, bool)
