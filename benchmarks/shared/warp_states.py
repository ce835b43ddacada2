"""Writes states and forces into the data of MuJoCo Warp; this file is no benchmark."""

from __future__ import annotations

from typing import Any

import numpy as np


def assign(data: Any, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> None:
    """Set positions, velocities and applied forces, one row a robot, in f32."""
    for array, values in zip((data.qpos, data.qvel, data.qfrc_applied), (q, v, tau), strict=True):
        array.assign(values.astype(np.float32))
