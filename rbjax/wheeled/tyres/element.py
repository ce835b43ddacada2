"""A tyre as a force element: a wheel of a model on a plane.

The plane is through A's origin, with the normal n = z of A; it may move with a body. The wheel's
centre c is B's origin, its axle e is B's z. With cos(lean) = n . e and the height h of c, the tyre
touches at p, as far from c as the plane is along the steepest direction m in the wheel's plane:

    p = c + D m,    D = h / sin(lean),    m = (cos(lean) e - n) / sin(lean)

u is the velocity of the wheel's material point at p relative to the ground. The tyre is a spring
and a damper along m, with a short onset (`forces.joints.limits.stop_force`), and never pulls:

    depth = r - D,   depth' = -n . u / sin(lean),   N = stop_force(depth, depth') / sin(lean)

At rest under m g the depth is m g / k + onset / 2. In the plane, x = e x n / sin(lean) is the
rolling direction of a positive spin about e, and y = n x x. The tyre law gives

    F = N (n + mu_x x + mu_y y)   at p on the wheel,     -F at p on the ground

by the sliding velocity (u . x, u . y) and the rolling speed D spin, where spin is about e, without
the rotation of the wheel's plane about n. So F . u is the power of the spring less the losses. As k
and the slope of the law grow, the motion approaches that of the constraint `RollingDisc`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import instance
from rbjax.constraints.rows.geometry import Z, opposed
from rbjax.display import displayed
from rbjax.forces import Context, Element, Loads
from rbjax.forces.element import Shapes
from rbjax.forces.joints.limits import stop_energy, stop_force
from rbjax.forces.place import Place, as_place, check_places
from rbjax.lanes import Lane, Vec3
from rbjax.model import Model
from rbjax.wheeled.fields import check_ranges, number
from rbjax.wheeled.tyres.relaxation import Relaxing
from rbjax.wheeled.tyres.tyre import Pair, RollingResistance, Tyre


@displayed
class TyreContact(NamedTuple):
    """The contact of a tyre with the ground, in world axes.

    Fields:
        p: the contact point, m.
        n, x, y: the unit normal, and the unit vectors along and across the wheel in the plane.
        depth: deflection of the tyre, m.
        load: normal force, N.
        lever: distance from the wheel's centre to the plane along the wheel's disc, m.
        sliding: velocity of the tyre's surface at p along x and y, m/s.
        traction: coefficients of traction, the force along x and y divided by the load.
        rates: time derivative of the tyre state.
        spin: rate of the wheel about its axle, rad/s.
        roll_speed: speed of the rim, m/s.
    """

    p: Vec3
    n: Vec3
    x: Vec3
    y: Vec3
    depth: Lane
    load: Lane
    lever: Lane
    sliding: Pair
    traction: Pair
    rates: Any
    spin: Lane
    roll_speed: Lane


class TyreOnGround(Element):
    """Force element of the tyre of a wheel on a plane: load, traction and rolling resistance.

        F = N (n + mu_x x + mu_y y),    N = (k d + damping d') / sin(lean),    d = r - D

    D is the distance from the wheel's centre to the plane along the disc of the wheel, and lean the
    angle between axle and normal. N is smooth below the depth `onset`, and not negative.

    Its state is the state of a `Relaxing` tyre. Camber thrust and the torques about n and x are not
    included. The axle must not be normal to the plane.

    Fields:
        a: a `Place` with its origin in the plane and its z the normal on the wheel's side.
        b: a `Place` with its origin at the wheel's centre and its z the axle. A positive spin rolls
            towards axle x normal.
        tyre: a law or `Relaxing`.
        radius: r (), m.
        stiffness: k (), N/m.
        damping: (), N s/m.
        onset: (), the depth from which on the spring is linear, m.
        resistance: a `RollingResistance` or None.

    Source: Rill & Castro, *Road Vehicle Dynamics*, 2nd ed. 2020, 3.1 and 3.2.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.constraints import Place
        >>> ground, wheel = Place.on(), Place.on(body="box", axis=[0, 1, 0])
        >>> tyre = rb.wheeled.TyreOnGround(ground, wheel, rb.wheeled.Fiala(10.0, 0.8), 0.3, 1e4)
        >>> model = rb.load("free_body").with_forces(tyre)
        >>> state = model.default_state()
        >>> state = state.replace(q=state.q.at[2].set(0.29), v=state.v.at[0].set(1.0))
        >>> [round(x, 2) for x in rb.applied_forces(model, state)[:3].tolist()]  # locked, 1 cm deep
        [-79.6, 0.0, 99.5]
    """

    a: Place = eqx.field(converter=as_place)
    b: Place = eqx.field(converter=as_place)
    tyre: Tyre | Relaxing
    radius: jax.Array = number()
    stiffness: jax.Array = number()
    damping: jax.Array = number(default=0.0)
    onset: jax.Array = number(default=1e-4)
    resistance: RollingResistance | None = None

    def __check_init__(self) -> None:
        check_places(self)
        where, drag = "TyreOnGround", "RollingResistance or None"
        instance(where, "tyre", self.tyre, Tyre | Relaxing, "a tyre law or Relaxing")
        instance(where, "resistance", self.resistance, RollingResistance | None, drag)
        above = dict.fromkeys(("radius", "stiffness", "onset"), 0.0)
        check_ranges(self, above=above, least={"damping": 0.0})

    def may_be_infinite(self, name: str) -> bool:
        return False

    def shapes(self, model: Model) -> Shapes:
        return dict.fromkeys(("radius", "stiffness", "damping", "onset"), ())

    @property
    def size(self) -> int:
        return self.tyre.size

    def contact(self, context: Context) -> TyreContact:
        """Compute the contact point, load, sliding velocity and traction."""
        A, B, own = self.a.frame(context), self.b.frame(context), self._in(context)
        n, e = A.rotation @ Z, B.rotation @ Z
        away = B.position - A.position
        x, cosine = e.cross(n), n.dot(e)
        sine: Any = x.norm()
        flat = 1 / sine
        x = x * flat
        y = n.cross(x)
        lever: Any = n.dot(away) * flat
        arm = (e * cosine - n) * (lever * flat)

        turning = B.angular_velocity - A.angular_velocity
        u = B.velocity - A.velocity - A.angular_velocity.cross(away) + turning.cross(arm)
        spin: Any = turning.dot(e)
        heading: Any = (turning.dot(n) - cosine * spin) * (flat * flat)
        depth = own.radius - lever
        onset = own.stiffness, own.damping, own.onset
        load = stop_force(depth, -n.dot(u) * flat, *onset) * flat
        vx, vy = u.dot(x), u.dot(y)
        rolls = lever * (spin - cosine * heading)
        traction, rates = own.tyre.response(vx + rolls, vy, rolls, context.x)
        p = B.position + arm
        return TyreContact(p, n, x, y, depth, load, lever, (vx, vy), traction, rates, spin, rolls)

    def loads(self, context: Context) -> Loads:
        at, A, B = (
            context.once(self, lambda: self.contact(context)),
            self.a.frame(context),
            self.b.frame(context),
        )
        F = (at.n + at.x * at.traction[0] + at.y * at.traction[1]) * at.load
        torque, resistance = Vec3.zero(), self._in(context).resistance
        if resistance is not None:
            drag = resistance.torque(at.load, at.lever, at.lever * at.spin)
            torque = (B.rotation @ Z) * drag
        return opposed(B.push(F, torque, at=at.p), A.push(-F, -torque, at=at.p))

    def rate(self, context: Context) -> Any:
        return context.once(self, lambda: self.contact(context)).rates

    def energy(self, context: Context) -> Lane:
        """Compute the energy of the spring, and of the carcass of a `Relaxing` tyre."""
        at, own = context.once(self, lambda: self.contact(context)), self._in(context)
        return stop_energy(at.depth, own.stiffness, own.onset) + at.load * own.tyre.stored(
            context.x
        )

    def _in(self, context: Context) -> TyreOnGround:
        """Return a copy with parameters in the dtype of the motion."""
        return jax.tree.map(lambda x: jnp.asarray(x, context.q.dtype), self)
