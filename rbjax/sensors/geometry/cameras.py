"""Sensors of cameras: the pixel at which a point appears.

    u = W/2 - fx x/z,   v = H/2 + fy y/z,   (x, y, z) = R^T (p - c)
W x H is the resolution. R and c are the axes and the position of the camera, which looks along -z
with x to the right and y up; u grows to the right, v down. As in MuJoCo, the principal point is the
middle of the picture and a point behind the camera has a pixel too. (Hartley & Zisserman,
*Multiple View Geometry*, 6.1; MuJoCo, *XML reference*, camprojection.)
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.model import Model
from rbjax.sensors.fixed import FrameSensor, named_frame, reading
from rbjax.sensors.protocol import register

#: the least depth of a point, m
LEAST_DEPTH = 1e-15


@register("camprojection", placed=True)
class CameraProjection(FrameSensor):
    """Measure the pixel (u, v) at which a camera sees the origin of a frame.

    frame: the frame of the camera; static.
    seen: the frame whose origin is seen, as `frame`; static.
    focal: focal lengths (fx, fy) in pixels; static.
    resolution: width and height in pixels; static.
    """

    labels: ClassVar[tuple[str, ...]] = ("u", "v")
    of = "px"
    seen: Any = eqx.field(static=True, default="world")
    focal: tuple[float, float] = eqx.field(static=True, default=(500.0, 500.0))
    resolution: tuple[int, int] = eqx.field(static=True, default=(640, 480))

    def __check_init__(self) -> None:
        for name, given in (("focal", self.focal), ("resolution", self.resolution)):
            if not (isinstance(given, tuple) and len(given) == 2 and all(x > 0 for x in given)):
                raise InputError(
                    f"CameraProjection: {name} is {given!r}, expected two positive numbers of "
                    "pixels, along the width and the height"
                )

    def check(self, model: Model) -> None:
        super().check(model)
        FrameSensor(self.seen).check(model)

    def __call__(self, context: Context) -> jax.Array:
        camera, seen = self.at(context), context.frame(named_frame(context.model, self.seen))
        x, y, z = camera.rotation.T @ (seen.position - camera.position)
        depth = jnp.where(jnp.abs(z) < LEAST_DEPTH, LEAST_DEPTH, -z)
        (fx, fy), (width, height) = self.focal, self.resolution
        return reading(context, [0.5 * width + fx * x / depth, 0.5 * height - fy * y / depth])
