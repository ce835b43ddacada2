"""A bushing: a spring and a damper in all six directions between two frames.

With the frames a and b, everything in the axes of a: d the way from a's origin to b's, R = exp(phi)
the attitude of b, and w and d' the velocities of b that an observer on a sees,

    force on b at its origin:   f = -K_l d - D_l d'
    torque on b:                n = -J_l(phi)^-T K_a phi - D_a w

and the opposite on a, at the same point. J_l is the left Jacobian of SO(3), phi' = J_l^-1 w, which
gives the spring an energy, V = (d . K_l d + phi . K_a phi) / 2, however far it turns; with equal
angular stiffnesses J_l drops out, because J_l^-T phi = phi. At |phi| = pi the axis is not defined.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.arguments import check_array
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.forces.place import Place, check_places
from rbjax.lanes import Lane, Mat3, Vec3, inner, is_zero, mul
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.rotations import quaternion
from rbjax.rotations.coefficients import inverse_left_lanes


class Bushing(Element):
    """A spring and a damper in all directions between two frames, at rest where these coincide.

    f = -K_l d - D_l d', n = -J_l^-T K_a phi - D_a w on b, in the axes of a.

    Fields: a, b, `Place`s with their frames; stiffness (6,), about the axes of a in N m/rad and
    along them in N/m; damping (6,) in N m s/rad and N s/m. Orientations of the
    frames turn the axes, or the attitude at rest.

    Source: Ambrosio & Verissimo, *Improved bushing models for general multibody systems*, Multibody
    Syst. Dyn. 22, 2009, 341-365; the torque's Jacobian is Sola's, arXiv:1812.01537, eq. 146.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("free_body")
        >>> A = rb.forces.Place
        >>> mount = rb.forces.Bushing.of(A.on(), A.on(body=0), stiffness=[5, 5, 5, 100, 100, 100])
        >>> state = model.default_state()
        >>> state = state.replace(q=state.q.at[:3].set(jnp.array([0.1, 0.0, 0.0])))
        >>> rb.applied_forces(model.with_forces(mount), state)[:1].round(5).tolist()
        [-10.0]
    """

    a: Place
    b: Place
    stiffness: jax.Array
    damping: jax.Array

    @classmethod
    def of(cls, a: Place, b: Place, *, stiffness: Any = 0.0, damping: Any = 0.0) -> Bushing:
        """The bushing with these six numbers of each kind, or one for all."""
        given = {"stiffness": stiffness, "damping": damping}
        k, d = (check_array("Bushing.of", n, x, (), (6,)) for n, x in given.items())
        return cls(a, b, *(jnp.broadcast_to(x.astype(float), (6,)) for x in (k, d)))

    def __check_init__(self) -> None:
        check_places(self)

    def may_be_endless(self, name: str) -> bool:
        return False

    def shapes(self, model: Model) -> Shapes:
        return {"stiffness": (6,), "damping": (6,)}

    def loads(self, now: Context) -> Loads:
        a, b = self.a.frame(now), self.b.frame(now)
        k, d = self._numbers(self.stiffness, now), self._numbers(self.damping, now)
        E, line = a.rotation.T, b.position - a.position
        torque, force = Vec3.zero(), _scaled(k[3:], E @ line)
        if not all(map(is_zero, k[:3])):
            phi = _turn(E @ b.rotation)
            back = Mat3(*inverse_left_lanes([-x for x in phi]))  # J_l^-T
            torque = back @ _scaled(k[:3], phi)
        if not all(map(is_zero, d)):
            turning = b.angular_velocity - a.angular_velocity
            moving = b.velocity - a.velocity - a.angular_velocity.cross(line)
            torque = torque + _scaled(d[:3], E @ turning)
            force = force + _scaled(d[3:], E @ moving)
        torque, force = a.rotation @ torque, a.rotation @ force
        return a.push(force, torque, at=b.position) + b.push(-force, -torque)

    def energy(self, now: Context) -> Lane:
        """(d . K_l d + phi . K_a phi) / 2."""
        a, b, k = self.a.frame(now), self.b.frame(now), self._numbers(self.stiffness, now)
        E = a.rotation.T
        way = E @ (b.position - a.position)
        phi = _turn(E @ b.rotation) if not all(map(is_zero, k[:3])) else Vec3.zero()
        pairs = zip(k, [*phi, *way], strict=True)
        return mul(0.5, inner(*zip(*((mul(s, x), x) for s, x in pairs), strict=True)))

    def _numbers(self, numbers: jax.Array, now: Context) -> list[Lane]:
        known = table(numbers, now.q.dtype)
        return [lane(known, i) for i in range(6)]


def _scaled(k: list[Lane], x: Vec3) -> Vec3:
    return Vec3(*map(mul, k, x))


def _turn(R: Mat3) -> Vec3:
    """The rotation vector of a matrix."""
    return Vec3(*quaternion.log_lanes(quaternion.from_matrix_lanes([jnp.asarray(x) for x in R])))
