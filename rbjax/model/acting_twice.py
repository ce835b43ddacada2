"""Warnings about force elements that act in addition to a part of the model."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import numpy as np


def with_warning(model: Any, elements: tuple) -> tuple:
    """Warn about each force element that acts in addition to a part of the model: one that reads
    the control of an acting actuator, or a contact of a pair for which the contact law acts too.

    An actuator acts if its gain or bias is not zero. The elements are returned unchanged.
    """
    acting = _acting(model.actuators)
    touching = () if model.contact is None or model.geoms is None else model.geoms.pairs
    of_law = {frozenset(pair) for pair in touching}
    for one in elements:
        if not of_law.isdisjoint(getattr(one, "contact_pairs", ())):
            warnings.warn(
                f"with_forces: {type(one).__name__} acts in addition to the contact law "
                f"{model.contact!r} of the model; if it replaces the law, disable that with "
                "model.replace(contact=None)",
                stacklevel=4,
            )
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
