"""Motion capture of a rigid body: the pose of a body or of a site."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.dynamics import forward_kinematics, frame_pose
from rbjax.errors import UnknownName
from rbjax.model import Model
from rbjax.model.record import Record
from rbjax.rotations import quaternion
from rbjax.sensors.columns import Columns
from rbjax.sensors.protocol import Context
from rbjax.sensors.registry import register


@register("pose", placed=True)
class Pose(Record):
    """Position and quaternion (7,) of the frame of a body, or of a site, in the world."""

    name: str = eqx.field(static=True)

    def __call__(self, context: Context) -> jax.Array:
        model, q = context.model, context.state.q
        if self.name in model.body_names:
            poses, k = forward_kinematics(model, q), model.body(self.name)
            R, p = poses.R[k], poses.p[k]
        else:
            R, p = frame_pose(model, q, site=self.name)
        return jnp.concatenate([p, quaternion.from_matrix(R)])

    def columns(self, model: Model) -> Columns:
        if self.name not in (*model.body_names, *model.site_names):
            raise UnknownName("body or site", self.name, [*model.body_names, *model.site_names])
        return Columns(7, (3,))

    def names(self, model: Model) -> tuple[str, ...]:
        """Of the position, then of the quaternion."""
        return "x", "y", "z", "qw", "qx", "qy", "qz"

    def unit(self, model: Model) -> str:
        return "m or rad"
