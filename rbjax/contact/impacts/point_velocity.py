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

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import floating_array
from rbjax.constraints import Soft
from rbjax.constraints import jacobian as constraint_jacobian
from rbjax.constraints.equations.constrained_motion import solve_least_norm
from rbjax.contact.geometry.candidates import pairs_of_candidates
from rbjax.contact.geometry.detection import Contacts, Pairs
from rbjax.contact.parameters import pair_parameters
from rbjax.dynamics import inverse_mass_matrix
from rbjax.forces.context import Context
from rbjax.lanes.arrays import matmat, matrix_transpose, matvec
from rbjax.model import Model, State


def relative_velocity(model: Model, q: jax.Array, v: jax.Array, contacts: Contacts) -> jax.Array:
    """Return the relative velocities u (n, 3) of the contact points, in the contact axes."""
    now, dtype = Context.of(model, 0.0, State(q, v), None), q.dtype
    own: Any = model.geoms
    two = [[own.bodies[pair[k]] for pair in contacts.geoms] for k in (0, 1)]
    motions = {}
    for body in sorted({*two[0], *two[1]}):
        frame = now.body(body)
        vectors = (frame.angular_velocity, frame.velocity, frame.position)
        motions[body] = [jnp.stack([jnp.asarray(x, dtype) for x in row]) for row in vectors]

    def velocity(bodies: list[int]) -> jax.Array:
        angular, linear, origin = (
            jnp.stack(rows) for rows in zip(*(motions[x] for x in bodies), strict=True)
        )
        return linear + jnp.cross(angular, contacts.position - origin)

    a, b = map(velocity, two)
    return matvec(contacts.frame, b - a)


def contact_jacobian(model: Model, q: jax.Array, contacts: Contacts) -> jax.Array:
    """Return the Jacobian J (n, 3, nv) of u = J v."""
    if not contacts.geoms:
        return jnp.zeros((0, 3, model.nv), q.dtype)

    def column(unit: jax.Array) -> jax.Array:
        return relative_velocity(model, q, unit, contacts)

    return jax.vmap(column, out_axes=-1)(jnp.eye(model.nv, dtype=q.dtype))


def constrained_inverse_inertia(model: Model, q: jax.Array, t: Any = 0.0) -> jax.Array:
    """Return W (nv, nv): the inverse mass matrix, projected onto the motions that the rigid
    constraints of the model allow."""
    inverse = inverse_mass_matrix(model, q)
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
    geoms: Any = model.geoms
    index = pairs_of_candidates(geoms, pairs)
    return jnp.broadcast_to(x, (len(pairs),))[np.array(index, int)]


def file_friction(model: Model, pairs: Pairs, dtype: Any) -> jax.Array:
    """Return the sliding friction of each pair in the file; zero if its condim is 1."""
    geoms: Any = model.geoms
    found = pair_parameters(geoms, pairs)
    mu = jnp.asarray(found.friction[:, 0], dtype)
    return jnp.where(np.array(found.condim) == 1, 0, mu)
