"""Fluid forces on the equivalent inertia box of a body.

    s_i = sqrt(6 (I_j + I_k - I_i) / m),   d = (s_1 + s_2 + s_3) / 3
    f_i = -(3 pi mu d + rho s_j s_k |v_i| / 2) v_i
    n_i = -(pi mu d^3 + rho s_i (s_j^4 + s_k^4) |w_i| / 64) w_i
s are the edges of the uniform box with the body's mass m and principal moments I; v and w are the
velocity of its centre relative to the fluid and its angular velocity, along the box's axes.
(MuJoCo documentation, *Fluid forces*, inertia model.)

The box follows the model's own masses, centres and inertias; only its axes are numbers of the
element. The I_i are the diagonal of the inertia in these axes. Its derivative is that of the
principal moments, and no eigenvectors are computed: these have no derivative where moments agree.
How the axes turn with an inertia is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.forces.context import Context, Frame
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.forces.many import on_each
from rbjax.lanes import Lane, Mat3, Vec3, add, is_zero, mul, quaternion_matrix
from rbjax.model import WORLD, Model
from rbjax.model.leaves import table, tables
from rbjax.model.links import lane
from rbjax.rotations import quaternion
from rbjax.spatial import Force, Motion, Transform

#: MuJoCo's least value of what it divides by or takes the root of
LEAST = 1e-15


class InertiaBoxFluid(Element):
    """A fluid that drags on bodies as on boxes with their masses and inertias.

    f_i = -(3 pi mu d + rho s_j s_k |v_i| / 2) v_i, and likewise a torque, of a box with edges s.

    Fields: density rho () kg/m^3; viscosity mu () Pa s; wind (3,) m/s, the velocity of the fluid in
    the world; orientation (n, 4), quaternions of the boxes' axes in the bodies' frames. Static:
    `bodies`, the index of each. `InertiaBoxFluid.of` finds the axes.

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
        alone = {"density": (), "viscosity": (), "wind": (3,)}
        return alone | {"orientation": (len(self.bodies), 4)}

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
        """The fluid around these bodies of a model, by name; around all that move if None."""
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

    def loads(self, now: Context) -> Loads:
        """The drag of each body's box."""
        com = now.model.bodies.com[np.array(self.bodies)]
        wind, axes = in_lanes(self.wind, now), rotations(table(self.orientation, now.q.dtype))

        def dragged(frame: Frame, axes: Mat3, com: Vec3, drag: _Drag) -> Loads:
            box = frame.then(Transform(axes, com))
            V = relative_twist(box, wind)
            torque = _against(V.ang, drag.viscous_torque, drag.torque)
            return box.push_own(Force(torque, _against(V.lin, drag.viscous_force, drag.force)))

        return on_each(now, self.bodies, dragged, axes, com, self._drag(now))

    def _drag(self, now: Context) -> _Drag:
        """The boxes' drag coefficients, columns over the bodies."""
        bodies, index = now.model.bodies, np.array(self.bodies)
        own = bodies.mass[index], bodies.inertia[index], self.orientation
        xp, found = tables(now.q.dtype, *own, self.density, self.viscosity)
        mass, inertia, orientation, rho, mu = found
        full = Mat3(*(inertia[:, i, j] for i in range(3) for j in range(3)))
        moments = Vec3(*(axis.dot(full @ axis) for axis in rotations(orientation).columns))
        trace = moments[0] + moments[1] + moments[2]
        tiny = 10 * np.finfo(mass.dtype).eps * trace  # of a flat box: rounding
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
    """Drag by velocity, and along each axis by its square."""

    viscous_force: Lane
    viscous_torque: Lane
    force: Vec3
    torque: Vec3


def _against(u: Vec3, viscous: Lane, quadratic: Vec3) -> Vec3:
    """-(k + c_i |u_i|) u_i."""
    return -Vec3(*(mul(add(viscous, mul(c, abs(x))), x) for x, c in zip(u, quadratic, strict=True)))


def relative_twist(frame: Frame, wind: Vec3) -> Motion:
    """The twist of a frame relative to a fluid that streams without turning."""
    V = frame.twist
    if all(map(is_zero, wind)):
        return V
    return Motion(V.ang, V.lin - frame.rotation.T @ wind)


def rotations(orientation: Any) -> Mat3:
    """Quaternions (n, 4) as matrices whose lanes are columns."""
    return quaternion_matrix(*(orientation[:, k] for k in range(4)))


def in_lanes(vector: Any, now: Context) -> Vec3:
    """An element's vector (3,) in lanes."""
    x = table(vector, now.q.dtype)
    return Vec3(*(lane(x, k) for k in range(3)))
