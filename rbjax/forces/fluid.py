"""Fluid forces on bodies: drag on the inertia box of a body; drag, lift and added mass of
ellipsoids.

v is the velocity of the center relative to the fluid and w the angular velocity, in the axes of the
box or ellipsoid (MuJoCo documentation, *Fluid forces*).

Box:
    s_i = sqrt(6 (I_j + I_k - I_i) / m),   d = (s_1 + s_2 + s_3) / 3
    f_i = -(3 pi mu d + rho s_j s_k |v_i| / 2) v_i
    n_i = -(pi mu d^3 + rho s_i (s_j^4 + s_k^4) |w_i| / 64) w_i
s are the edges of the uniform box with the mass m and principal moments I of the body. The box
follows the model's masses, centers and inertias. Its axes are parameters of the element, and their
dependence on the inertia is not differentiated. I_i are the diagonal of the inertia in these axes,
which has the same derivative as the principal moments.

Ellipsoid:
    added mass   f = p x w,  n = p x v + h x w,     p_i = rho m_i v_i,  h_i = rho J_i w_i
    drag         f = -(3 pi mu D + rho |v| (c_b A + c_s (A_max - A))) v
    angular drag n = -(pi mu D^3 + rho |g|) w,      g_i = (c_a I_i + c_s (I_max - I_i)) w_i
    Magnus lift  f = c_m rho V w x v
    Kutta lift   f = c_k rho A cos(alpha) |v|^2 (n x u) x u
r are the semi-axes, V is the volume, D = 2 (r_1 + r_2 + r_3) / 3. A is the projected area along
u = v / |v|, and n = N / |N| is the normal of the cross-section with this outline:
    N_i = (r_j r_k)^2 u_i,   A = pi |N| / sqrt(N . u),   cos(alpha) = n . u
I_i = 8 pi / 15 r_i max(r_j, r_k)^4 are moments of drag, A_max and I_max the largest area and
moment. At rest u is undefined, and all forces and their derivatives except the viscous ones are
zero. The acceleration term of the added mass is left out, as in MuJoCo.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.forces.context import Context, FrameState, frames_of, on_each
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.forces.slopes import Slope
from rbjax.lanes import Lane, Mat3, Vec3, add, is_zero, mul, neg, quaternion_matrix, safe_sqrt
from rbjax.model import WORLD, Model
from rbjax.model.leaves import table, tables
from rbjax.model.links import lane
from rbjax.rotations import quaternion
from rbjax.spatial import Force, Motion, Transform

#: MuJoCo's lower limit of divisors and radicands
LEAST = 1e-15


class InertiaBoxFluid(Element):
    """Fluid drag on bodies, as on boxes with their masses and inertias.

    f_i = -(3 pi mu d + rho s_j s_k |v_i| / 2) v_i, and a torque of the same form, for a box with
    edges s.

    density: rho () kg/m^3.
    viscosity: mu () Pa s.
    wind: (3,) m/s, velocity of the fluid in the world.
    orientation: (n, 4) quaternions of the boxes' axes in the bodies' frames, computed by
        `InertiaBoxFluid.of`.
    bodies: index of each body; static.

    Source: MuJoCo documentation, *Fluid forces*, inertia model.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("free_body")
        >>> air = rb.forces.InertiaBoxFluid.of(model, density=1.2, wind=(3.0, 0.0, 0.0))
        >>> state = model.default_state()
        >>> bool(rb.applied_forces(model.with_forces(air), state)[0] > 0)
        True
    """

    density: jax.Array
    viscosity: jax.Array
    wind: jax.Array
    orientation: jax.Array
    bodies: tuple[int, ...] = eqx.field(static=True)

    def shapes(self, model: Model) -> Shapes:
        shared = {"density": (), "viscosity": (), "wind": (3,)}
        return shared | {"orientation": (len(self.bodies), 4)}

    @classmethod
    def of(
        cls,
        model: Model,
        *,
        density: Any = 0.0,
        viscosity: Any = 0.0,
        wind: Any = (0.0, 0.0, 0.0),
        bodies: Sequence[str] | None = None,
    ) -> InertiaBoxFluid:
        """Make the fluid around bodies of a model.

        bodies: names of the bodies; None for all bodies that can move.
        density: kg/m^3. viscosity: Pa s. wind: (3,) velocity of the fluid in the world, m/s.
        """
        top, dtype = model.topology, model.bodies.mass.dtype
        if bodies is None:
            some = [b for b, k in enumerate(top.body_links) if k != WORLD]
            index = [b for b in some if model.bodies.mass[b] >= LEAST]
        else:
            index = [model.body(name) for name in bodies]
        inertia = np.asarray(model.bodies.inertia, np.float64)[np.array(index, int)]
        axes = np.linalg.eigh(inertia)[1]
        axes[:, :, 2] = np.cross(axes[:, :, 0], axes[:, :, 1])
        orientation = jax.vmap(quaternion.from_matrix)(jnp.asarray(axes, dtype))
        rho, mu, wind = (jnp.asarray(x, dtype) for x in (density, viscosity, wind))
        return cls(rho, mu, wind, orientation, tuple(index))

    def loads(self, context: Context) -> Loads:
        """Compute the drag on the box of each body."""
        return _loads(context, self.wind, self.bodies, *self._boxes(context))

    def slopes(self, context: Context) -> list[Slope]:
        """Compute the damping of each box."""
        return _slopes(context, self.wind, self.bodies, *self._boxes(context))

    def _boxes(self, context: Context) -> tuple[Mat3, Any, _Drag]:
        """Return axes, centers and drag of the boxes."""
        axes = rotations(table(self.orientation, context.q.dtype))
        return axes, context.model.bodies.com[np.array(self.bodies)], self._drag(context)

    def _drag(self, context: Context) -> _Drag:
        """Compute the drag coefficients of all boxes. Each lane is an array over the bodies."""
        bodies, index = context.model.bodies, np.array(self.bodies)
        own = bodies.mass[index], bodies.inertia[index], self.orientation
        xp, found = tables(context.q.dtype, *own, self.density, self.viscosity)
        mass, inertia, orientation, rho, mu = found
        full = Mat3(*(inertia[:, i, j] for i in range(3) for j in range(3)))
        moments = Vec3(*(axis.dot(full @ axis) for axis in rotations(orientation).columns))
        trace = moments[0] + moments[1] + moments[2]
        tiny = 10 * np.finfo(mass.dtype).eps * trace  # rounding error of a flat box
        edges = []
        for moment in moments:
            twice = trace - 2.0 * moment
            solid = xp.where(twice > tiny, twice, 0.0)
            edges.append(xp.sqrt(6.0 * xp.maximum(LEAST, solid) / mass))
        a, b, c = edges
        d = (a + b + c) / 3.0
        a4, b4, c4 = (x * x * x * x for x in edges)
        return _Drag(
            viscous_force=3.0 * math.pi * mu * d,
            viscous_torque=math.pi * mu * d * d * d,
            force=Vec3(b * c, c * a, a * b) * (rho / 2.0),
            torque=Vec3(a * (b4 + c4), b * (c4 + a4), c * (a4 + b4)) * (rho / 64.0),
        )


class _Drag(NamedTuple):
    """Drag coefficients of inertia boxes: viscous, and quadratic along each axis."""

    viscous_force: Lane
    viscous_torque: Lane
    force: Vec3
    torque: Vec3

    def wrench(self, V: Motion) -> Force:
        """Compute the drag on a box at a twist relative to the fluid."""
        torque = _against(V.ang, self.viscous_torque, self.torque)
        return Force(torque, _against(V.lin, self.viscous_force, self.force))


def _against(u: Vec3, viscous: Lane, quadratic: Vec3) -> Vec3:
    """Compute the drag -(viscous + quadratic_i |u_i|) u_i along each axis i."""
    return -Vec3(*(mul(add(viscous, mul(c, abs(x))), x) for x, c in zip(u, quadratic, strict=True)))


def relative_twist(frame: FrameState, wind: Vec3) -> Motion:
    """Compute the twist of a frame relative to a fluid that flows at `wind` without rotation."""
    V = frame.twist
    if all(map(is_zero, wind)):
        return V
    return Motion(V.ang, V.lin - frame.rotation.T @ wind)


def _loads(
    context: Context, wind: Any, bodies: Sequence[int], axes: Mat3, position: Any, own: Any
) -> Loads:
    """Compute the loads of the wrenches `own.wrench(V)` on shapes of bodies, at their twists V in
    the fluid."""
    flow = in_lanes(wind, context)

    def acted(frame: FrameState, axes: Mat3, position: Vec3, own: Any) -> Loads:
        here = frame.then(Transform(axes, position))
        return here.push_own(own.wrench(relative_twist(here, flow)))

    return on_each(context, bodies, acted, axes, position, own)


def _slopes(
    context: Context, wind: Any, bodies: Sequence[int], axes: Mat3, position: Any, own: Any
) -> list[Slope]:
    """Compute the damping of the same wrenches."""
    flow, out = in_lanes(wind, context), list[Slope]()
    for frame, (turn, at, one) in frames_of(context, bodies, axes, position, own):
        here = frame.then(Transform(turn, at))
        out += wrench_slopes(here, one.wrench, relative_twist(here, flow), context.q.dtype)
    return out


def wrench_slopes(
    frame: FrameState, wrench: Callable[[Motion], Force], V: Motion, dtype: Any
) -> list[Slope]:
    """Compute the damping of a wrench on a frame that depends on its twist V, in frame axes."""
    at = [jnp.asarray(x, dtype) for x in V]
    units = [[1.0 if k == n else 0.0 for k in range(6)] for n in range(6)]
    rows = [frame.arms(Force.from_lanes(unit)) for unit in units]

    def force(*V: Lane) -> list[Lane]:
        return [jnp.asarray(x, dtype) for x in wrench(Motion(Vec3(*V[:3]), Vec3(*V[3:])))]

    out = []
    for b, unit in enumerate(units):
        rates = jax.jvp(force, at, [jnp.asarray(x, dtype) for x in unit])[1]
        out += [Slope(rows[a], 0.0, neg(rate), rows[b]) for a, rate in enumerate(rates)]
    return out


def rotations(orientation: Any) -> Mat3:
    """Convert quaternions (n, 4) to rotation matrices whose lanes are columns."""
    return quaternion_matrix(*(orientation[:, k] for k in range(4)))


def in_lanes(vector: Any, context: Context) -> Vec3:
    """Convert a vector (3,) of an element to lanes."""
    x = table(vector, context.q.dtype)
    return Vec3(*(lane(x, k) for k in range(3)))


class EllipsoidFluid(Element):
    """Fluid forces on ellipsoids fixed to bodies: drag, lift and added mass.

    f = -(3 pi mu D + rho |v| (c_b A + c_s (A_max - A))) v + c_m rho V w x v + Kutta lift + p x w,
    and a torque of the same form.

    density: rho () kg/m^3.
    viscosity: mu () Pa s.
    wind: (3,) m/s, velocity of the fluid in the world.
    semi_axes, position, orientation: (n, 3) m, (n, 3) m and (n, 4) in the body's frame.
    blunt_drag, slender_drag, angular_drag, kutta_lift, magnus_lift: (n,) coefficients.
    virtual_mass, virtual_inertia: (n, 3) m^3, m^5, added mass over density along the axes. It does
        not follow the semi-axes.
    interaction: (n,) factor of all forces.
    bodies: index of the body of each ellipsoid; static.

    Source: MuJoCo documentation, *Fluid forces*, ellipsoid model.

    Example:
        >>> import rbjax as rb, jax
        >>> ball = '''<mujoco><option density="1.2" wind="5 0 0"/><worldbody><body><freejoint/>
        ...   <geom size="0.1" fluidshape="ellipsoid"/></body></worldbody></mujoco>'''
        >>> model = rb.load(ball)
        >>> (air,) = model.forces
        >>> air.blunt_drag.tolist(), air.semi_axes.tolist()
        ([0.5], [[0.1, 0.1, 0.1]])
        >>> round(float(rb.applied_forces(model, model.default_state())[0]), 4)  # rho v^2 A / 2
        0.4712
    """

    density: jax.Array
    viscosity: jax.Array
    wind: jax.Array
    semi_axes: jax.Array
    position: jax.Array
    orientation: jax.Array
    blunt_drag: jax.Array
    slender_drag: jax.Array
    angular_drag: jax.Array
    kutta_lift: jax.Array
    magnus_lift: jax.Array
    virtual_mass: jax.Array
    virtual_inertia: jax.Array
    interaction: jax.Array
    bodies: tuple[int, ...] = eqx.field(static=True)

    def shapes(self, model: Model) -> Shapes:
        n, shared = len(self.bodies), {"density": (), "viscosity": (), "wind": (3,)}
        rows = {"semi_axes": (n, 3), "position": (n, 3), "orientation": (n, 4)}
        return shared | rows | dict.fromkeys(("virtual_mass", "virtual_inertia"), (n, 3))

    def loads(self, context: Context) -> Loads:
        """Compute the forces on each ellipsoid."""
        return _loads(context, self.wind, self.bodies, *self._placed(context))

    def slopes(self, context: Context) -> list[Slope]:
        """Compute the damping of each ellipsoid."""
        return _slopes(context, self.wind, self.bodies, *self._placed(context))

    def dissipative_slopes(self, context: Context) -> list[Slope]:
        """Compute the damping of the drag, without lift and added mass."""
        lift = dict[str, Any](kutta=0.0, magnus=0.0, mass=Vec3.zero(), inertia=Vec3.zero())
        axes, position, own = self._placed(context)
        return _slopes(context, self.wind, self.bodies, axes, position, own._replace(**lift))

    def _placed(self, context: Context) -> tuple[Mat3, Any, _Ellipsoid]:
        """Return axes, positions and force coefficients of the ellipsoids."""
        axes = rotations(table(self.orientation, context.q.dtype))
        return axes, self.position, self._ellipsoids(context)

    def _ellipsoids(self, context: Context) -> _Ellipsoid:
        """Compute the force coefficients. Each lane is an array over the ellipsoids."""
        drags = self.blunt_drag, self.slender_drag, self.angular_drag
        lifts = self.kutta_lift, self.magnus_lift
        fluid = self.virtual_mass, self.virtual_inertia, self.density, self.viscosity
        own = self.semi_axes, self.interaction
        xp, found = tables(context.q.dtype, *own, *drags, *lifts, *fluid)
        semi_axes, scale, blunt, slender, angular, kutta, magnus, *virtual, rho, mu = found
        a, b, c = r = [semi_axes[:, k] for k in range(3)]
        longest, shortest = (f(f(a, b), c) for f in (xp.maximum, xp.minimum))
        middle = a + b + c - longest - shortest
        diameter, area = (a + b + c) / 1.5, longest * middle
        rho, mu = rho * scale, mu * scale
        moment = [_moment(r[k], xp.maximum(r[k - 1], r[k - 2])) for k in range(3)]
        largest = _moment(middle, longest)
        mass, inertia = (Vec3(*(x[:, k] * rho for k in range(3))) for x in virtual)
        return _Ellipsoid(
            squares=Vec3(*(x * x for x in (b * c / area, c * a / area, a * b / area))),
            area=math.pi * area,
            viscous_force=3.0 * math.pi * mu * diameter,
            viscous_torque=math.pi * mu * diameter * diameter * diameter,
            slender=rho * slender * (math.pi * area),
            blunt=rho * (blunt - slender),
            moments=Vec3(*(angular * x + slender * (largest - x) for x in moment)),
            density=rho,
            kutta=kutta * rho,
            magnus=magnus * rho * (4.0 / 3.0 * math.pi * a * b * c),
            mass=mass,
            inertia=inertia,
        )


class _Ellipsoid(NamedTuple):
    """Coefficients of the forces on an ellipsoid, with the fluid's density and viscosity."""

    squares: Vec3  # (r_j r_k)^2, scaled to a maximum of 1
    area: Lane  # A_max
    viscous_force: Lane
    viscous_torque: Lane
    slender: Lane
    blunt: Lane
    moments: Vec3
    density: Lane
    kutta: Lane
    magnus: Lane
    mass: Vec3
    inertia: Vec3

    def wrench(self, V: Motion) -> Force:
        """Compute the fluid forces on an ellipsoid at a twist, in its axes at its center."""
        w, v = V.ang, V.lin
        p, h = self.mass.entrywise(v), self.inertia.entrywise(w)
        turning = mul(self.density, safe_sqrt(_squared(self.moments.entrywise(w))))
        force = p.cross(w) + w.cross(v) * self.magnus - v * self.viscous_force
        if not is_zero(_squared(v)):
            force = force + _quadratic(v, self)
        return Force(p.cross(v) + h.cross(w) - w * add(self.viscous_torque, turning), force)


def _moment(length: Lane, radius: Lane) -> Lane:
    """Compute the moment of drag 8 pi / 15 l r^4 of an ellipsoid about an axis. l is the semi-axis
    along this axis, and r the larger one of the other two."""
    square = radius * radius
    return 8.0 / 15.0 * math.pi * length * square * square


def _quadratic(v: Vec3, own: _Ellipsoid) -> Vec3:
    """Compute the drag and lift that are quadratic in the speed."""
    square = _squared(v)
    speed, moves = safe_sqrt(square), square > 0
    u = v * (1.0 / jnp.where(moves, speed, 1.0))
    N = own.squares.entrywise(u)
    along, normal = (jnp.where(moves, x, 1.0) for x in (N.dot(u), _squared(N)))
    area = mul(own.area, jnp.sqrt(normal / along))
    drag = v * mul(speed, add(own.slender, mul(own.blunt, area)))
    return N.cross(u).cross(u) * mul(own.kutta, mul(area, along / normal) * square) - drag


def _squared(a: Vec3) -> Lane:
    return a.dot(a)
