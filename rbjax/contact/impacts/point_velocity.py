"""Relative velocities of contact points, as linear functions of the velocity of the robot.

For geoms a and b that touch at x, with the contact axes E (normal from a to b, two tangents),

    u = E (v_b(x) - v_a(x)) = J(q) v
The normal component is the rate of the distance. The inverse inertia W is M^-1, or its projection
onto the motions that the rigid constraints of the model allow,

    W = M^-1 - M^-1 G^T (G M^-1 G^T)^+ G M^-1
The Delassus matrix J W J^T is the change of u by unit impulses. (Featherstone, *Rigid Body Dynamics
Algorithms*, ch. 11; Brogliato, *Nonsmooth Mechanics*, 5.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import floating_array
from rbjax.constraints import Soft
from rbjax.constraints import jacobian as constraint_jacobian
from rbjax.constraints.equations.constrained_motion import solve_least_norm
from rbjax.contact.geometry.candidates import PairKind, candidates
from rbjax.contact.geometry.detection import _columns, _geoms
from rbjax.contact.geometry.shapes import Shape
from rbjax.dynamics.algorithms.aba import factorize, solve
from rbjax.dynamics.drivers.choice import driver
from rbjax.forces.context import Context
from rbjax.lanes import Vec3, quaternion_matrix
from rbjax.lanes.arrays import matmat, matrix_transpose, matvec
from rbjax.model import Model, State
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.spatial import Transform

Pairs = tuple[tuple[int, int], ...]


class ContactPoints(NamedTuple):
    """Candidate contacts of pairs of geoms at a configuration.

    Fields:
        distance: (n,) m, between the surfaces.
        exists: (n,) whether the candidate is one of the contacts of its pair.
        position: (n, 3) m, in the world.
        frame: (n, 3, 3) the contact axes as rows, in world axes.
    """

    distance: jax.Array
    exists: jax.Array
    position: jax.Array
    frame: jax.Array


def contact_points(model: Model, q: jax.Array, pairs: Pairs) -> ContactPoints:
    """Return the candidate contacts of pairs of geoms at any distance."""
    now = Context.of(model, 0.0, State(q, jnp.zeros(model.nv, q.dtype)), None)
    reach = jnp.asarray(jnp.inf, q.dtype)
    geoms, columns = _geoms(model), []
    for pair in pairs:
        one, other = (geom_shape(now, g) for g in pair)
        kind = PairKind.of(geoms, pair)
        columns.append(_columns(kind, geoms.heights, one, other, reach))
    distance, position, frame, exists = map(jnp.concatenate, zip(*columns, strict=True))
    return ContactPoints(distance, exists, position, frame)


def geom_shape(now: Context, geom: int) -> Shape:
    """Return a geom in the world."""
    geoms, dtype = _geoms(now.model), now.q.dtype
    p, quat, size = (table(x, dtype) for x in (geoms.position, geoms.orientation, geoms.size))
    placed = Transform(
        quaternion_matrix(*(lane(quat[:, k], geom) for k in range(4))),
        Vec3(*(lane(p[:, k], geom) for k in range(3))),
    )
    pose = now.body(geoms.bodies[geom]).then(placed).pose
    return Shape(pose.p, pose.R, Vec3(*(lane(size[:, k], geom) for k in range(3))))


def bodies_of(model: Model, pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """Return the two bodies (n,) of each candidate; the world is -1."""
    two = [candidate.bodies for candidate in candidates(_geoms(model), pairs)]
    first, second = np.array(two, int).reshape(-1, 2).T
    return first, second


def relative_velocity(
    model: Model, q: jax.Array, v: jax.Array, points: ContactPoints, pairs: Pairs
) -> jax.Array:
    """Return the relative velocities u (n, 3) of the contact points, in the contact axes."""
    now, dtype = Context.of(model, 0.0, State(q, v), None), q.dtype
    two = bodies_of(model, pairs)
    motions = {}
    for body in sorted({*two[0], *two[1]}):
        frame = now.body(int(body))
        vectors = (frame.angular_velocity, frame.velocity, frame.position)
        motions[body] = [jnp.stack([jnp.asarray(x, dtype) for x in row]) for row in vectors]

    def velocity(bodies: np.ndarray) -> jax.Array:
        angular, linear, origin = (
            jnp.stack(rows) for rows in zip(*(motions[x] for x in bodies), strict=True)
        )
        return linear + jnp.cross(angular, points.position - origin)

    a, b = map(velocity, two)
    return matvec(points.frame, b - a)


def contact_jacobian(model: Model, q: jax.Array, points: ContactPoints, pairs: Pairs) -> jax.Array:
    """Return the Jacobian J (n, 3, nv) of u = J v."""

    def column(unit: jax.Array) -> jax.Array:
        return relative_velocity(model, q, unit, points, pairs)

    return jax.vmap(column, out_axes=-1)(jnp.eye(model.nv, dtype=q.dtype))


def inverse_inertia(model: Model, q: jax.Array, t: Any = 0.0) -> jax.Array:
    """Return W (nv, nv): the inverse mass matrix, projected onto the motions that the rigid
    constraints of the model allow."""
    d = driver(model, q.dtype)
    factors = factorize(d, d.joints(q, None))
    inverse = jax.vmap(lambda unit: d.pack(solve(d, factors, d.lanes(unit)), unit))(
        jnp.eye(model.nv, dtype=q.dtype)
    )
    rigid = tuple(x for x in model.constraints if not isinstance(x, Soft))
    if not rigid:
        return inverse
    G = constraint_jacobian(model.replace(constraints=rigid), q, t)
    Y = matmat(inverse, G.T)
    A = matmat(G, Y)
    multipliers = jax.vmap(lambda column: solve_least_norm(A, column), 1, 1)(matrix_transpose(Y))
    return inverse - matmat(Y, multipliers)


def coefficients(
    where: str, name: str, given: Any, model: Model, pairs: Pairs, dtype: Any
) -> jax.Array:
    """Return a coefficient of each candidate (n,), from one number or one number a pair."""
    x = floating_array(
        where, name, given, lambda s: s in ((), (len(pairs),)), f"() or ({len(pairs)},), a pair"
    ).astype(dtype)
    index = [candidate.pair for candidate in candidates(_geoms(model), pairs)]
    return jnp.broadcast_to(x, (len(pairs),))[np.array(index, int)]


def file_friction(model: Model, pairs: Sequence[tuple[int, int]], dtype: Any) -> jax.Array:
    """Return the sliding friction of each pair by the rule of MuJoCo: of the geom of higher
    priority, or the larger one."""
    geoms = _geoms(model)
    mu = jnp.asarray(geoms.friction, dtype)[:, 0]
    out = []
    for a, b in pairs:
        first = geoms.priority[a] - geoms.priority[b]
        out.append(jnp.maximum(mu[a], mu[b]) if first == 0 else mu[a] if first > 0 else mu[b])
    return jnp.stack(out) if out else jnp.zeros(0, dtype)
