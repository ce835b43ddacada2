"""Joint friction, smooth at rest: bearing friction, and gear friction proportional to load.

    bearing    tau = -[F_c + (F_s - F_c) exp(-(v / v_s)^2)] tanh(v / v_0) - d v
    gear       tau = -mu |tau_motor| tanh(v / v_0)

for each dof. F_c is the Coulomb (kinetic) friction and F_s the static (breakaway) friction. The
friction falls from F_s to F_c over the velocity v_s (Stribeck, 1902). A gear of efficiency eta
dissipates the fraction mu = 1 - eta of the transmitted torque.

Coulomb's law has a step at v = 0, which is smoothed over the velocity v_0. So a joint creeps under
a static load F, at v = v_0 artanh(F / F_s). At a speed of 3 v_0 the friction is within 0.5 % of
Coulomb's law. A motion that comes to rest under a load has an error of order v_0 from the creep;
its sliding distance has an error of order v_0^2.

The slope at rest, F_s / v_0, is a viscosity. An explicit method of step h on a joint of inertia m
is stable if h F_s / (v_0 m) is below about 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes, columns_of, coordinates
from rbjax.lanes import Lane, add, is_zero, mul, neg, sub
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane


class JointFriction(Element):
    """Dry and viscous friction of joints, smooth at rest.

    tau = -[F_c + (F_s - F_c) exp(-(v / v_s)^2)] tanh(v / v_0) - d v.

    Fields, with n the number of dofs of the joints, in the order of `joints`:
        coulomb: F_c (n,) N m or N.
        breakaway: F_s (n,) N m or N; None for F_s = F_c.
        stribeck: v_s (n,) rad/s or m/s.
        smoothing: v_0 (n,) rad/s or m/s, positive.
        viscous: d (n,) N m s/rad or N s/m.
        joints: names or indices; static.

    `JointFriction.of` accepts one value for all dofs.

    Source: Armstrong-Helouvry, Dupont & Canudas de Wit, Automatica 30, 1994, 1083-1138.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> dry = rb.forces.JointFriction.of(model, model.joint_names[:1], coulomb=2.0)
        >>> state = model.default_state().replace(v=jnp.array([1.0, 0.0]))
        >>> moving = rb.applied_forces(model.with_forces(dry), state)
        >>> (moving - rb.applied_forces(model, state)).round(6).tolist()
        [-2.0, 0.0]
    """

    coulomb: jax.Array
    breakaway: jax.Array | None
    stribeck: jax.Array
    smoothing: jax.Array
    viscous: jax.Array
    joints: tuple[str | int, ...] = eqx.field(static=True)
    positive = ("stribeck", "smoothing")
    unlimited = ()

    @classmethod
    def of(
        cls,
        model: Model,
        joints: Sequence[str | int],
        coulomb: Any,
        *,
        breakaway: Any = None,
        stribeck: Any = 0.1,
        smoothing: Any = 1e-2,
        viscous: Any = 0.0,
    ) -> JointFriction:
        """Make the friction of joints; each parameter is one number for all dofs, or (n,)."""
        given = {"coulomb": coulomb, "breakaway": breakaway, "stribeck": stribeck}
        given |= {"smoothing": smoothing, "viscous": viscous}
        return cls(**columns_of("JointFriction.of", model, joints, given), joints=tuple(joints))

    def shapes(self, model: Model) -> Shapes:
        n = coordinates(model, self.joints)
        names = ("coulomb", "breakaway", "stribeck", "smoothing", "viscous")
        return dict.fromkeys([k for k in names if getattr(self, k) is not None], (n,))

    def loads(self, context: Context) -> Loads:
        breakaway = self.coulomb if self.breakaway is None else self.breakaway
        given = (self.coulomb, breakaway, self.stribeck, self.smoothing, self.viscous)
        columns = [table(x, context.v.dtype) for x in given]
        falls = self.breakaway is not None
        tau = {
            i: _friction(v, [lane(x, n) for x in columns], falls)
            for n, (i, v) in enumerate(context.dofs(self.joints))
        }
        return Loads(tau)


def _friction(v: Lane, numbers: Sequence[Lane], falls: bool) -> Lane:
    """Compute the friction of one dof. falls: whether friction decreases with speed (Stribeck)."""
    coulomb, breakaway, v_s, v_0, viscous = numbers
    dry, extra = coulomb, sub(breakaway, coulomb) if falls else 0.0
    if not is_zero(extra):
        dry = add(dry, mul(extra, jnp.exp(-((v / v_s) ** 2))))
    if not is_zero(dry):
        dry = mul(dry, jnp.tanh(v / v_0))
    return neg(add(dry, mul(viscous, v)))


class GearLoss(Element):
    """Friction of gears in proportion to their motor torques.

    tau = -mu |tau_motor| tanh(v / v_0), with tau_motor the sum of all actuator forces on the joint,
    clipped to the joint's force range. Without controls there is no loss.

    Fields, with n the number of dofs of the joints, in the order of `joints`:
        loss: mu (n,), a fraction.
        smoothing: v_0 (n,) rad/s or m/s, positive.
        joints: names or indices; static.

    `GearLoss.of` accepts one value for all dofs.

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
    unlimited = ()

    @classmethod
    def of(
        cls, model: Model, joints: Sequence[str | int], loss: Any, *, smoothing: Any = 1e-2
    ) -> GearLoss:
        """Make the gear losses of joints. A parameter is one number for all dofs, or (n,).

        loss: the fraction of the power that the gear dissipates.
        smoothing: the speed below which the loss is smooth, rad/s or m/s.
        """
        given = {"loss": loss, "smoothing": smoothing}
        return cls(**columns_of("GearLoss.of", model, joints, given), joints=tuple(joints))

    @property
    def after_actuators(self) -> bool:
        return True

    def shapes(self, model: Model) -> Shapes:
        return dict.fromkeys(("loss", "smoothing"), (coordinates(model, self.joints),))

    def loads(self, context: Context) -> Loads:
        loss, smoothing = (table(x, context.v.dtype) for x in (self.loss, self.smoothing))
        out: dict[int, Lane] = {}
        for n, (i, v) in enumerate(context.dofs(self.joints)):
            motor = context.driven.get(i, 0.0)
            if not is_zero(motor):
                share = mul(jnp.abs(motor), jnp.tanh(v / lane(smoothing, n)))
                out[i] = neg(mul(lane(loss, n), share))
        return Loads(out)
