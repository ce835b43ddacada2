"""Signed distances of a robot to obstacles.

Spheres with centers c and radii r cover the bodies. The signed distance to an obstacle is

    sphere      |c - p| - R - r
    capsule     |c - a - s (b - a)| - R - r,   s = clip((c - a).(b - a) / |b - a|^2, 0, 1)
    half-space  n.c - d - r

|x| is sqrt(x.x + e^2) - e with e = 1e-6 m, so it is differentiable everywhere.
Source: Ericson, *Real-Time Collision Detection*, 2005, ch. 5; Schulman et al., IJRR 2014.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance
from rbjax.control.optimal.terms import Term
from rbjax.dynamics.algorithms.kinematics import forward_kinematics
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_not_negative, check_several
from rbjax.model import Model
from rbjax.model.record import Record

SMALL = 1e-6  # m


def _norm(x: jax.Array) -> jax.Array:
    return jnp.sqrt((x * x).sum(-1) + SMALL**2) - SMALL


class Obstacle(Record):
    """A shape at rest in the world. Subclasses are final."""

    def distance(self, points: jax.Array) -> jax.Array:
        """Return the signed distances (...,) m of points (..., 3), world axes."""
        raise NotImplementedError(f"{type(self).__name__} has no method distance")


class Sphere(Obstacle):
    """A sphere with centre (3,) m and radius () m.

    Example:
        >>> import jax.numpy as jnp, rbjax as rb
        >>> ball = rb.control.Sphere([0.0, 0.0, 1.0], 0.5)
        >>> round(float(ball.distance(jnp.zeros(3))), 3)
        0.5
    """

    centre: jax.Array
    radius: jax.Array

    def __init__(self, centre: Any, radius: Any) -> None:
        self.centre = check_array("Sphere", "centre", centre, (3,))
        self.radius = check_not_negative("Sphere", "radius", radius, ())

    def distance(self, points: jax.Array) -> jax.Array:
        return _norm(points - self.centre.astype(points.dtype)) - self.radius


class Capsule(Obstacle):
    """A capsule: all points within radius () m of the segment from a (3,) m to b (3,) m."""

    a: jax.Array
    b: jax.Array
    radius: jax.Array

    def __init__(self, a: Any, b: Any, radius: Any) -> None:
        self.a = check_array("Capsule", "a", a, (3,))
        self.b = check_array("Capsule", "b", b, (3,))
        self.radius = check_not_negative("Capsule", "radius", radius, ())

    def distance(self, points: jax.Array) -> jax.Array:
        a, b = self.a.astype(points.dtype), self.b.astype(points.dtype)
        along = b - a
        length = jnp.maximum((along * along).sum(), SMALL**2)
        s = jnp.clip(((points - a) * along).sum(-1) / length, 0.0, 1.0)
        return _norm(points - a - s[..., None] * along) - self.radius


class HalfSpace(Obstacle):
    """A half-space: all points with normal.x < offset.

    normal: (3,), normalised by the constructor.
    offset: () m, along the unit normal.
    """

    normal: jax.Array
    offset: jax.Array

    def __init__(self, normal: Any, offset: Any = 0.0) -> None:
        n = check_array("HalfSpace", "normal", normal, (3,))
        if not isinstance(n, jax.core.Tracer) and not np.asarray(n).any():
            raise InputError("HalfSpace: normal is the zero vector, expected a direction")
        self.normal = n / jnp.sqrt((n * n).sum())
        self.offset = check_array("HalfSpace", "offset", offset, ())

    def distance(self, points: jax.Array) -> jax.Array:
        return (points * self.normal.astype(points.dtype)).sum(-1) - self.offset


class Clearance(Term):
    """Signed distances (spheres x obstacles,) m of spheres fixed to bodies from obstacles.

    Args (also its fields):
        obstacles: `Sphere`, `Capsule`, `HalfSpace`.
        bodies: the name of a body for each sphere.
        offsets: (k, 3) m, centers of the spheres in their bodies' axes; the origins if None.
        radii: () or (k,) m; 0 for points.
        margin: m, subtracted from the distances.

    Raises:
        InputError: no obstacle, no body, wrong shapes.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("arm7")
        >>> floor = rb.control.HalfSpace([0.0, 0.0, 1.0])
        >>> clear = rb.control.Clearance(floor, model.body_names[-2:], radii=0.05)
        >>> clear(model, 0.0, model.default_state(), jnp.zeros(7)).shape
        (2,)
        >>> rb.control.Constraint(clear, 0.0, jnp.inf, where="all").name
        'Clearance'
    """

    obstacles: tuple[Obstacle, ...]
    bodies: tuple[str, ...] = eqx.field(static=True)
    offsets: jax.Array
    radii: jax.Array
    margin: jax.Array

    def __init__(
        self, obstacles: Any, bodies: Any, offsets: Any = None, radii: Any = 0.0, margin: Any = 0.0
    ) -> None:
        if isinstance(obstacles, Obstacle):
            obstacles = (obstacles,)
        obstacles = check_several("Clearance", "obstacles", obstacles, "Sphere, Capsule, HalfSpace")
        wrong = [type(x).__name__ for x in obstacles if not isinstance(x, Obstacle)]
        if wrong or not obstacles:
            raise InputError(
                f"Clearance: obstacles are {wrong}, expected one or more of Sphere, Capsule, "
                "HalfSpace of rb.control"
            )
        if isinstance(bodies, str):
            bodies = (bodies,)
        names = check_several("Clearance", "bodies", bodies, "names of bodies")
        if not names or not all(isinstance(x, str) for x in names):
            raise InputError(f"Clearance: bodies is {bodies!r}, expected names of bodies")
        k = len(names)
        self.obstacles, self.bodies = obstacles, tuple(names)
        offsets = jnp.zeros((k, 3)) if offsets is None else offsets
        self.offsets = check_array("Clearance", "offsets", offsets, (k, 3))
        self.radii = jnp.broadcast_to(
            check_not_negative("Clearance", "radii", radii, (), (k,)), (k,)
        )
        self.margin = check_array("Clearance", "margin", margin, ())

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        public = "an rb.Model; for other systems give Constraint obstacle.distance(point)"
        instance("Clearance", "the model", model, Model, public)
        poses = forward_kinematics(model, state.q)
        where = [model.body(name) for name in self.bodies]
        R = jnp.stack([poses.R[k] for k in where])
        p = jnp.stack([poses.p[k] for k in where])
        centres = p + (R * self.offsets.astype(p.dtype)[:, None, :]).sum(-1)
        off = self.radii.astype(p.dtype) + self.margin.astype(p.dtype)
        return jnp.concatenate([x.distance(centres) - off for x in self.obstacles])
