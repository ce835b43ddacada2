"""Energy, centre of mass, momenta and their rates, each in O(n).

    T = v^T M v / 2 = sum of V.(I V) / 2 + armature v^2 / 2;   U = -sum of m g.c
    h_G = [sum of I_b w + m (c_b - c) x v_b;  sum of m v_b]      (Orin, Goswami & Lee 2013)

The generalized momentum p = M(q) v is computed without M, and its rate without accelerations. V_i
is the twist of a link, h_i the momentum of its subtree, and f_i the weight of the subtree plus the
external forces on it:

    p_i  = S_i.h_i + armature v_i
    p'_i = S_i.(f_i - V_i x* h_i) + S'_i.h_i + tau_i    (dL/dq_i + tau_i; of attitudes less w x p)

(Featherstone, 2.9 and 2.12, for the subtree of a joint, with S' the rate of the axis in its link.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.dynamics.algorithms.aba import factorize, solve
from rbjax.dynamics.algorithms.crba import mass_matrix_rows
from rbjax.dynamics.algorithms.kinematics import (
    POSE,
    TWIST,
    body_velocities,
    forward_kinematics,
    sweep,
)
from rbjax.dynamics.algorithms.manifold import integrate_lanes
from rbjax.dynamics.algorithms.rnea import LinkForces, forces_at, momentum, per_link
from rbjax.dynamics.drivers.choice import driver
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.dynamics.tracing.custom_rules import jax_arrays, split_tracers, with_implicit_jvp
from rbjax.errors import InputError
from rbjax.lanes import Lane, Vec3, add, batch_first, lu, matmat, matvec, mul, pack, unpack
from rbjax.model import Model, prepare
from rbjax.spatial import Force, Motion

#: entries of a matrix (nv, nv) by row and column
Entries = Mapping[tuple[int, int], Lane]


@algorithm("q", "v")
def kinetic_energy(model: Model, q: ArrayLike, v: ArrayLike) -> jax.Array:
    """Compute the kinetic energy v^T M(q) v / 2 in joules, including armature, in O(n).

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

    Returns:
        (), J.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> float(rb.kinetic_energy(model, model.default_state().q, model.default_state().v))
        0.0
    """
    if not model.nv:
        return jnp.zeros((), v.dtype)
    d = driver(model, q.dtype)
    joints = d.joints(q, v)
    (twists,) = sweep(d, joints, TWIST)

    def step(x, children):
        link, joint, V = x
        h = joint.inertia(link)(V)
        twice = add(V.dot(h), mul(link.armature, mul(joint.qd, joint.qd)))
        own = joint.link_inertia(Vec3.zero())
        if own is not None:
            twice = add(twice, own.twice_kinetic_energy(V, joint.v))
        return (), twice

    twice = d.inward(step, (), d.zip(d.constants, joints, twists))
    return d.columns(twice, jnp.zeros(len(d.topology.links), v.dtype)).sum() / 2


@algorithm("q")
def potential_energy(model: Model, q: ArrayLike) -> jax.Array:
    """Compute the potential energy of gravity in joules, without springs.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Returns:
        (), J.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> rb.potential_energy(model, model.default_state().q).shape
        ()
    """
    _, com, mass = _centres(model, q)
    gravity = model.gravity.astype(q.dtype)
    energy = -(mass * (com * gravity).sum(-1)).sum()
    if model.topology.frames:
        energy = energy - (_of_flexible_links(model, q)[1] * gravity).sum()
    return energy


@algorithm("q")
def center_of_mass(model: Model, q: ArrayLike) -> jax.Array:
    """Compute the center of mass (3,) of all bodies, in the world, in metres.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Returns:
        (3,), m.

    Raises:
        InputError: the model has no bodies.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("quadruped")
        >>> rb.center_of_mass(model, model.default_state().q).shape
        (3,)
    """
    if not model.nb:
        raise InputError("center_of_mass: the model has no bodies, expected one or more")
    _, com, mass = _centres(model, q)
    return _center(model, q, com, mass)


@algorithm("q", "v")
def centroidal_momentum(model: Model, q: ArrayLike, v: ArrayLike) -> jax.Array:
    """Compute the momentum (6,) of all bodies about their center of mass: [angular; linear].

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

    Returns:
        (6,), N m s, then N s, in world axes.

    Source: Orin, Goswami & Lee (2013), *Centroidal dynamics of a humanoid robot*.

    Example:
        >>> import rbjax as rb, jax
        >>> model = rb.load("quadruped")
        >>> state = model.random_state(jax.random.key(0))
        >>> rb.centroidal_momentum(model, state.q, state.v).shape
        (6,)
    """
    poses, com, mass = _centres(model, q)
    twists = body_velocities(model, q, v)
    omega = twists[:, :3]
    speed = twists[:, 3:] + jnp.cross(omega, com - poses.p)
    inertia = model.bodies.inertia.astype(q.dtype)
    in_body = (poses.R * omega[:, :, None]).sum(-2)
    spin = matvec(matmat(poses.R, inertia), in_body)
    center = _center(model, q, com, mass)
    momentum = mass[:, None] * speed
    whole = jnp.concatenate([(spin + jnp.cross(com - center, momentum)).sum(0), momentum.sum(0)])
    if model.topology.frames:
        h = _of_flexible_links(model, q, v)[2]
        whole = whole + h.at[:3].add(-jnp.cross(center, h[3:]))
    return whole


def _centres(model: Model, q: jax.Array):
    """Compute poses, positions of the centers of mass in the world (nb, 3), and masses (nb,)."""
    poses = forward_kinematics(model, q)
    bodies = model.bodies
    com = poses.p + matvec(poses.R, bodies.com.astype(q.dtype))
    return poses, com, bodies.mass.astype(q.dtype)


def _center(model: Model, q: jax.Array, com: jax.Array, mass: jax.Array) -> jax.Array:
    """Compute the center of mass from the centers and masses of the bodies."""
    moment, whole = (mass[:, None] * com).sum(0), mass.sum()
    if model.topology.frames:
        more_mass, more_moment, _ = _of_flexible_links(model, q)
        moment, whole = moment + more_moment, whole + more_mass
    return moment / whole


def _of_flexible_links(
    model: Model, q: jax.Array, v: jax.Array | None = None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Sum mass, first moment (3,) and momentum (6,) of the inertias of joints, at the origin."""
    d = driver(model, q.dtype)
    joints = d.joints(q, v)

    def step(x, _):
        joint, pose, V = x
        inertia, momentum = joint.own_momentum(V)
        inertia = pose.rigid_to_parent(inertia)
        return (), (inertia.m, inertia.h, pose.T(momentum))

    found = d.outward(step, (), d.zip(joints, *sweep(d, joints, POSE, TWIST)))
    mass, h, momentum = d.columns(found, jnp.zeros(len(d.topology.links), q.dtype))
    return mass.sum(), jnp.stack([*h], -1).sum(0), jnp.stack([*momentum], -1).sum(0)


def momentum_and_rate(
    model: Model,
    q: jax.Array,
    v: jax.Array,
    tau: jax.Array,
    f_ext: LinkForces | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Compute the generalized momentum p = M(q) v and its rate (nv, ...) from checked arrays."""
    if model.topology.frames:
        return _flexible_momentum_and_rate(model, q, v, tau, f_ext)

    def outward(x, parent):
        link, joint, _, _ = x
        V_parent, g_parent = parent
        X = joint.transform(link)
        V = X(V_parent) + joint.twist
        g = X.E @ g_parent
        return (V, g), (X, V, g)

    def inward(x, children):
        (link, joint, tau, f_ext), (X, V, g) = x
        inertia, weight = joint.inertia(link), Motion(Vec3.zero(), g)
        h = inertia(V) + children[0]
        f = inertia(weight) + f_ext + children[1]
        p = add(joint.S.dot(h), mul(link.armature, joint.qd))
        rate = add(joint.S.dot(f - V.cross_force(h)), add(joint.S_rate.dot(h), tau))
        return (X.T(h), X.T(f)), (p, rate)

    d = driver(model, q.dtype)
    xs = d.zip(d.constants, d.joints(q, v), d.lanes(tau), per_link(d, f_ext))
    root = (Motion.zero(), d.prepared.gravity)
    found = d.out_and_in(outward, root, inward, (Force.zero(), Force.zero()), xs)
    p, rate = d.unzip(found, 2)
    return d.pack(p, v), d.pack(rate, v)


def _flexible_momentum_and_rate(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: LinkForces | None
) -> tuple[jax.Array, jax.Array]:
    """Compute `momentum_and_rate` in a tree with flexible links: p' = tau - b + M' v."""
    top = model.topology

    def moved(h: jax.Array) -> jax.Array:
        at = integrate_lanes(top, unpack(q), unpack(h * v))
        return momentum(model, pack(at, q), v)

    h = jnp.zeros(q.shape[1:], q.dtype)
    p, rate = jax.jvp(moved, (h,), (jnp.ones_like(h),))
    return p, rate + tau - forces_at(model, q, v, jnp.zeros_like(v), f_ext or {})


def product(entries: Entries, x: jax.Array) -> jax.Array:
    """Compute the product of a matrix, given by its entries, and a vector (nv, ...)."""
    out: list[Lane] = [0.0] * len(x)
    for (i, j), entry in entries.items():
        out[i] = add(out[i], mul(entry, x[j]))
    return pack(out, x)


def velocity_of(
    model: Model, q: jax.Array, p: jax.Array, added: Entries | None = None
) -> jax.Array:
    """Compute the velocity v = (M(q) + A)^-1 p (nv, ...) from checked arrays.

    dv = (M + A)^-1 (dp - d(M(q) v + A v)),   v held constant in the right side.

    If A is diagonal, the articulated-body factors solve the system; otherwise the factors L U of
    the matrix with the sparsity of M and A do. `added` has the entries of A, by row and column.
    """
    given, rebuilt = split_tracers((model, added or {}))

    def factors(changed, q):
        model, added = rebuilt(changed)
        if all(i == j for i, j in added):
            d = driver(model, q.dtype)
            extra = {i: x for (i, _), x in added.items()}
            found = factorize(d, d.joints(q, None), d.scattered(extra, 0.0))
            return d, lambda p: solve(d, found, p)
        d = Unrolled(model, prepare(model, q.dtype))
        rows = mass_matrix_rows(d, d.joints(q, None))
        for (i, j), x in added.items():
            rows[i][j] = add(rows[i][j], x)
        return d, lu(rows).solve

    def plain(*at):
        d, solve = factors(*at[:2])
        return batch_first((d.pack(solve(d.lanes(at[2])), at[2]),), at)

    def solved(changed, q, p):
        d, solve = factors(changed, q)

        def velocity(p):
            return d.pack(solve(d.lanes(p)), p)

        return (velocity(p),), [velocity]

    def residual(changed, q, p, v):
        model, added = rebuilt(changed)
        out = p - momentum(model, q, v)
        return out - product(added, v) if added else out

    return with_implicit_jvp(plain, solved, residual)(*jax_arrays(given, q, p))[0]


def linearly_implicit_velocity(
    model: Model, q: jax.Array, extra: Mapping[int, Lane] | None = None
) -> Callable[[jax.Array], jax.Array]:
    """Return the function p -> (M(q) + diag(extra))^-1 p of arrays (nv, ...).

    All calls share one elimination. Derivatives are with respect to p only. `extra` maps a dof to
    the lane that is added to the diagonal.
    """
    moving, closed = split_tracers(model)  # constant leaves stay constant
    still, q = closed(jax.lax.stop_gradient(moving)), jax.lax.stop_gradient(q)
    d = driver(still, q.dtype)
    found = factorize(d, d.joints(q, None), d.scattered(extra or {}, 0.0))
    return lambda p: d.pack(solve(d, found, d.lanes(p)), p)
