"""Energy, centre of mass and momentum.

T = v^T M v / 2 = sum of V.(I V) / 2 + armature v^2 / 2;   U = -sum of m g.c
h_G = [sum of I_b w + m (c_b - c) x v_b;  sum of m v_b]      (Orin, Goswami & Lee 2013)
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.dynamics.algorithms.kinematics import (
    TWIST,
    body_velocities,
    forward_kinematics,
    sweep,
)
from rbjax.dynamics.drivers.choice import driver
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.lanes import add, matmat, matvec, mul
from rbjax.model import Model


@algorithm("q", "v")
def kinetic_energy(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """T = v^T M(q) v / 2 in joules, armature included, in O(n).

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> float(rb.kinetic_energy(model, model.default_state().q, model.default_state().v))
        0.0
    """
    d = driver(model, q.dtype)
    joints = d.joints(q, v)
    (twists,) = sweep(d, joints, TWIST)

    def step(x, children):
        link, joint, V = x
        twice = add(V.dot(link.inertia(V)), mul(link.armature, mul(joint.qd, joint.qd)))
        return (), twice

    twice = d.inward(step, (), d.zip(d.constants, joints, twists))
    return d.pack(twice, v).sum() / 2


@algorithm("q")
def potential_energy(model: Model, q: jax.Array) -> jax.Array:
    """U = -sum of m g.c in joules, of gravity only (springs: `rbjax.forces.elastic_energy`).

    Args:
        model: the robot.
        q: (nq,) configuration.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> rb.potential_energy(model, model.default_state().q).shape
        ()
    """
    _, com, mass = _centres(model, q)
    return -(mass * (com * model.gravity.astype(q.dtype)).sum(-1)).sum()


@algorithm("q")
def center_of_mass(model: Model, q: jax.Array) -> jax.Array:
    """The centre of mass (3,) of all bodies, in the world, in metres.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("quadruped")
        >>> rb.center_of_mass(model, model.default_state().q).shape
        (3,)
    """
    _, com, mass = _centres(model, q)
    return (mass[:, None] * com).sum(0) / mass.sum()


@algorithm("q", "v")
def centroidal_momentum(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """Momentum (6,) of all bodies: [angular, about the centre of mass; linear], world axes.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

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
    arm = com - (mass[:, None] * com).sum(0) / mass.sum()
    momentum = mass[:, None] * speed
    return jnp.concatenate([(spin + jnp.cross(arm, momentum)).sum(0), momentum.sum(0)])


def _centres(model: Model, q: jax.Array):
    """Poses, positions of the centres of mass in the world (nb, 3), masses (nb,)."""
    poses = forward_kinematics(model, q)
    bodies = model.bodies
    com = poses.p + matvec(poses.R, bodies.com.astype(q.dtype))
    return poses, com, bodies.mass.astype(q.dtype)
