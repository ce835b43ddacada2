"""The torque that a gear loses in transmitting: friction that grows with the load.

    tau = -mu |tau_motor| tanh(v / v_0)

The teeth of a gear press on each other with the torque that they transmit, and rub. A gear of
efficiency eta loses mu = 1 - eta of it. Friction that does not depend on the load is
`JointFriction`'s.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.dynamics.arguments import check_array, check_model
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes, coordinates
from rbjax.lanes import Lane, is_zero, mul, neg
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane


class GearLoss(Element):
    """Friction of gears in proportion to the torques of their motors.

    tau = -mu |tau_motor| tanh(v / v_0), with tau_motor the sum of all actuator forces on the joint,
    clipped to the joint's force range. Without controls there is no loss.

    Fields, one entry for each velocity coordinate of the joints, in their order: loss mu (n,), a
    share; smoothing v_0 (n,) rad/s or m/s, above 0. Static: `joints`, their names or indices.
    `GearLoss.of` makes it from single numbers.

    Source: Siciliano, Sciavicco, Villani & Oriolo, *Robotics*, 2009, 7.2; Gautier & Hamon, ICRA
    2011 (load-dependent friction as a linear term).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> gear = rb.forces.GearLoss.of(model, model.joint_names[:1], 0.1)
        >>> state = model.default_state().replace(v=jnp.array([1.0, 0.0]))
        >>> with_gear = rb.applied_forces(model.with_forces(gear), state, jnp.ones(1))
        >>> lost = rb.applied_forces(model, state, jnp.ones(1)) - with_gear
        >>> motor = rb.applied_forces(model, model.default_state(), jnp.ones(1))
        >>> [round(float(x), 5) for x in lost / motor[0]]
        [0.1, 0.0]
    """

    loss: jax.Array
    smoothing: jax.Array
    joints: tuple[str | int, ...] = eqx.field(static=True)
    positive = ("smoothing",)

    @classmethod
    def of(
        cls, model: Model, joints: Sequence[str | int], loss: Any, *, smoothing: Any = 1e-2
    ) -> GearLoss:
        """The losses of these joints, the same number for all or (n,) of each kind."""
        check_model("GearLoss.of", model)
        n = coordinates(model, joints)

        def column(name: str, x: Any) -> jax.Array:
            found = check_array("GearLoss.of", name, x, (), (n,))
            return jnp.broadcast_to(found.astype(model.gravity.dtype), (n,))

        return cls(column("loss", loss), column("smoothing", smoothing), tuple(joints))

    def may_be_endless(self, name: str) -> bool:
        return False

    @property
    def after_actuators(self) -> bool:
        return True

    def shapes(self, model: Model) -> Shapes:
        return dict.fromkeys(("loss", "smoothing"), (coordinates(model, self.joints),))

    def loads(self, now: Context) -> Loads:
        motors = now.driven
        loss, smoothing = (table(x, now.v.dtype) for x in (self.loss, self.smoothing))
        at = [(i, v) for j in map(now.joint, self.joints) for i, v in enumerate(j.v, j.start)]
        out: dict[int, Lane] = {}
        for n, (i, v) in enumerate(at):
            motor = motors.get(i, 0.0)
            if not is_zero(motor):
                rubbed = mul(lane(loss, n), mul(jnp.abs(motor), jnp.tanh(v / lane(smoothing, n))))
                out[i] = neg(rubbed)
        return Loads(out)
