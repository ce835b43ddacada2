"""Springs and dampers between two frames: along the line of two points, or in all six directions.

Two points at the distance l, with u the direction from a to b and l' = u . (v_b - v_a):

    x = l - l_high  if l > l_high,    l - l_low  if l < l_low,    else 0
    F = x (k_0 + k_1 x + k_2 x^2 + ...) + l' (d_0 + d_1 |l'| + d_2 |l'|^2 + ...)

F pulls a along u and b against u. Between l_low and l_high the spring is slack; with l_low = 0 it
is a rope. Its energy is V = x^2 (k_0 / 2 + k_1 x / 3 + k_2 x^2 / 4 + ...). At l = 0 the direction
is undefined and the force is set to 0. For l_high = 0 the force has no singularity, F u = (k_0 +
k_1 l + ...) (p_b - p_a), and is computed in this form.

Two frames, in the axes of a: d is the vector from the origin of a to the origin of b, R = exp(phi)
the attitude of b, and w and d' are the velocities of b relative to a:

    force on b at its origin:   f = -K_l d - D_l d'
    torque on b:                n = -J_l(phi)^-T K_a phi - D_a w

The opposite force and torque act on a, at the same point. J_l is the left Jacobian of SO(3),
phi' = J_l^-1 w, so the spring has the energy V = (d . K_l d + phi . K_a phi) / 2 at any angle. With
equal angular stiffnesses J_l^-T phi = phi. At |phi| = pi the axis is not defined.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.dynamics.arguments import check_array, shape_of
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.forces.joints.polynomials import polynomial
from rbjax.forces.place import Place, as_place, check_places
from rbjax.forces.reach import distance
from rbjax.lanes import Lane, Mat3, Vec3, add, inner, is_literal, is_zero, mul, sub
from rbjax.model import Model
from rbjax.model.leaves import numbers
from rbjax.rotations import quaternion
from rbjax.rotations.coefficients import inverse_left_lanes, where


class PointSpring(Element):
    """A spring and a damper between two points of bodies or of the world.

    F = x (k_0 + k_1 x + ...) + l' (d_0 + d_1 |l'| + ...), x beyond the slack [l_low, l_high].

    Fields:
        a, b: the ends, `Place`s.
        stiffness: k (s,) N/m, N/m^2, ...
        damping: d (c,) N s/m, N s^2/m^2, ...
        slack: (2,) m, the lengths between which the spring is slack.

    `PointSpring.of` makes a spring from scalars.

    Source: MuJoCo, XML reference, tendon spatial (stiffness, damping, springlength).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("quadrotor")
        >>> tether = rb.forces.PointSpring.of(
        ...     rb.forces.Place.on(point=[0.0, 0.0, 10.0]), rb.forces.Place.on(body=0),
        ...     stiffness=3.0, length=9.0,
        ... )
        >>> model, state = model.with_forces(tether), model.default_state()
        >>> height = float(state.q[2])
        >>> bool(abs(rb.applied_forces(model, state)[2] - 3 * (10 - height - 9)) < 1e-5)
        True
    """

    a: Place = eqx.field(converter=as_place)
    b: Place = eqx.field(converter=as_place)
    stiffness: jax.Array
    damping: jax.Array
    slack: jax.Array
    unlimited = ("slack",)

    @classmethod
    def of(
        cls, a: Place, b: Place, *, stiffness: Any = 0.0, damping: Any = 0.0, length: Any = 0.0
    ) -> PointSpring:
        """Make a spring with a length at rest, or two lengths between which it is slack."""
        at, given = "PointSpring.of", {"stiffness": stiffness, "damping": damping}
        row = {n: (max(1, *shape_of(at, n, x), 1),) for n, x in given.items()}
        k, d = (check_array(at, n, x, (), row[n]) for n, x in given.items())
        slack = check_array(at, "length", length, (), (2,))
        k, d, slack = (x.astype(float) for x in (k, d, slack))
        return cls(a, b, jnp.atleast_1d(k), jnp.atleast_1d(d), jnp.broadcast_to(slack, (2,)))

    def __check_init__(self) -> None:
        check_places(self)

    def shapes(self, model: Model) -> Shapes:
        return {"stiffness": (None,), "damping": (None,), "slack": (2,)}

    def loads(self, context: Context) -> Loads:
        a, b, dtype = self.a.point(context), self.b.point(context), context.q.dtype
        k, d = coefficients(self.stiffness, dtype), coefficients(self.damping, dtype)
        springy, damped = (not all(map(is_zero, c)) for c in (k, d))
        if not (springy or damped):
            return Loads()
        line = b.position - a.position
        length, inverse = distance(line, dtype)
        scale: Lane = 0.0  # F / l
        if springy:
            x, x_over_l = stretch(length, inverse, self.slack, dtype)
            scale = mul(add(k[0], polynomial(k[1:], x)), x_over_l)
        if damped:
            rate = mul((b.velocity - a.velocity).dot(line), inverse)
            speed = jnp.abs(rate) if len(d) > 1 else 0.0
            scale = add(scale, mul(mul(add(d[0], polynomial(d[1:], speed)), rate), inverse))
        force = line * scale
        return a.push(force) + b.push(-force)

    def energy(self, context: Context) -> Lane:
        """Compute the energy x^2 (k_0 / 2 + k_1 x / 3 + ...) of the stretch x, J."""
        k = coefficients(self.stiffness, context.q.dtype)
        if all(map(is_zero, k)):
            return 0.0
        line = self.b.point(context).position - self.a.point(context).position
        x, _ = stretch(*distance(line, context.q.dtype), self.slack, context.q.dtype)
        return stretch_energy(k, x)


def stretch_energy(k: list[Lane], x: Lane) -> Lane:
    """Compute the energy x^2 (k_0 / 2 + k_1 x / 3 + ...) of the stretch x, J."""
    shares = [mul(1 / n, c) for n, c in enumerate(k, 2)]
    return mul(add(shares[0], polynomial(shares[1:], x)), x * x)


def stretch(length: Lane, inverse: Lane, slack: jax.Array, dtype: Any) -> tuple[Lane, Lane]:
    """Compute the stretch x beyond the slack (2,) and the ratio x / l, from the length and its
    inverse. The ratio is 1 at l = 0 if l_high is 0."""
    low, high = numbers(slack, dtype)
    x, ratio = sub(length, high), sub(1.0, mul(high, inverse))
    if is_literal(low) and is_literal(high) and low == high:
        return x, ratio
    shorter, short_ratio = sub(length, low), sub(1.0, mul(low, inverse))
    nothing = jnp.zeros_like(length)
    x = where(length > high, x, where(length < low, shorter, nothing))
    return x, where(length > high, ratio, where(length < low, short_ratio, nothing))


def coefficients(x: jax.Array, dtype: Any) -> list[Lane]:
    """Return the coefficients (n,) of a polynomial without trailing structural zeros."""
    found = numbers(x, dtype)
    while len(found) > 1 and is_zero(found[-1]):
        found.pop()
    return found


class Bushing(Element):
    """A spring and a damper in all directions between two frames, at rest if the frames coincide.

    f = -K_l d - D_l d', n = -J_l^-T K_a phi - D_a w on b, in the axes of a.

    Fields:
        a, b: the frames, `Place`s. Their orientations set the axes and the attitude at rest.
        stiffness: (6,), N m/rad about the axes of a, then N/m along them.
        damping: (6,), N m s/rad and N s/m.

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

    a: Place = eqx.field(converter=as_place)
    b: Place = eqx.field(converter=as_place)
    stiffness: jax.Array
    damping: jax.Array
    unlimited = ()

    @classmethod
    def of(cls, a: Place, b: Place, *, stiffness: Any = 0.0, damping: Any = 0.0) -> Bushing:
        """Make a bushing from six stiffnesses and six dampings, or one value for all six."""
        given = {"stiffness": stiffness, "damping": damping}
        k, d = (check_array("Bushing.of", n, x, (), (6,)) for n, x in given.items())
        return cls(a, b, *(jnp.broadcast_to(x.astype(float), (6,)) for x in (k, d)))

    def __check_init__(self) -> None:
        check_places(self)

    def shapes(self, model: Model) -> Shapes:
        return {"stiffness": (6,), "damping": (6,)}

    def loads(self, context: Context) -> Loads:
        a, b = self.a.frame(context), self.b.frame(context)
        k, d = numbers(self.stiffness, context.q.dtype), numbers(self.damping, context.q.dtype)
        E, line = a.rotation.T, b.position - a.position
        torque, force = Vec3.zero(), (E @ line).entrywise(k[3:])
        if not all(map(is_zero, k[:3])):
            phi = _rotation_vector(E @ b.rotation)
            back = Mat3(*inverse_left_lanes([-x for x in phi]))  # J_l^-T
            torque = back @ phi.entrywise(k[:3])
        if not all(map(is_zero, d)):
            turning = b.angular_velocity - a.angular_velocity
            moving = b.velocity - a.velocity - a.angular_velocity.cross(line)
            torque = torque + (E @ turning).entrywise(d[:3])
            force = force + (E @ moving).entrywise(d[3:])
        torque, force = a.rotation @ torque, a.rotation @ force
        return a.push(force, torque, at=b.position) + b.push(-force, -torque)

    def energy(self, context: Context) -> Lane:
        """Compute the potential energy of the bushing, J."""
        a, b, k = (
            self.a.frame(context),
            self.b.frame(context),
            numbers(self.stiffness, context.q.dtype),
        )
        E = a.rotation.T
        way, turns = E @ (b.position - a.position), not all(map(is_zero, k[:3]))
        phi = _rotation_vector(E @ b.rotation) if turns else Vec3.zero()
        pairs = zip(k, [*phi, *way], strict=True)
        return mul(0.5, inner(*zip(*((mul(s, x), x) for s, x in pairs), strict=True)))


def _rotation_vector(R: Mat3) -> Vec3:
    return Vec3(*quaternion.log_lanes(quaternion.from_matrix_lanes([jnp.asarray(x) for x in R])))
