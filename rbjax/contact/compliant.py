"""Compliant contact: Hunt and Crossley's normal force and smooth friction, as a force element.

With the penetration x = max(-distance, 0), its rate x' = -u_n and the slip u_t,

    f_n = k x^p max(1 + d x', 0),    f_t = -mu f_n u_t / sqrt(|u_t|^2 + s^2)
The force is continuous at touch, at release and at zero slip. So adaptive solvers keep their order,
and the derivative of a bounce is not biased by the time at which a step begins. It never pulls, and
the energy never grows: d and mu take energy, k x^(p + 1) / (p + 1) is stored. For an impact of a
single mass at the speed v, without other forces, the restitution e solves

    d v - log(1 + d v) = -d e v - log(1 - d e v)
for any k, p and mass: e = 1 - 2 d v / 3 + ... at small speeds. At zero slip there is no friction: a
contact creeps down a slope of angle a at s tan(a) / sqrt(mu^2 - tan(a)^2).

Source: Hunt & Crossley, *Coefficient of restitution interpreted as damping in vibroimpact*, 1975;
Marhefka & Orin, *A compliant contact model with nonlinear damping*, 1999.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import floating_array
from rbjax.contact.geometry.candidates import PairKind, pair_contacts
from rbjax.contact.geometry.shapes import Contact, geom_shape
from rbjax.contact.impacts.impulses import check_pairs
from rbjax.contact.impacts.point_velocity import file_friction
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError
from rbjax.forces.context import Context, FrameState
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.lanes import Lane, Vec3, add, mul
from rbjax.model import Model
from rbjax.model.leaves import numbers, scalar


class CompliantContact(Element):
    """Hunt-Crossley contact with smooth friction between pairs of geoms.

    f_n = k x^p max(1 + d x', 0), f_t = -mu f_n u_t / sqrt(|u_t|^2 + s^2) at each contact. Use it
    with adaptive solvers in `simulate`, and for unbiased derivatives of bounces. Add it with
    `model.with_forces(rb.contact.CompliantContact.of(model, stiffness=1e5))`.

    Fields:
        stiffness: k (pairs,) N/m^p.
        dissipation: d (pairs,) s/m.
        friction: mu (pairs,).
        slip_speed: s () m/s, the slip at which friction is 0.7 mu f_n.
        exponent: p (), at least 1; 1.5 for spheres (Hertz).
        pairs: the two geoms of each pair, by index; static.

    `CompliantContact.of` makes the element for a model.

    Source: Hunt & Crossley 1975.

    Example:
        >>> import warnings
        >>> import rbjax as rb, jax.numpy as jnp
        >>> warnings.simplefilter("ignore")  # contacts are left out of the model's motion
        >>> ball = '''<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.1">
        ...     <joint type="slide" axis="0 0 1"/><geom size="0.1"/></body></worldbody></mujoco>'''
        >>> model = rb.load(ball, contacts=False)
        >>> contact = rb.contact.CompliantContact.of(model, stiffness=1e4, exponent=1)
        >>> model = model.with_forces(contact)
        >>> round(float(rb.applied_forces(model, rb.State([-0.01], [0.0]))[0]), 3)
        100.0
    """

    stiffness: jax.Array
    dissipation: jax.Array
    friction: jax.Array
    slip_speed: jax.Array
    exponent: jax.Array
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    positive: ClassVar[tuple[str, ...]] = ("stiffness", "slip_speed")
    unlimited: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def of(
        cls,
        model: Model,
        *,
        stiffness: Any,
        dissipation: Any = 0.0,
        friction: Any = None,
        slip_speed: Any = 1e-3,
        exponent: Any = 1.5,
        pairs: Any = None,
    ) -> CompliantContact:
        """Make the contacts of a model.

        Args:
            model: the robot, with `model.geoms`.
            stiffness: k in N/m^p, one number or one a pair (pairs,).
            dissipation: d in s/m, one number or one a pair.
            friction: mu, one number or one a pair; the friction of the geoms if None.
            slip_speed: s in m/s.
            exponent: p.
            pairs: names or indices of the geoms, two each; the pairs of the file if None.

        Raises:
            InputError: the model has a contact law, no geoms, or no pair; numbers below zero, or
                not finite.
        """
        at = "CompliantContact.of"
        check_model(at, model)
        if model.contact is not None:
            raise InputError(
                f"{at}: the model has the contact law {model.contact!r}, and the element would act "
                "in addition to it; load(contacts=False), or model.replace(contact=None)"
            )
        chosen = check_pairs(at, model, pairs)
        n, dtype = len(chosen), model.gravity.dtype
        friction = file_friction(model, chosen, dtype) if friction is None else friction
        given = {"stiffness": stiffness, "dissipation": dissipation, "friction": friction}

        def column(name: str, x: Any) -> jax.Array:
            found = floating_array(at, name, x, lambda s: s in ((), (n,)), f"() or ({n},), a pair")
            return jnp.broadcast_to(found.astype(dtype), (n,))

        columns = {name: column(name, x) for name, x in given.items()}
        one = {
            name: floating_array(at, name, x, lambda s: s == (), "()").astype(dtype)
            for name, x in (("slip_speed", slip_speed), ("exponent", exponent))
        }
        return cls(**columns, **one, pairs=chosen)

    def __check_init__(self) -> None:
        for name, least in (("dissipation", 0.0), ("friction", 0.0), ("exponent", 1.0)):
            x = getattr(self, name)
            if not isinstance(x, jax.core.Tracer) and not (jnp.asarray(x) >= least).all():
                raise InputError(
                    f"CompliantContact({name}=...): got {x}, expected numbers not below {least:g}"
                )

    @property
    def contact_pairs(self) -> set[frozenset[int]]:
        """The pairs of geoms between which it acts, in no order."""
        return {frozenset(pair) for pair in self.pairs}

    def shapes(self, model: Model) -> Shapes:
        n = (len(self.pairs),)
        return {
            "stiffness": n, "dissipation": n, "friction": n, "slip_speed": (), "exponent": (),
        }  # fmt: skip

    def loads(self, now: Context) -> Loads:
        out, dtype = Loads(), now.q.dtype
        columns = [numbers(x, dtype) for x in (self.stiffness, self.dissipation, self.friction)]
        for i, (a, b, contacts) in enumerate(self._contacts(now)):
            k, d, mu = (column[i] for column in columns)
            for contact in contacts:
                out = out + self._push(a, b, contact, k, d, mu, dtype)
        return out

    def energy(self, now: Context) -> Lane:
        """Compute the stored energy, the sum of k x^(p + 1) / (p + 1) over penetrations x, J."""
        total: Lane = 0.0
        p = scalar(self.exponent, now.q.dtype)
        for k, (_, _, contacts) in zip(
            numbers(self.stiffness, now.q.dtype), self._contacts(now), strict=True
        ):
            for contact in contacts:
                x = _penetration(contact)
                total = add(total, mul(k / (p + 1.0), mul(x, _power(x, p))))
        return total

    def _contacts(self, now: Context) -> list[tuple[FrameState, FrameState, list[Contact]]]:
        """Return the two bodies and the candidate contacts of each pair."""
        geoms, dtype = now.model.geoms, now.q.dtype
        if geoms is None:
            raise InputError("CompliantContact: the model has no geoms")
        reach = jnp.asarray(0.0, dtype)
        out = []
        for pair in self.pairs:
            a, b = bodies = [now.body(geoms.bodies[g]) for g in pair]
            one, other = (
                geom_shape(now.model, g, body.pose, dtype)
                for g, body in zip(pair, bodies, strict=True)
            )
            kind = PairKind.of(geoms, pair)
            out.append((a, b, pair_contacts(kind, one, other, reach, geoms.heights)))
        return out

    def _push(
        self, a: FrameState, b: FrameState, contact: Contact, k: Lane, d: Lane, mu: Lane, dtype: Any
    ) -> Loads:
        """Return the loads of one contact: the force on body b at the contact, and its reaction on
        a.

        k, d, mu: stiffness, damping and friction coefficient of the contact.
        """
        n, at = contact.normal, contact.position
        u = _velocity(b, at) - _velocity(a, at)
        rate = n.dot(u)  # of the distance
        slip = u - n * rate
        normal = k * _power(_penetration(contact), scalar(self.exponent, dtype))
        normal = mul(normal, jnp.maximum(1.0 - d * rate, 0.0))
        s = scalar(self.slip_speed, dtype)
        share = mu * normal / jnp.sqrt(slip.dot(slip) + s * s)
        force = n * normal - slip * share
        return b.push(force, at=at) + a.push(-force, at=at)


def _velocity(body: FrameState, at: Vec3) -> Vec3:
    """Return the velocity of the point of a body that is now at a point of the world."""
    return body.velocity + body.angular_velocity.cross(at - body.position)


def _penetration(contact: Contact) -> Lane:
    """Return the penetration max(-distance, 0) of a contact, m; zero if the candidate is not a
    contact."""
    return jnp.where(contact.exists, jnp.maximum(-contact.distance, 0.0), 0.0)


def _power(x: Lane, p: Lane) -> Lane:
    """Return x^p for x >= 0 and p >= 1, with finite derivatives at zero."""
    some = x > 0
    return jnp.where(some, jnp.where(some, x, 1.0) ** p, 0.0)
