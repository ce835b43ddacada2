"""Pose, twist, bias acceleration and Jacobian of a frame; generalized forces of wrenches.

    V = J v = [w; u + w x r],        dV/dt = J a + J' v,
    J' v = [w'; u' + w' x r + w x (w x r)]  with w', u' of the link at constant v

The link that carries the frame has the twist [w; u] and the classical acceleration [w'; u'] at its
own origin, and r is the vector from there to the point. Vectors are in world axes. Column i of J is
[z_i; z_i x (p - p_i)] for a hinge, [0; z_i] for a slide (Featherstone, 2.11; Lynch & Park, 5.1).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.dynamics.algorithms import kinematics
from rbjax.dynamics.algorithms.body_jacobians import ancestor_mask, point_jacobian
from rbjax.dynamics.algorithms.kinematics import POSE, TWIST, sweep
from rbjax.dynamics.algorithms.manifold import integrate
from rbjax.dynamics.algorithms.rnea import generalized_of_links, wrenches_to_links
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.errors import InputError, UnknownName
from rbjax.lanes import Mat3, Vec3, pack
from rbjax.model import WORLD, Frame, Model, prepare
from rbjax.model.leaves import frame_transform
from rbjax.spatial import Motion, Transform

#: a path to a frame with more links runs on the model's driver, because unrolled code compiles
#: slowly
PATH_UNROLLED_UP_TO = 24


def locate(where: str, model: Model, like: jax.Array, frame: Frame) -> tuple[int, Transform]:
    """Return the body of a frame (or WORLD) and the pose of the frame in the body.
    `where` is the name of the caller in messages. `like` has the dtype of the lanes."""
    if isinstance(frame.body, Frame):  # of a geom or a center of mass
        frame = frame.body._replace(point=frame.point)
    try:
        return frame_transform(model, frame, like.dtype)
    except UnknownName:
        raise
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def locate_on_link(
    where: str, model: Model, d: Driver, like: jax.Array, frame: Frame
) -> tuple[int, Vec3]:
    """Return the link that carries a frame (or WORLD) and the origin of the frame in the link."""
    b, pose = locate(where, model, like, frame)
    if b == WORLD:
        return WORLD, pose.p
    weld = d.prepared.weld(b)
    return model.topology.body_links[b], weld.p + weld.R @ pose.p


def _on_link(where: str, model: Model, q: jax.Array, frame: Frame) -> tuple[int, Vec3]:
    return locate_on_link(where, model, driver(model, q.dtype), q, frame)


@algorithm("q", "point")
def frame_pose(
    model: Model,
    q: ArrayLike,
    body: str | Frame | None = None,
    point: ArrayLike | None = None,
    *,
    site: str | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Compute the pose R (3, 3), p (3,) of the frame of a body or site, along its path of links.

    Args:
        model: the robot.
        q: (nq,) configuration.
        body: the name of a body, or an `rb.Frame`; "world" is the fixed frame.
        point: (3,) m in the frame of the body or site: p is its position; the origin if None.
        site: the name of a site, instead of a body.

    Returns:
        R (3, 3), from the axes of the body or site to world axes, and p (3,) m.

    Raises:
        UnknownName: no such body or site; the message lists the names.
        InputError: both or neither of body and site given; a wrong shape.

    Source: Featherstone, 4.4.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("arm7")
        >>> R, p = rb.frame_pose(model, model.default_state().q, site="tool")
        >>> p.shape
        (3,)
    """
    top = model.topology
    b, pose = locate("frame_pose", model, q, Frame(body, point, site))
    link = WORLD if b == WORLD else top.body_links[b]
    path = () if link == WORLD else top.ancestors[link]
    few = len(path) <= PATH_UNROLLED_UP_TO
    d = Unrolled(model, prepare(model, q.dtype)) if few else driver(model, q.dtype)
    if b != WORLD:
        carrier = kinematics.LinkMotion(d, q, None).pose(link)
        pose = carrier.then(d.prepared.weld(b)).then(pose)
    found = pack([*pose.R, *pose.p], jnp.zeros(12, q.dtype))
    return found[:9].reshape(3, 3), found[9:]


def _point_motion(
    where: str, model: Model, state: tuple[jax.Array, jax.Array], frame: Frame, quantities: tuple,
    motion: Callable[..., Motion],
) -> jax.Array:  # fmt: skip
    """Compute a spatial vector (6,) of a frame at its origin; zero if it is fixed to the world.

    quantities: quantities of links to compute by an outward sweep.
    motion: function (r, *values) that returns the vector, from the origin r of the frame in its
        link and the values of the quantities of this link.
    """
    q, v = state
    d = driver(model, q.dtype)
    link, r = locate_on_link(where, model, d, q, frame)
    if link == WORLD:
        return jnp.zeros(6, q.dtype)
    values = sweep(d, d.joints(q, v), *quantities)
    chosen = d.each(lambda *x: motion(r, *x), *(d.take(d.whole(x), [link]) for x in values))
    return d.stack(chosen, lambda m: m, q)[0]


@algorithm("q", "v", "point")
def frame_velocity(
    model: Model,
    q: ArrayLike,
    v: ArrayLike,
    body: str | Frame | None = None,
    point: ArrayLike | None = None,
    *,
    site: str | None = None,
) -> jax.Array:
    """Compute the twist (6,) of a point of a body or site: [angular; linear] in world axes.

    It is V = J v, computed by one sweep from the root, without a Jacobian.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        body: the name of a body, or an `rb.Frame`; "world" is the frame that does not move.
        point: (3,) m in the frame of the body or site; its origin if None.
        site: the name of a site, instead of a body.

    Returns:
        (6,), rad/s and m/s; zero if the frame is fixed to the world.

    Raises:
        UnknownName: no such body or site. InputError: both or neither given; a wrong shape.

    Source: Featherstone, 2.2, 4.4.

    Example:
        >>> import rbjax as rb, jax
        >>> model = rb.load("arm7")
        >>> state = model.random_state(jax.random.key(0))
        >>> rb.frame_velocity(model, state.q, state.v, site="tool").shape
        (6,)
    """

    def at_point(r: Vec3, pose: Transform, V: Motion) -> Motion:
        return Motion(pose.R @ V.ang, pose.R @ (V.lin + V.ang.cross(r)))

    frame = Frame(body, point, site)
    return _point_motion("frame_velocity", model, (q, v), frame, (POSE, TWIST), at_point)


@algorithm("q", "v", "point")
def frame_bias_acceleration(
    model: Model,
    q: ArrayLike,
    v: ArrayLike,
    body: str | Frame | None = None,
    point: ArrayLike | None = None,
    *,
    site: str | None = None,
) -> jax.Array:
    """Compute J'(q, v) v (6,), the acceleration of a point of a body or site at constant v.

    This is the classical acceleration, the rate of `frame_velocity`. If the robot accelerates at a,
    the point accelerates at J a + J' v. Gravity is not included. The cost is one sweep from the
    root.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        body: the name of a body, or an `rb.Frame`; "world" is the frame that does not move.
        point: (3,) m in the frame of the body or site; its origin if None.
        site: the name of a site, instead of a body.

    Returns:
        (6,) [angular; linear] in world axes, rad/s^2 and m/s^2; zero if the frame is fixed to the
        world.

    Raises:
        UnknownName: no such body or site. InputError: both or neither given; a wrong shape.

    Source: Featherstone, 2.11; Luh, Walker & Paul (1980).

    Example:
        >>> import rbjax as rb, jax
        >>> model = rb.load("arm7")
        >>> state = model.random_state(jax.random.key(0))
        >>> rb.frame_bias_acceleration(model, state.q, state.v, site="tool").shape
        (6,)
    """

    def at_point(r: Vec3, R: Mat3, motion: kinematics.Accelerated) -> Motion:
        w, a, _ = motion
        lin = a.lin + a.ang.cross(r) + w.cross(w.cross(r))
        return Motion(R @ a.ang, R @ lin)

    frame, needed = Frame(body, point, site), (kinematics.ROTATION, kinematics.ACCELERATION)
    return _point_motion("frame_bias_acceleration", model, (q, v), frame, needed, at_point)


def _jacobian(
    where: str,
    model: Model,
    state: tuple[jax.Array, jax.Array | None],
    frame: Frame,
    columns: Callable[..., Any],
) -> jax.Array:
    """Compute the matrix (6, nv) with the columns columns(d, joints, link, r, moves).
    `moves` is 1 for each dof that moves the link, else 0. r is the frame's origin in the link."""
    q, v = state
    d = driver(model, q.dtype)
    link, r = locate_on_link(where, model, d, q, frame)
    if link == WORLD:
        return jnp.zeros((6, model.nv), q.dtype)
    joints = d.joints(q, v)
    moves = d.literals([1.0 if x else 0.0 for x in ancestor_mask(d.topology, link)])
    return d.stack(columns(d, joints, link, r, moves), lambda m: m, q).T


@algorithm("q", "point")
def jacobian(
    model: Model,
    q: ArrayLike,
    body: str | Frame | None = None,
    point: ArrayLike | None = None,
    *,
    site: str | None = None,
) -> jax.Array:
    """Compute the Jacobian (6, nv) of a point of a body or site, with V = J v.

    Args:
        model: the robot.
        q: (nq,) configuration.
        body: the name of a body, or an `rb.Frame`; "world" is the frame that does not move.
        point: (3,) m in the frame of the body or site; its origin if None.
        site: the name of a site, instead of a body.

    Returns:
        (6, nv) [angular; linear] in world axes; zero for coordinates that do not move the point.

    Raises:
        UnknownName: no such body or site. InputError: both or neither given; a wrong shape.

    Source: Lynch & Park, *Modern Robotics*, 5.1 (who refer V to the world's origin).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rb.jacobian(model, model.default_state().q, "lower").shape
        (6, 2)
    """

    if model.topology.frames:
        return point_jacobian(model, q, *_on_link("jacobian", model, q, Frame(body, point, site)))

    def column(pose: Transform, at: Vec3, S: Motion, moves: Any) -> Motion:
        S = S * moves
        return Motion(spin := pose.R @ S.ang, spin.cross(at - pose.p) + pose.R @ S.lin)

    def columns(d: Driver, joints: Any, link: int, r: Vec3, moves: Any) -> Any:
        poses = d.whole(*sweep(d, joints, POSE))
        here = d.each(lambda pose: pose.p + pose.R @ r, d.take(poses, [link]))
        return d.each(column, poses, d.take(here, [0] * model.nv), d.whole_axes(joints), moves)

    return _jacobian("jacobian", model, (q, None), Frame(body, point, site), columns)


@algorithm("q", "v", "point")
def jacobian_rate(
    model: Model,
    q: ArrayLike,
    v: ArrayLike,
    body: str | Frame | None = None,
    point: ArrayLike | None = None,
    *,
    site: str | None = None,
) -> jax.Array:
    """Compute J'(q, v) (6, nv), the time derivative of `jacobian` while the robot moves at v.

    It uses z' = w x z and (z x r)' = z' x r + z x r'. `frame_bias_acceleration` is J' v.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        body: the name of a body, or an `rb.Frame`; "world" is the frame that does not move.
        point: (3,) m in the frame of the body or site; its origin if None.
        site: the name of a site, instead of a body.

    Returns:
        (6, nv) [angular; linear] in world axes.

    Raises:
        UnknownName: no such body or site. InputError: both or neither given; a wrong shape.

    Source: Featherstone, 2.10 (the derivative of `jacobian`, written out).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> state = model.default_state()
        >>> rb.jacobian_rate(model, state.q, state.v, "lower").shape
        (6, 2)
    """

    if model.topology.frames:
        at = _on_link("jacobian_rate", model, q, Frame(body, point, site))
        h = jnp.zeros((), q.dtype)
        moved = lambda h: point_jacobian(model, integrate(model, q, h * v), *at)  # noqa: E731
        return jax.jvp(moved, (h,), (jnp.ones_like(h),))[1]

    def in_world(pose: Transform, V: Motion) -> tuple[Transform, Motion]:
        return pose, Motion(pose.R @ V.ang, pose.R @ V.lin)

    def column(x, carrier, point, moves, S, S_rate=None):
        (pose, V), (_, T), (at, speed) = x, carrier, point
        if S_rate is None:  # both parts of S are along z
            axis = pose.R.columns[2] * moves
            rate = T.ang.cross(axis)
            z, spin, slip = axis * S.ang[2], rate * S.ang[2], rate * S.lin[2]
        else:
            z, slid = pose.R @ (S.ang * moves), pose.R @ (S.lin * moves)
            spin = T.ang.cross(z) + pose.R @ (S_rate.ang * moves)
            slip = T.ang.cross(slid) + pose.R @ (S_rate.lin * moves)
        return Motion(spin, spin.cross(at - pose.p) + z.cross(speed - V.lin) + slip)

    def columns(d: Driver, joints: Any, link: int, r: Vec3, moves: Any) -> Any:
        def at_point(x):
            pose, V = x
            arm = pose.R @ r
            return pose.p + arm, V.lin + V.ang.cross(arm)

        links = d.each(in_world, *map(d.whole, sweep(d, joints, POSE, TWIST)))
        points = d.take(d.each(at_point, d.take(links, [link])), [0] * model.nv)
        carriers = d.take(links, [dof.node[-1] for dof in d.topology.dofs])
        S = [d.whole_axes(joints)]
        if not d.topology.constant_axes:
            S.append(d.whole(d.axes(joints)[1]))
        return d.each(column, links, carriers, points, moves, *S)

    return _jacobian("jacobian_rate", model, (q, v), Frame(body, point, site), columns)


@algorithm("q", "wrenches")
def generalized_forces(model: Model, q: ArrayLike, wrenches: ArrayLike) -> jax.Array:
    """Compute the generalized forces (nv,) of wrenches on bodies: tau = sum_b J_b^T w_b.

    Args:
        model: the robot.
        q: (nq,) configuration.
        wrenches: (nb, 6) [moment N m; force N], world axes, at each body's frame origin.

    Returns:
        (nv,), N and N m.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> push = jnp.zeros((2, 6)).at[0, 3].set(1.0)
        >>> rb.dynamics.generalized_forces(model, model.default_state().q, push).shape
        (2,)
    """
    if not model.nv:
        return jnp.zeros(0, q.dtype)
    d = driver(model, q.dtype)
    joints = d.joints(q, None)
    tau = generalized_of_links(d, joints, wrenches_to_links(d, joints, wrenches))
    return d.pack(tau, jnp.zeros(model.nv, q.dtype))
