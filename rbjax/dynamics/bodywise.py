"""Algorithms that sum over bodies with whole arrays: Coriolis matrix and inertial regressor.

Coriolis (Echeandia & Wensing 2021): with S_i a link's unit twist, V_i its twist and
B(I, V) = (V x* I - I V x + (I V) x-bar*) / 2,

    C = sum over bodies of J^T (I J' + B J),   J'_i = V_i x S_i,

so that C v + g = b and M' = C + C^T. Regressor: the Newton-Euler equations are linear in each
body's ten inertial parameters (Khalil & Dombre, *Modeling, Identification and Control of Robots*,
ch. 12).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.aba import swing
from rbjax.dynamics.arguments import algorithm
from rbjax.dynamics.drivers import driver
from rbjax.dynamics.jacobians import ancestor_mask, world_axes
from rbjax.dynamics.kinematics import body_poses, link_poses
from rbjax.lanes import Vec3
from rbjax.model import WORLD, Model
from rbjax.model.links import matrix_apply, matrix_product, matrix_transpose
from rbjax.spatial import Motion


def skew(r: jax.Array) -> jax.Array:
    """[r] (..., 3, 3), with [r] a = r x a."""
    x, y, z = jnp.moveaxis(r, -1, 0)
    o = jnp.zeros_like(x)
    return jnp.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*r.shape, 3)


def _blocks(a, b, c, d) -> jax.Array:
    """The 6 by 6 matrix [a, b; c, d]."""
    return jnp.concatenate([jnp.concatenate([a, b], -1), jnp.concatenate([c, d], -1)], -2)


@algorithm("q", "v")
def coriolis_matrix(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """C(q, v) (nv, nv), with C v + gravity_forces = bias_forces and M' - 2 C skew.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

    Returns:
        (nv, nv); M' = C + C^T along the motion.

    Source: Echeandia & Wensing (2021), *Numerical methods to compute the Coriolis matrix*.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> state = model.default_state()
        >>> rb.coriolis_matrix(model, state.q, state.v).shape
        (2, 2)
    """
    n, top = model.nv, model.topology
    if not n:
        return jnp.zeros((0, 0), q.dtype)
    d = driver(model, q.dtype)
    R, p = link_poses(d, q)
    poses = body_poses(d, R, p)
    # each tree is seen from the origin of its own first link, so that f32 keeps its digits
    centre = p[np.array([chain[0] for chain in top.ancestors], int)]
    angular, linear = world_axes(top, R, p - centre)
    S = jnp.concatenate([angular, linear], -1)
    moves = np.stack([ancestor_mask(top, i) for i in range(n)])  # [link, ancestor]
    V = (moves[:, :, None] * (S * v[:, None])[None]).sum(1)
    # the axes of a ball turn with its body: the twist of its last link
    last = np.array([_last_of_ball(top, i) for i in range(n)], int)
    w, u = V[last, :3], V[last, 3:]
    S_rate = jnp.concatenate(
        [jnp.cross(w, S[:, :3]), jnp.cross(w, S[:, 3:]) + jnp.cross(u, S[:, :3])], -1
    )
    # bodies' spatial inertias and B at the same point, summed over what each link carries
    carried = np.array(top.body_links)
    I = _world_inertia(model, poses, centre[carried], q.dtype)
    B = _coriolis_block(I, jnp.where((carried == WORLD)[:, None], 0.0, V[carried]))
    carries = np.stack(
        [[link != WORLD and i in top.ancestors[link] for link in carried] for i in range(n)]
    )
    I_c, B_c = (jnp.where(carries[:, :, None, None], x, 0.0).sum(1) for x in (I, B))
    outer = _pairs(S, matrix_apply(I_c, S_rate) + matrix_apply(B_c, S))
    inner = _pairs(S_rate, matrix_apply(I_c, S)) + _pairs(S, matrix_apply(matrix_transpose(B_c), S))
    # entry (i, j): what the deeper of the two carries
    return jnp.where(moves.T, outer, jnp.where(moves, inner.T, 0.0))


def _pairs(a, b):
    """a_i . b_j for all pairs."""
    return (a[:, None, :] * b[None, :, :]).sum(-1)


def _last_of_ball(top, i: int) -> int:
    link = top.links[i]
    return i if link.part is None or link.kind == "slide" else i + 2 - link.part


def _world_inertia(model: Model, poses, centre, dtype) -> jax.Array:
    """Spatial inertia (nb, 6, 6) of each body in world axes at a point."""
    m = model.bodies.mass.astype(dtype)[:, None, None]
    turned = matrix_product(poses.R, model.bodies.inertia.astype(dtype))
    c = skew(poses.p + matrix_apply(poses.R, model.bodies.com.astype(dtype)) - centre)
    J = matrix_product(turned, matrix_transpose(poses.R)) - m * matrix_product(c, c)
    return _blocks(J, m * c, -m * c, m * jnp.eye(3, dtype=dtype))


def _coriolis_block(I: jax.Array, V: jax.Array) -> jax.Array:
    """B(I, V), with B V = V x* I V and B + B^T = dI/dt."""
    w, u = skew(V[:, :3]), skew(V[:, 3:])
    o = jnp.zeros_like(w)
    cross, cross_force = _blocks(w, o, u, w), _blocks(w, u, o, w)
    h = matrix_apply(I, V)
    n, f = skew(h[:, :3]), skew(h[:, 3:])
    bar = _blocks(-n, -f, -f, o)
    return (matrix_product(cross_force, I) - matrix_product(I, cross) + bar) / 2


@algorithm("q", "v", "a")
def inertial_regressor(model: Model, q: jax.Array, v: jax.Array, a: jax.Array) -> jax.Array:
    """Y(q, v, a) (nv, 10 nb), with ID(q, v, a) = Y pi + armature * a.

    pi stacks for each body (m, m c_x, m c_y, m c_z, I_xx, I_xy, I_yy, I_xz, I_yz, I_zz), in its own
    frame, inertia about the frame's origin: `inertial_parameters(model)`.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        a: (nv,) acceleration.

    Source: Khalil & Dombre, ch. 12; Atkeson, An & Hollerbach (1986).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> s = model.default_state()
        >>> rb.inertial_regressor(model, s.q, s.v, s.v).shape
        (2, 20)
    """
    n, nb, top = model.nv, model.nb, model.topology
    if not n:
        return jnp.zeros((0, 10 * nb), q.dtype)
    d = driver(model, q.dtype)
    R, p = link_poses(d, q)
    poses = body_poses(d, R, p)
    link = np.array(top.body_links, int)
    fixed = (link == WORLD)[:, None]

    def step(x, parent):
        w_parent, a_parent = parent
        constants, joint, qdd = x
        w, moved = swing((constants, joint), w_parent)
        acc = moved.X(a_parent) + moved.c + joint.S * qdd
        return (w, acc), (w, acc)

    root = (Vec3.zero(), Motion(Vec3.zero(), -d.prepared.gravity))
    out = d.outward(step, root, d.zip(d.constants, d.joints(q, v), d.lanes(a)))
    w, acc = d.columns(out, v)

    def world(x):
        return matrix_apply(R, jnp.stack(list(x), -1))[link]

    arm = poses.p - p[link]
    w, alpha, lin = world(w), world(acc.ang), world(acc.lin)
    lin = lin + jnp.cross(alpha, arm) + jnp.cross(w, jnp.cross(w, arm))
    w, alpha, lin = ((poses.R * x[:, :, None]).sum(-2) for x in (w, alpha, lin))
    # wrench per parameter in body axes: force, and moment about the body's origin
    A, W = skew(alpha), skew(w)
    by_mass = jnp.concatenate([jnp.zeros_like(lin), lin], -1)[:, :, None]
    by_first = jnp.concatenate([-skew(lin), A + matrix_product(W, W)], -2)
    turned = _inertia_columns(alpha) + matrix_product(W, _inertia_columns(w))
    by_second = jnp.concatenate([turned, jnp.zeros_like(turned)], -2)
    wrench = jnp.concatenate([by_mass, by_first, by_second], -1)  # (nb, 6, 10)
    moment = matrix_product(poses.R, wrench[:, :3])
    force = matrix_product(poses.R, wrench[:, 3:])
    moment = moment + matrix_product(skew(poses.p), force)
    at_origin = jnp.where(fixed[..., None], 0.0, jnp.concatenate([moment, force], -2))
    S = jnp.concatenate(world_axes(top, R, p), -1)
    moved_by = np.stack([ancestor_mask(top, i) for i in top.body_links])  # [body, link]
    Y = (S[:, None, :, None] * at_origin[None]).sum(2)
    return jnp.where(moved_by.T[:, :, None], Y, 0.0).reshape(n, 10 * nb)


def _inertia_columns(x: jax.Array) -> jax.Array:
    """K(x) (nb, 3, 6), with I x = K(x) (I_xx, I_xy, I_yy, I_xz, I_yz, I_zz)."""
    a, b, c = jnp.moveaxis(x, -1, 0)
    o = jnp.zeros_like(a)
    rows = [a, b, o, c, o, o, o, a, b, o, c, o, o, o, o, a, b, c]
    return jnp.stack(rows, -1).reshape(-1, 3, 6)


def inertial_parameters(model: Model) -> jax.Array:
    """pi (10 nb,) of a model, in the order of `inertial_regressor`.

    Example:
        >>> import rbjax as rb
        >>> rb.inertial_parameters(rb.load("pendulum")).shape
        (10,)
    """
    m, c = model.bodies.mass, model.bodies.com
    square = (c * c).sum(-1)[:, None, None] * jnp.eye(3) - c[:, :, None] * c[:, None, :]
    J = model.bodies.inertia + m[:, None, None] * square
    six = [J[:, 0, 0], J[:, 0, 1], J[:, 1, 1], J[:, 0, 2], J[:, 1, 2], J[:, 2, 2]]
    return jnp.stack([m, *(m * c[:, k] for k in range(3)), *six], -1).reshape(-1)
