"""The pose of a frame, and the twist and bias acceleration of a point of it.

    V = J v = [w; u + w x r],        dV/dt = J a + J' v,
    J' v = [w'; u' + w' x r + w x (w x r)]  with w', u' of the link at constant v
The link that carries the frame has the twist [w; u] and the classical acceleration [w'; u'] at its
own origin; r is the vector from there to the point. (Featherstone, *Rigid Body Dynamics
Algorithms*, 2.11.)
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.algorithms.kinematics import ACCELERATION, POSE, ROTATION, TWIST, sweep
from rbjax.dynamics.algorithms.link_motion import LinkMotion
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.errors import InputError
from rbjax.lanes import Mat3, Vec3
from rbjax.lanes.arrays import pack
from rbjax.model import WORLD, Model, prepare
from rbjax.model.leaves import site_transform
from rbjax.spatial import Motion, Transform

#: a longer path to a site runs on the model's driver. An unrolled link takes 0.06 s to compile, its
#: gradient 0.3 s in a chain of 60; a robot's path has 16 links at most
PATH_UNROLLED_UP_TO = 24


def located(
    where: str, model: Model, like: jax.Array, body: Any, site: Any, point: Any
) -> tuple[int, Transform]:
    """The body of a frame (or WORLD), and the frame's pose in it: axes of the body or of the site,
    origin at the point. `where` is the caller in messages; `like` has the dtype of the lanes."""
    if (body is None) == (site is None):
        got = "neither" if body is None else "both"
        raise InputError(f"{where}: got {got} of body and site, expected exactly one")
    at = Vec3.zero() if point is None else Vec3(*(point[i] for i in range(3)))
    if site is not None:
        i = model.site(site)
        placed = site_transform(model, i, like.dtype)
        at = placed.p + placed.R @ at
        return model.topology.site_bodies[i], Transform(placed.R, at)
    fixed = body == "world" and body not in model.body_names  # MuJoCo's name for the fixed frame
    return WORLD if fixed else model.body(body), Transform(Mat3.identity(), at)


def carried_point(
    where: str, model: Model, d: Driver, like: jax.Array, body: Any, site: Any, point: Any
) -> tuple[int, Vec3]:
    """The link that carries a frame (or WORLD), and the frame's origin in that link's axes.
    Arguments as for `located`."""
    b, frame = located(where, model, like, body, site, point)
    if b == WORLD:
        return WORLD, frame.p
    weld = d.prepared.weld(b)
    return model.topology.body_links[b], weld.p + weld.R @ frame.p


def _row(d: Driver, values: tuple, link: int, f: Any, like: jax.Array) -> jax.Array:
    """The Motion f(*values of one link) as an array (6,)."""
    chosen = d.each(f, *(d.take(d.whole(x), [link]) for x in values))
    return d.stack(chosen, lambda m: m, like)[0]


@algorithm("q", "point")
def frame_pose(
    model: Model,
    q: jax.Array,
    body: str | None = None,
    point: jax.Array | None = None,
    *,
    site: str | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Pose in the world of the frame of a body or site: R (3, 3), p (3,).

    Only the links from the base to the frame are computed. Up to `PATH_UNROLLED_UP_TO` of them are
    unrolled with any driver.

    Args:
        model: the robot.
        q: (nq,) configuration.
        body: the name of a body; "world" is the frame that does not move.
        point: (3,) m in the frame of the body or site: p is its position; the origin if None.
        site: the name of a site, instead of a body.

    Returns:
        R (3, 3), from the axes of the body or site to world axes, and p (3,) m.

    Raises:
        UnknownName: no such body or site; the message lists the names. InputError: both or neither
            given; a wrong shape.

    Source: Featherstone, 4.4.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("arm7")
        >>> R, p = rb.frame_pose(model, model.default_state().q, site="tool")
        >>> p.shape
        (3,)
    """
    top = model.topology
    b, pose = located("frame_pose", model, q, body, site, point)
    link = WORLD if b == WORLD else top.body_links[b]
    path = () if link == WORLD else top.ancestors[link]
    few = len(path) <= PATH_UNROLLED_UP_TO
    d = Unrolled(model, prepare(model, q.dtype)) if few else driver(model, q.dtype)
    if b != WORLD:
        pose = LinkMotion(d, q, None).pose(link).then(d.prepared.weld(b)).then(pose)
    found = pack([*pose.R, *pose.p], jnp.zeros(12, q.dtype))
    return found[:9].reshape(3, 3), found[9:]


@algorithm("q")
def site_pose(model: Model, q: jax.Array, site: str) -> tuple[jax.Array, jax.Array]:
    """The pose of a site in the world: `frame_pose(model, q, site=site)`.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("arm7")
        >>> R, p = rb.site_pose(model, model.default_state().q, "tool")
        >>> p.shape
        (3,)
    """
    return frame_pose(model, q, site=site)


@algorithm("q", "v", "point")
def frame_velocity(
    model: Model,
    q: jax.Array,
    v: jax.Array,
    body: str | None = None,
    point: jax.Array | None = None,
    *,
    site: str | None = None,
) -> jax.Array:
    """Twist (6,) of a point of a body or site: [angular; linear] in world axes, V = J v.

    The cost is one sweep from the root, without a Jacobian.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        body: the name of a body; "world" is the frame that does not move.
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
    d = driver(model, q.dtype)
    link, r = carried_point("frame_velocity", model, d, q, body, site, point)
    if link == WORLD:
        return jnp.zeros(6, q.dtype)

    def at_point(pose, V):
        return Motion(pose.R @ V.ang, pose.R @ (V.lin + V.ang.cross(r)))

    return _row(d, sweep(d, d.joints(q, v), POSE, TWIST), link, at_point, q)


@algorithm("q", "v", "point")
def frame_bias_acceleration(
    model: Model,
    q: jax.Array,
    v: jax.Array,
    body: str | None = None,
    point: jax.Array | None = None,
    *,
    site: str | None = None,
) -> jax.Array:
    """J'(q, v) v (6,): the acceleration of a point of a body or site at constant v.

    This is the classical acceleration, the rate of `frame_velocity`. If the robot accelerates at a,
    the point accelerates at J a + J' v. Gravity is not included. The cost is one sweep from the
    root.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        body: the name of a body; "world" is the frame that does not move.
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
    d = driver(model, q.dtype)
    link, r = carried_point("frame_bias_acceleration", model, d, q, body, site, point)
    if link == WORLD:
        return jnp.zeros(6, q.dtype)

    def at_point(R, motion):
        w, a = motion
        lin = a.lin + a.ang.cross(r) + w.cross(w.cross(r))
        return Motion(R @ a.ang, R @ lin)

    return _row(d, sweep(d, d.joints(q, v), ROTATION, ACCELERATION), link, at_point, q)
