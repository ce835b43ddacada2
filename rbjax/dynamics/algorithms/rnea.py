"""Recursive Newton-Euler algorithm: inverse dynamics in O(n) (Luh, Walker & Paul 1980).

    outward   w = E w_p + rate;   a = X(a_p) + c + S qdd       (classical accelerations)
              f = I a + [w x J w; w x (w x h)] - f_ext
    inward    f = f + sum of X^T f of the children;   tau = S.f + armature qdd

A frame of a flexible link sends the generalized forces S_j.f of the coordinates too (the block).

Gravity is an acceleration of the base, a_0 = -g. An external force f_ext is in the axes of its link
at its origin. The generalized forces of f_ext are sum J_i^T f_i (Featherstone, 5.3).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike
from rbjax.dynamics.algorithms.kinematics import (
    ACCELERATION,
    ROTATION,
    Accelerated,
    Hop,
    accelerated_base,
    over_links,
    sweep,
)
from rbjax.dynamics.algorithms.kinematics import LinkForces as LinkForces
from rbjax.dynamics.algorithms.kinematics import per_link as per_link
from rbjax.dynamics.algorithms.virtual_power import with_gradient_of_power
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.joints.joint import Block
from rbjax.lanes import Mat3, Vec3, add, mul
from rbjax.model import WORLD, Model
from rbjax.spatial import Force, Motion

#: no force and no block: the sum of the messages of no children
NO_FORCE: tuple[Force, Block] = (Force.zero(), ())


def add_blocks(a: Block, b: Block) -> Block:
    """Add two blocks. An empty block counts as zeros."""
    return tuple(map(add, a, b)) if a and b else a or b


def add_forces(a: LinkForces, b: LinkForces) -> LinkForces:
    """Add two sets of external forces on links."""
    a, b = a or {}, b or {}
    if isinstance(a, Force) and isinstance(b, Force):
        return a + b
    if isinstance(a, Force):
        return add_forces(b, a)
    if isinstance(b, Force):
        for i, f in a.items():
            b = jax.tree.map(lambda x, y, i=i: x.at[i].add(y), b, f)
        return b
    out = dict(a)
    for i, f in b.items():
        out[i] = out[i] + f if i in out else f
    return out


def generalized_of_links(d: Driver, joints: Any, f_ext: LinkForces) -> Any:
    """Compute the generalized forces sum J_i^T f_i of external forces, per link."""

    def inward(x, children):
        link, joint, f_ext = x
        f = f_ext + children[0]
        tau, block = joint.project(f, children[1])
        return (joint.transform(link).T(f), block), tau

    return d.inward(inward, NO_FORCE, d.zip(d.constants, joints, per_link(d, f_ext)))


def wrenches_to_links(d: Driver, joints: Any, wrenches: jax.Array) -> LinkForces:
    """Convert wrenches (nb, 6) on bodies, in world axes at their origins, to forces on links."""
    top = d.topology
    rotations = d.whole(*sweep(d, joints, ROTATION))
    if not d.listed:
        bodies = np.array([b for b, k in enumerate(top.body_links) if k != WORLD], int)
        links = [top.body_links[b] for b in bodies]
        arms = Vec3(*jnp.asarray(d.prepared.body_p, wrenches.dtype)[bodies].T)
        found = _to_link(d.take(rotations, links), arms, Force.from_lanes(wrenches[bodies].T))
        return over_links(d, np.array(links, int), found, wrenches.dtype)
    out: dict[int, Force] = {}
    for b, k in enumerate(top.body_links):
        if k != WORLD:
            f = _to_link(rotations[k], d.prepared.weld(b).p, Force.from_lanes(wrenches[b]))
            out[k] = out[k] + f if k in out else f
    return out


def _to_link(R: Mat3, arm: Vec3, wrench: Force) -> Force:
    """Transform a wrench in world axes at a point of a link to the link's axes and origin."""
    force = R.T @ wrench.lin
    return Force(R.T @ wrench.ang + arm.cross(force), force)


def newton_euler(x: Any, parent: Accelerated) -> tuple[Accelerated, Any]:
    """Run one outward step of RNEA.

    Return the pose of a link in its parent, I a + bias force - f_ext, and the inertial forces of
    the coordinates of a flexible link.
    """
    link, joint, qdd, f_ext = x
    X = joint.transform(link)
    w, a, block = here = ACCELERATION.step(Hop(X, joint, qdd), parent)
    inertia = joint.inertia(link)
    f = inertia(a) + inertia.bias_force(w) - f_ext
    own = joint.link_inertia(w)
    if own is None:
        return here, (X, f, ())
    wrench, forces = own.inertial_forces(w, a, block)
    return here, (X, f + wrench, forces)


def rnea(
    d: Driver, joints: Any, accelerations: Any, gravity: Vec3, f_ext: LinkForces | None = None
) -> Any:
    """Compute the generalized forces from the joint accelerations, both per link."""

    def inward(x, children):
        (link, joint, qdd, _), (X, f, forces) = x
        f = f + children[0]
        tau, block = joint.project(f, add_blocks(forces, children[1]))
        return (X.T(f), block), add(tau, mul(link.armature, qdd))

    xs = d.zip(d.constants, joints, accelerations, per_link(d, f_ext))
    return d.out_and_in(newton_euler, _root(gravity), inward, NO_FORCE, xs)


def transmitted_forces(
    d: Driver, joints: Any, accelerations: Any, gravity: Vec3, f_ext: LinkForces | None = None
) -> Any:
    """Compute the pose of each link in its parent, I a + bias force - f_ext, and the inertial
    forces of the coordinates of a flexible link, per link."""
    xs = d.zip(d.constants, joints, accelerations, per_link(d, f_ext))
    return d.outward(newton_euler, _root(gravity), xs)


def _root(gravity: Vec3) -> Accelerated:
    return accelerated_base(Motion(Vec3.zero(), -gravity)).root


def _run(
    model: Model, q, v, a, gravity: Vec3 | None = None, wrenches=None, f_ext=None
) -> jax.Array:
    if not model.nv:
        return jnp.zeros(0, q.dtype)
    if model.topology.frames and v is not None and a is not None and gravity is None:
        if wrenches is not None:
            d = driver(model, q.dtype)
            f_ext = wrenches_to_links(d, d.joints(q, None), wrenches)
        return with_gradient_of_power(rnea, model, q, v, a, f_ext)[0]
    d = driver(model, q.dtype)
    g = d.prepared.gravity if gravity is None else gravity
    joints = d.joints(q, v)
    f_ext = f_ext if wrenches is None else wrenches_to_links(d, joints, wrenches)
    tau = rnea(d, joints, d.lanes(a), g, f_ext)
    return d.pack(tau, jnp.zeros((model.nv, *q.shape[1:]), q.dtype))


def momentum(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """Compute the generalized momentum p = M(q) v (nv,), by RNEA at rest without gravity."""
    return _run(model, q, None, v, gravity=Vec3.zero())


def forces_at(
    model: Model, q: jax.Array, v: jax.Array, a: jax.Array, f_ext: LinkForces
) -> jax.Array:
    """Compute the generalized forces (nv,) for the acceleration a, given external link forces."""
    return _run(model, q, v, a, f_ext=f_ext)


@algorithm("q", "v", "a", "wrenches")
def inverse_dynamics(
    model: Model, q: ArrayLike, v: ArrayLike, a: ArrayLike, wrenches: ArrayLike | None = None
) -> jax.Array:
    """Compute the generalized forces tau (nv,) that cause the acceleration a.

    tau = M(q) a + b(q, v) - sum_b J_b^T w_b, without force elements and constraints. The forces of
    actuators and force elements are `rb.applied_forces`.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        a: (nv,) acceleration, the rate of v.
        wrenches: (nb, 6) external [moment N m; force N] on bodies, in world axes, at their origins.

    Returns:
        (nv,) N m for rotations, N for translations. It is the total force: forces of springs,
        dampers and actuators are not subtracted.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite, zero quaternions.

    Source: Featherstone, *Rigid Body Dynamics Algorithms*, ch. 5; Cai Zixing, *Robotics*, ch. 4.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> state = model.default_state()
        >>> rb.inverse_dynamics(model, state.q, state.v, state.v).shape
        (1,)
    """
    return _run(model, q, v, a, wrenches=wrenches)


@algorithm("q", "v")
def bias_forces(model: Model, q: ArrayLike, v: ArrayLike) -> jax.Array:
    """Compute the bias forces b(q, v) (nv,) of velocity and gravity, with M a + b = tau.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

    Returns:
        (nv,), N and N m.

    Source: Featherstone, 5.3 (RNEA with a = 0).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("cart_pole")
        >>> state = model.default_state()
        >>> rb.bias_forces(model, state.q, state.v).shape
        (2,)
    """
    return _run(model, q, v, None)


@algorithm("q")
def gravity_forces(model: Model, q: ArrayLike) -> jax.Array:
    """Compute the forces g(q) = dV/dq (nv,) that hold the robot at rest against gravity.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Returns:
        (nv,), N and N m.

    Source: Lynch & Park, *Modern Robotics*, 8.3 (RNEA with v = a = 0).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("cart_pole")
        >>> rb.gravity_forces(model, model.default_state().q).shape
        (2,)
    """
    return _run(model, q, None, None)
