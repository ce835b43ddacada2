"""The inertial regressor: Newton-Euler equations are linear in each body's ten inertial parameters
(Khalil & Dombre, *Modeling, Identification and Control of Robots*, ch. 12).
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike
from rbjax.compiler import compile_threads, map_threads
from rbjax.dynamics.algorithms.body_jacobians import ancestor_mask
from rbjax.dynamics.algorithms.composites import link_axes, tree_poses
from rbjax.dynamics.algorithms.kinematics import accelerated_base, body_transforms, sweep
from rbjax.dynamics.arguments import check_model
from rbjax.dynamics.drivers.choice import driver, on_threads
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.errors import ModelError
from rbjax.lanes import Mat3, Vec3, add, batch_first, mul
from rbjax.model import Model
from rbjax.spatial import Force, Motion, Transform


def regressor_factors(
    model: Model, q: jax.Array, v: jax.Array, a: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Compute the axes (nv, 6) of the links and the wrench (6, 10 nb) of each parameter.

    They are in world axes. An entry of the regressor is the product of an axis and a wrench if the
    link moves the body, else zero.
    """
    d = driver(model, q.dtype)
    joints = d.joints(q, v)
    poses = tree_poses(d, joints)
    base = accelerated_base(Motion(Vec3.zero(), -d.prepared.gravity))
    motions = d.whole(*sweep(d, joints, base, a=d.lanes(a)))
    carriers = [max(link, 0) for link in model.topology.body_links]
    wrenches = d.each(
        parameter_wrenches,
        d.take(poses, carriers), body_transforms(d, poses), d.take(motions, carriers),
    )  # fmt: skip
    columns = [
        d.stack(wrenches, lambda forces, k=k: [list(f)[k] for f in forces], q).reshape(-1)
        for k in range(6)
    ]
    return d.stack(link_axes(d, poses, joints), list, q), jnp.stack(columns)


def _moved_by(model: Model) -> np.ndarray:
    """Return the mask (nv, 10 nb) of the regressor: true where the row's dof moves the body."""
    moved = np.stack([ancestor_mask(model.topology, i) for i in model.topology.body_links])
    return np.repeat(moved.T, 10, 1)


def regressor_by_columns(model: Model, q: jax.Array, v: jax.Array, a: jax.Array) -> jax.Array:
    """Compute `inertial_regressor` with two kernels: factors, then a thread for each parameter."""
    model = on_threads(model, q.dtype, long=False)
    S, wrenches = batch_first(compile_threads(lambda *x: regressor_factors(model, *x))(q, v, a))

    def column(wrench: jax.Array, moved: jax.Array) -> list[jax.Array]:
        entries = [functools.reduce(add, map(mul, axis, wrench)) for axis in S]
        return [jnp.where(moved, jnp.stack(entries), 0.0)]

    return map_threads(column, [wrenches, jnp.asarray(_moved_by(model))], [1, 1])[0]


@algorithm("q", "v", "a", multi_kernel=regressor_by_columns)
def inertial_regressor(model: Model, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> jax.Array:
    """Compute the inertial regressor Y (nv, 10 nb), with ID(q, v, a) = Y pi + armature * a.

    pi stacks (m, m c_x, m c_y, m c_z, I_xx, I_xy, I_yy, I_xz, I_yz, I_zz) of each body, in its own
    frame, with the inertia about the frame's origin: `inertial_parameters(model)`.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        a: (nv,) acceleration.

    Returns:
        (nv, 10 nb), in N and N m per unit of pi.

    Raises:
        ModelError: a link is flexible.

    Source: Khalil & Dombre, ch. 12; Atkeson, An & Hollerbach (1986).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> s = model.default_state()
        >>> rb.inertial_regressor(model, s.q, s.v, s.v).shape
        (2, 20)
    """
    if model.topology.frames:
        raise ModelError(
            "inertial_regressor: a link of the model is flexible, and ten inertial parameters do "
            "not describe its inertia; use rbjax.flexible.section_regressor for beams, or "
            "differentiate inverse_dynamics by the parameters of the joint (joints.params)"
        )
    if not model.nv:
        return jnp.zeros((0, 10 * model.nb), q.dtype)
    S, wrenches = regressor_factors(model, q, v, a)
    rows = [S[:, k, None] * wrenches[k, None] for k in range(6)]
    return jnp.where(_moved_by(model), functools.reduce(jnp.add, rows), 0.0)


def parameter_wrenches(link: Transform, body: Transform, motion: tuple) -> tuple[Force, ...]:
    """Compute the wrench on a body from a unit of each of its ten parameters, in world axes.
    `motion` is the angular velocity and the acceleration of the link, in the link's axes."""
    w, alpha, lin = (link.R @ x for x in (motion[0], motion[1].ang, motion[1].lin))
    arm = body.p - link.p
    lin = lin + alpha.cross(arm) + w.cross(w.cross(arm))
    w, alpha, lin = (body.R.T @ x for x in (w, alpha, lin))
    W = Mat3.skew(w)
    second = zip(_inertia_columns(alpha), _inertia_columns(w), strict=True)
    turning = Mat3.skew(alpha) + W @ W
    in_body = [
        Force(Vec3.zero(), lin),
        *map(Force, Mat3.skew(-lin).columns, turning.columns),
        *(Force(by_alpha + w.cross(by_w), Vec3.zero()) for by_alpha, by_w in second),
    ]
    return tuple(body.T(f) for f in in_body)


def _inertia_columns(x: Vec3) -> list[Vec3]:
    """Return the columns of K(x), with I x = K(x) (I_xx, I_xy, I_yy, I_xz, I_yz, I_zz)."""
    a, b, c = x
    o = 0.0
    rows = [(a, o, o), (b, a, o), (o, b, o), (c, o, a), (o, c, b), (o, o, c)]
    return [Vec3(*row) for row in rows]


def inertial_parameters(model: Model) -> jax.Array:
    """Compute the inertial parameters pi (10 nb,) of a model, in the order of the regressor.

    Args:
        model: the robot.

    Returns:
        (10 nb,), kg, kg m and kg m^2.

    Raises:
        InputError: not a model, or a batch of models.

    Example:
        >>> import rbjax as rb
        >>> rb.inertial_parameters(rb.load("pendulum")).shape
        (10,)
    """
    check_model("inertial_parameters", model)
    bodies = model.bodies
    m, c = bodies.mass, bodies.com
    one = np.eye(3, dtype=c.dtype)
    square = (c * c).sum(-1)[:, None, None] * one - c[:, :, None] * c[:, None, :]
    J = bodies.inertia + m[:, None, None] * square
    six = [J[:, 0, 0], J[:, 0, 1], J[:, 1, 1], J[:, 0, 2], J[:, 1, 2], J[:, 2, 2]]
    return jnp.stack([m, *(m * c[:, k] for k in range(3)), *six], -1).reshape(-1)
