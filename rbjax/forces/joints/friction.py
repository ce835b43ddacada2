"""Friction in the joints: Coulomb's, Stribeck's and viscous, smooth at rest.

    tau = -[F_c + (F_s - F_c) exp(-(v / v_s)^2)] tanh(v / v_0) - d v

for each velocity coordinate. F_c is what sliding costs at any speed, F_s what breaking away costs;
between the two the friction falls with the speed (Stribeck, 1902), over v_s. Coulomb's law has a
step at v = 0, where it holds whatever does not exceed F_s. Here the step is as wide as v_0: a joint
under a load F that it should hold creeps at v = v_0 artanh(F / F_s), and at a speed of 3 v_0 the
friction is right to half a percent. So a motion that comes to rest under a load is wrong by order
v_0, from the creep; how far it slides until then is wrong by order v_0^2.

The slope at rest, F_s / v_0, is a viscosity: an explicit method of step h follows it while
h F_s / (v_0 m) is below about 2, m being the joint's inertia.
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
from rbjax.lanes import Lane, add, is_zero, mul, neg, sub
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane


class JointFriction(Element):
    """Dry and viscous friction of joints, smooth at rest.

    tau = -[F_c + (F_s - F_c) exp(-(v / v_s)^2)] tanh(v / v_0) - d v.

    Fields, one entry for each velocity coordinate of the joints, in their order: coulomb F_c (n,)
    N m or N; breakaway F_s (n,) N m or N, None for F_s = F_c; stribeck v_s (n,) rad/s or m/s;
    smoothing v_0 (n,) rad/s or m/s, above 0; viscous d (n,) N m s/rad or N s/m. Static: `joints`,
    their names or indices. `JointFriction.of` makes it from single numbers.

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
        """The friction of these joints, with the same numbers for all or (n,) of each kind."""
        check_model("JointFriction.of", model)
        n = coordinates(model, joints)

        def column(name: str, x: Any) -> jax.Array:
            found = check_array("JointFriction.of", name, x, (), (n,))
            return jnp.broadcast_to(found.astype(model.gravity.dtype), (n,))

        return cls(
            coulomb=column("coulomb", coulomb),
            breakaway=None if breakaway is None else column("breakaway", breakaway),
            stribeck=column("stribeck", stribeck),
            smoothing=column("smoothing", smoothing),
            viscous=column("viscous", viscous),
            joints=tuple(joints),
        )

    def may_be_endless(self, name: str) -> bool:
        return False

    def shapes(self, model: Model) -> Shapes:
        n = coordinates(model, self.joints)
        names = ("coulomb", "breakaway", "stribeck", "smoothing", "viscous")
        return dict.fromkeys([k for k in names if getattr(self, k) is not None], (n,))

    def loads(self, now: Context) -> Loads:
        breakaway = self.coulomb if self.breakaway is None else self.breakaway
        given = (self.coulomb, breakaway, self.stribeck, self.smoothing, self.viscous)
        columns = [table(x, now.v.dtype) for x in given]
        at = [(i, v) for j in map(now.joint, self.joints) for i, v in enumerate(j.v, j.start)]
        rows = [[lane(x, n) for x in columns] for n in range(len(at))]
        falls = self.breakaway is not None
        tau = {i: _friction(v, row, falls) for (i, v), row in zip(at, rows, strict=True)}
        return Loads(tau)


def _friction(v: Lane, numbers: Sequence[Lane], falls: bool) -> Lane:
    """The friction of one coordinate. `falls`: whether it decreases with speed after break-away."""
    coulomb, breakaway, v_s, v_0, viscous = numbers
    dry, extra = coulomb, sub(breakaway, coulomb) if falls else 0.0
    if not is_zero(extra):
        dry = add(dry, mul(extra, jnp.exp(-((v / v_s) ** 2))))
    if not is_zero(dry):
        dry = mul(dry, jnp.tanh(v / v_0))
    return neg(add(dry, mul(viscous, v)))
