"""Numbers in the attributes of a URDF."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from typing import Any

import mujoco
import numpy as np

from rbjax.errors import ModelError


def read_numbers(
    element: ET.Element | None, key: str, count: int, where: str, usual: Any = None
) -> np.ndarray:
    """`count` numbers of an attribute: zeros if the element is absent, `usual` if the attribute is.

    Raises:
        ModelError: the attribute is not so many finite numbers, or is absent and has no `usual`.
    """
    if element is None:
        return np.zeros(count)
    text = element.get(key)
    if text is None:
        if usual is None:
            raise ModelError(f"{where}: <{element.tag}> has no {key}, expected a number; add it")
        return np.broadcast_to(np.asarray(usual, float), count)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        expected = "one finite number" if count == 1 else f"{count} finite numbers"
        raise ModelError(
            f"{where}: <{element.tag} {key}={text!r}>, expected {expected}; correct it"
        )
    return np.array(values)


def number(element: ET.Element | None, key: str, where: str, usual: float = 0.0) -> float:
    """One number."""
    return float(read_numbers(element, key, 1, where, usual)[0])


def origin(element: ET.Element | None, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and quaternion (4,) of the <origin> of an element."""
    found = None if element is None else element.find("origin")
    position = read_numbers(found, "xyz", 3, where, 0.0)
    quat = np.empty(4)
    mujoco.mju_euler2Quat(quat, read_numbers(found, "rpy", 3, where, 0.0), "XYZ")
    return position, quat
