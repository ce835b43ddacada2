"""Loads that are distributed along a beam.

    tau_j = int S_j(s)^T [m(s); f(s)] ds = L sum_g w_g S_gj^T [m_g; f_g]

f is a force and m a moment for each metre of the beam. g is a Gauss point of the beam with the
weight w_g. The beam carries its mass at the same points, so a load of f = rho A g equals gravity.
"""

from __future__ import annotations

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.dynamics.arguments import check_array, check_model
from rbjax.errors import InputError
from rbjax.flexible.elasticity import beam_of
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.lanes import Vec3, mul
from rbjax.model import Model
from rbjax.model.leaves import numbers
from rbjax.spatial import Force


class BeamLoad(Element):
    """A force and a moment along a beam, such as its buoyancy, a wind or a magnetic moment.

    Fields:
        force: N/m, (3,) along the whole beam, or (points, 3) at its Gauss points.
        moment: N m/m, of the same shape.
        joint: the name of the beam; static.
        axes: "world", or "section" for a load that turns with the sections (follower load); static.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> rod = rb.flexible.beam(2.0, [0, 0, 6.0, 0, 0, 0], {"k_z": 1}, mass=0.5)
        >>> model = rb.load("<mujoco/>").with_beam("rod", rod)
        >>> load = rb.flexible.BeamLoad.of(model, "rod", force=[0.0, 3.0, 0.0])
        >>> tau = rb.applied_forces(model.with_forces(load), model.default_state())
        >>> tau.round(12).tolist()  # 3 int y_j ds, with y_j'' = P_j
        [4.0, -2.0]
    """

    force: jax.Array
    moment: jax.Array
    joint: str = eqx.field(static=True)
    axes: Literal["world", "section"] = eqx.field(static=True, default="world")

    @classmethod
    def of(
        cls, model: Model, joint: str, *, force: Any = None, moment: Any = None,
        axes: Literal["world", "section"] = "world",
    ) -> BeamLoad:  # fmt: skip
        """Create a load on a beam of a model. A force or moment of None is zero.

        Raises:
            UnknownName: no such joint. InputError: the joint is not a beam, a wrong shape or axes.
        """
        check_model("BeamLoad", model)
        beam, _ = beam_of(model, joint, model.gravity.dtype, "BeamLoad")
        if not isinstance(axes, str) or axes not in ("world", "section"):
            raise InputError(f"BeamLoad: axes is {axes!r}, expected 'world' or 'section'")
        points, dtype = beam.shape.points, model.gravity.dtype
        zero = jnp.zeros(3, dtype)
        rows = "; one row for each Gauss point of the beam"
        f, m = (
            zero if x is None else check_array("BeamLoad", name, x, (3,), (points, 3), fix=rows)
            for name, x in (("force", force), ("moment", moment))
        )
        f, m = f.astype(dtype), m.astype(dtype)
        return cls(f, m, joint, axes)

    def shapes(self, model: Model) -> Shapes:
        return {}

    def loads(self, context: Context) -> Loads:
        model, dtype = context.model, context.q.dtype
        beam, length = beam_of(model, self.joint, dtype, "BeamLoad")
        first = model.topology.frame_starts[model.joint(self.joint)]
        out = Loads()
        for g, weight in enumerate(beam.weights):
            share = mul(weight, length)
            f, m = (
                Vec3(*numbers(x if x.ndim == 1 else x[g], dtype)) for x in (self.force, self.moment)
            )
            frame = context.link(first + g)
            if self.axes == "section":
                out = out + frame.push_own(Force(m * share, f * share))
            else:
                out = out + frame.push(f * share, m * share)
        return out
