"""Recursive Newton-Euler algorithm: inverse dynamics in O(n) (Luh, Walker & Paul 1980).

    outward   w = E w_p + rate;   a = X(a_p) + c + S qdd       (classical accelerations)
              f = I a + [w x J w; w x (w x h)]
    inward    f = f + sum of X^T f of the children;   tau = S.f + armature qdd
Gravity is an acceleration of the base, a_0 = -g.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.algorithms.aba import bias_force
from rbjax.dynamics.algorithms.kinematics import ACCELERATION, Hop, accelerated_base
from rbjax.dynamics.algorithms.link_forces import LinkForces, on_links, per_link
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.lanes import Vec3, add, mul
from rbjax.model import Model
from rbjax.spatial import Force, Motion


def newton_euler(x: Any, parent: tuple[Vec3, Motion]) -> tuple[tuple[Vec3, Motion], Any]:
    """Outward step: a link's pose, and the force that its motion needs beyond its push."""
    link, joint, qdd, push = x
    X = joint.transform(link)
    w, a = ACCELERATION.step(Hop(X, joint, qdd), parent)
    return (w, a), (X, link.inertia(a) + bias_force(link.inertia, w) - push)


def rnea(
    d: Driver, joints: Any, accelerations: Any, gravity: Vec3, f_ext: LinkForces | None = None
) -> Any:
    """Generalized forces per link, from `accelerations` per link. `f_ext`: external forces on
    links."""

    def inward(x, children):
        (link, joint, qdd, _), (X, f) = x
        f = f + children
        return X.T(f), add(joint.S.dot(f), mul(link.armature, qdd))

    xs = d.zip(d.constants, joints, accelerations, per_link(d, f_ext))
    return d.out_and_in(newton_euler, _root(gravity), inward, Force.zero(), xs)


def forces_on_links(
    d: Driver, joints: Any, accelerations: Any, gravity: Vec3, f_ext: LinkForces | None = None
) -> Any:
    """As `rnea`, per link: its pose in its parent, and the force that it needs beyond its push, in
    its axes at its origin."""
    xs = d.zip(d.constants, joints, accelerations, per_link(d, f_ext))
    return d.outward(newton_euler, _root(gravity), xs)


def _root(gravity: Vec3) -> tuple[Vec3, Motion]:
    return accelerated_base(Motion(Vec3.zero(), -gravity)).root


def _run(
    model: Model, q, v, a, gravity: Vec3 | None = None, wrenches=None, f_ext=None
) -> jax.Array:
    if not model.nv:
        return jnp.zeros(0, q.dtype)
    d = driver(model, q.dtype)
    g = d.prepared.gravity if gravity is None else gravity
    joints = d.joints(q, v)
    f_ext = f_ext if wrenches is None else on_links(d, joints, wrenches)
    tau = rnea(d, joints, d.lanes(a), g, f_ext)
    return d.pack(tau, jnp.zeros((model.nv, *q.shape[1:]), q.dtype))


def momentum(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """p = M(q) v (nv,): the forces that give the acceleration v from rest, without gravity."""
    return _run(model, q, None, v, gravity=Vec3.zero())


def forces_of(
    model: Model, q: jax.Array, v: jax.Array, a: jax.Array, f_ext: LinkForces
) -> jax.Array:
    """The generalized forces (nv,) that, with forces on links, give the acceleration a."""
    return _run(model, q, v, a, f_ext=f_ext)


@algorithm("q", "v", "a", "wrenches")
def inverse_dynamics(
    model: Model, q: jax.Array, v: jax.Array, a: jax.Array, wrenches: jax.Array | None = None
) -> jax.Array:
    """Compute the forces of the bodies only: no actuators, force elements or constraints.

    tau = M(q) a + b(q, v) - sum_b J_b^T w_b gives the acceleration a. `rb.applied_forces` are those
    of actuators and force elements.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        a: (nv,) acceleration, the rate of v.
        wrenches: (nb, 6) external [moment N m; force N] on bodies, in world axes, at their origins.

    Returns:
        (nv,) N m for rotational coordinates, N for sliding ones. This is the total force: forces of
        springs, dampers and actuators are not subtracted.

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
def bias_forces(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """b(q, v): Coriolis, centrifugal, gyroscopic and gravity forces (nv,); M a + b = tau.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

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
def gravity_forces(model: Model, q: jax.Array) -> jax.Array:
    """g(q) = dV/dq on the tangent space (nv,): the forces that hold the robot against gravity.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Source: Lynch & Park, *Modern Robotics*, 8.3 (RNEA with v = a = 0).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("cart_pole")
        >>> rb.gravity_forces(model, model.default_state().q).shape
        (2,)
    """
    return _run(model, q, None, None)
