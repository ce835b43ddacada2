"""Where a picture is seen from: a line of sight, and one chosen by how flat a motion is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Camera:
    """A line of sight by azimuth and elevation in degrees, orthographic.

    Example:
        >>> from rbjax.plotting import Camera
        >>> Camera(azimuth=-90.0, elevation=0.0).axes.round(3) + 0.0  # x to the right, z up
        array([[ 1.,  0.,  0.],
               [ 0.,  0.,  1.],
               [ 0., -1.,  0.]])
    """

    azimuth: float = -60.0
    elevation: float = 12.0

    @property
    def axes(self) -> Array:
        """Rows: right, up, towards the eye."""
        a, e = np.radians(self.azimuth), np.radians(self.elevation)
        eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        return np.stack([right, np.cross(eye, right), eye])


def facing(points: Array) -> Camera:
    """The camera for a cloud of points (n, 3): across a flat one, else from a corner.

    A mechanism that moves in a vertical plane is seen at right angles to it.
    """
    spread = np.cov(points[:, :2].T)
    values, vectors = np.linalg.eigh(spread)
    if values[1] > 0 and values[0] < 0.1**2 * values[1]:
        thin = vectors[:, 0]
        # from the front (-y) or the right (+x), so that x or y grows to the right
        thin = thin if thin @ (1e-6, -1.0) > 0 or abs(thin[1]) < 1e-6 < thin[0] else -thin
        return Camera(float(np.degrees(np.arctan2(thin[1], thin[0]))), 10.0)
    return Camera(-60.0, 16.0)
