"""Forward kinematics: poses, twists and accelerations of links and bodies, by one outward sweep.

    R_WC = R_WP R_PC,   p_WC = p_WP + R_WP p_PC,   w_C = w_P + z qd,   v_C = v_P + w_P x r + z qd
    a_C = a_P + w_P' x r + w_P x (w_P x r) + 2 w_P x z qd + z qdd      (classical accelerations)
(Featherstone, 4.4; Lynch & Park, *Modern Robotics*, ch. 4-5.)
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike
from rbjax.display import displayed
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.joints import JointMotion
from rbjax.joints.joint import Block
from rbjax.lanes import Lane, Mat3, Vec3, fusion_barrier
from rbjax.model import WORLD, Model, Topology
from rbjax.spatial import Force, Motion, Transform

#: a map from link index to force, or columns over all links
LinkForces = Mapping[int, Force] | Force


def per_link(d: Driver, f_ext: LinkForces | None) -> Any:
    """Convert external forces to per-link values."""
    if isinstance(f_ext, Force):
        return jax.tree.map(lambda *x: Force.from_lanes(x), *map(d.lanes, f_ext))
    return d.scattered(f_ext or {}, Force.zero())


@displayed
class Poses(NamedTuple):
    """Rotation R (nb, 3, 3), body to world axes, and position p (nb, 3) of each body's frame."""

    R: jax.Array
    p: jax.Array


class Hop(NamedTuple):
    """The input of an outward step: pose X of a link in its parent, its joint motion, and qdd."""

    X: Transform
    joint: JointMotion
    qdd: Lane = 0.0


class Quantity(NamedTuple):
    """A quantity of links that is computed by an outward recursion.

    root: value of the world.
    step: function of (hop, value of the parent) that returns the value of a link.
    """

    root: Any
    step: Callable[[Hop, Any], Any]


def velocity_bias(joint: JointMotion, X: Transform, w_parent: Vec3) -> tuple[Vec3, Motion]:
    """Compute the angular velocity of a link, and its acceleration at qdd = 0 and a_parent = 0."""
    turned = X.E @ w_parent
    w = turned + joint.rate
    centripetal = X.E @ w_parent.cross(w_parent.cross(X.p))
    coriolis = turned.cross(joint.twist.lin) * 2.0
    return w, Motion(turned.cross(joint.rate), centripetal + coriolis) + joint.bias


#: angular velocity and acceleration of a link, and the accelerations of the coordinates of the
#: flexible link to which it belongs
Accelerated = tuple[Vec3, Motion, Block]


def _acceleration(hop: Hop, parent: Accelerated) -> Accelerated:
    w_parent, a_parent, block = parent
    w, bias = velocity_bias(hop.joint, hop.X, w_parent)
    relative, block = hop.joint.accelerate(hop.qdd, block)
    return w, hop.X(a_parent) + bias + relative, block


#: the rotation of a link in the world
ROTATION = Quantity(Mat3.identity(), lambda hop, R: R @ hop.X.R)
#: the pose of a link in the world
POSE = Quantity(Transform(Mat3.identity(), Vec3.zero()), lambda hop, pose: pose.then(hop.X))
#: the twist of a link in its own axes, at its origin
TWIST = Quantity(Motion.zero(), lambda hop, V: hop.X(V) + hop.joint.twist)
#: the angular velocity of a link, a `Motion` of its angular acceleration and the classical
#: acceleration of its origin, in its own axes, and the block of a flexible link
ACCELERATION = Quantity((Vec3.zero(), Motion.zero(), ()), _acceleration)


def accelerated_base(a: Motion) -> Quantity:
    """Return the quantity `ACCELERATION` for a base with acceleration a, or -g for gravity g."""
    return ACCELERATION._replace(root=(Vec3.zero(), a, ()))


def sweep(d: Driver, joints: Any, *quantities: Quantity, a: Any = None) -> tuple[Any, ...]:
    """Compute quantities of all links by one outward sweep. `a` is joint accelerations per link."""

    def step(x, parents):
        link, joint, *qdd = x
        hop = Hop(joint.transform(link), joint, *qdd)
        here = tuple(y.step(hop, parent) for y, parent in zip(quantities, parents, strict=True))
        return here, here

    xs = d.zip(d.constants, joints) if a is None else d.zip(d.constants, joints, a)
    return d.unzip(d.outward(step, tuple(y.root for y in quantities), xs), len(quantities))


def body_transforms(d: Driver, poses: Any) -> Any:
    """Compute the pose of each body from the poses of the links. Both are lists, or columns over
    all bodies and links (the whole form of the driver)."""
    top = d.topology
    if d.listed:
        welds = [d.prepared.weld(b) for b in range(top.nb)]
        root = Transform(Mat3.identity(), Vec3.zero())
        carriers = [root if k == WORLD else poses[k] for k in top.body_links]
        return d.each(Transform.then, carriers, welds)
    fixed = np.array(top.body_links) == WORLD
    carrier = d.take(poses, [max(k, 0) for k in top.body_links])
    if fixed.any():
        own = list(zip(carrier.R, Mat3.identity(), strict=True))
        carrier = Transform(
            Mat3(*(jnp.where(fixed, one, x) for x, one in own)),
            Vec3(*(jnp.where(fixed, 0.0, x) for x in carrier.p)),
        )
    weld = jax.tree.map(lambda x: jnp.asarray(x, carrier.p[0].dtype), d.prepared.welds)
    return d.each(Transform.then, carrier, weld)


@algorithm("q")
def forward_kinematics(model: Model, q: ArrayLike) -> Poses:
    """Compute the poses of all bodies in the world.

    R_WC = R_WP R_PC, p_WC = p_WP + R_WP p_PC.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Returns:
        `Poses(R (nb, 3, 3), p (nb, 3))` in metres, in the order of the file, without the world.

    Raises:
        InputError: wrong shape or dtype, values that are not finite, zero quaternions.

    Source: Featherstone, *Rigid Body Dynamics Algorithms*, 4.4.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> poses = rb.forward_kinematics(model, model.default_state().q)
        >>> poses.p.shape
        (2, 3)
    """
    d = driver(model, q.dtype)
    if not model.nv:
        made = d.prepared
        return Poses(jnp.asarray(made.body_R, q.dtype), jnp.asarray(made.body_p, q.dtype))
    poses = body_transforms(d, d.whole(*sweep(d, d.joints(q, None), POSE)))
    R, p = d.stack(poses, lambda pose: pose.R, q), d.stack(poses, lambda pose: pose.p, q)
    return Poses(R.reshape(-1, 3, 3), p)


@algorithm("q", "v")
def body_velocities(model: Model, q: ArrayLike, v: ArrayLike) -> jax.Array:
    """Compute the twists of all bodies (nb, 6), at the origins of their frames in world axes.

    A twist is [angular; linear], V_b = J_b(q) v.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

    Returns:
        (nb, 6), rad/s and m/s.

    Source: Featherstone, 4.4.

    Example:
        >>> import rbjax as rb, jax
        >>> model = rb.load("cart_pole")
        >>> state = model.random_state(jax.random.key(0))
        >>> rb.body_velocities(model, state.q, state.v).shape
        (2, 6)
    """
    d = driver(model, q.dtype)
    if not model.nv:
        return jnp.zeros((model.nb, 6), q.dtype)
    poses, twists = sweep(d, d.joints(q, v), POSE, TWIST)
    poses, twists = d.whole(poses), d.whole(twists)
    link = [max(k, 0) for k in model.topology.body_links]
    moves = d.literals([0.0 if k == WORLD else 1.0 for k in model.topology.body_links])

    def in_world(body, link, V, moves):
        ang = (link.R @ V.ang) * moves
        return Motion(ang, (link.R @ V.lin) * moves + ang.cross(body.p - link.p))

    carriers = d.take(poses, link), d.take(twists, link)
    return d.stack(d.each(in_world, body_transforms(d, poses), *carriers, moves), lambda V: V, q)


def over_links(d: Driver, links: np.ndarray, forces: Force, dtype: Any) -> Force:
    """Sum forces by link. `links` may contain repeats. Each lane of the result is an array over all
    links."""
    nothing = jnp.zeros(d.topology.nv, dtype)
    return jax.tree.map(lambda x: nothing.at[links].add(x), forces)


def dof_axes(top: Topology, link: int, joint: JointMotion) -> list[tuple[int, Motion]]:
    """Return the dofs that move a link relative to its parent, with their axes S in its axes.

    All coordinates of a flexible link move each of its frames. The dofs of the coordinates do not
    move the base frame, so they have no dofs here.
    """
    if joint.frame_axes is not None:
        return list(zip(top.links[link].v, joint.frame_axes, strict=True))
    return [] if joint.coordinate_of is not None else [(link, joint.S)]


class LinkMotion:
    """Poses, twists and accelerations of single links at (q, v, a), computed on first use.

    Use it for force elements on a few links, such as a spring between two points: the recursions
    run along the path from the base to a link. Use `columns` and `scattered` for elements on many
    bodies. v = None and a = None mean zero.
    """

    def __init__(self, d: Driver, q: jax.Array, v: jax.Array | None, a: jax.Array | None = None):
        self.driver, self._q, self._v, self._a = d, q, v, a
        #: quantity -> computed values by link, or columns
        self._found: dict[Quantity, Any] = {}

    def accelerating(self, a: jax.Array) -> LinkMotion:
        """Return a copy with the accelerations a (nv,)."""
        out = copy.copy(self)
        out._a, out._found = a, {k: x for k, x in self._found.items() if k is not ACCELERATION}
        return out

    def pose(self, link: int) -> Transform:
        """Return the pose of a link in the world."""
        return self._of(POSE, link)

    def twist(self, link: int) -> Motion:
        """Return the twist of a link in its own axes, at its origin."""
        return self._of(TWIST, link)

    def acceleration(self, link: int) -> Motion:
        """Return the angular acceleration of a link and the classical acceleration of its origin.
        They are in the axes of the link, without gravity."""
        return self._of(ACCELERATION, link)[1]

    def _of(self, quantity: Quantity, link: int) -> Any:
        """Compute a quantity of a link by recursion along the path from the base to the link."""
        if link == WORLD:
            return quantity.root
        if not self.driver.listed:
            return _row(self._columns(quantity), link)
        found = self._found.setdefault(quantity, {WORLD: quantity.root})
        for i in self.driver.topology.ancestors[link]:
            if i in found:
                continue
            parent = found[self.driver.topology.parents[i]]
            joint, constants = self._links[i]
            hop = Hop(joint.transform(constants), joint)
            if quantity is ACCELERATION and self._a is not None:
                hop = hop._replace(qdd=self._a[i] if i < len(self._a) else 0.0)
            known = (parent, joint, constants)
            found[i] = fusion_barrier(quantity.step(hop, parent), known=known)
        return found[link]

    def to_parent(self, link: int) -> tuple[Transform, JointMotion]:
        """Return the pose of a link in its parent, and the motion of its joint."""
        joint, constants = self._links[link]
        return joint.transform(constants), joint

    def axes(self, link: int) -> list[tuple[int, Motion]]:
        """Return the dofs that move a link relative to its parent, with their axes in its axes."""
        top = self.driver.topology
        if not top.frames:
            return [(link, self.axis(link))]
        return dof_axes(top, link, self._links[link][0])

    def axis(self, link: int) -> Motion:
        """Return the axis S of a link in its own axes."""
        if self.driver.listed:
            return self._links[link][0].S
        if self.driver.topology.constant_axes:
            kind = self.driver.topology.dofs[link].kind
            return kind.axis(self.driver.prepared.link(link).params)
        return _row(self._axes, link)

    def weld(self, body: int) -> Transform:
        """Return the pose of a body in the link that carries it."""
        return self.driver.prepared.weld(body)

    def columns(self, bodies: np.ndarray) -> tuple[Transform, Motion, Transform]:
        """Return the pose and twist of the link that carries each body, and the pose of the body in
        this link. Each lane is an array over the given bodies, which must not be fixed."""
        links = np.array(self.driver.topology.body_links)[bodies]
        pose, twist = (_row(self._columns(x), links) for x in (POSE, TWIST))
        welds = self.driver.prepared.welds
        return pose, twist, jax.tree.map(lambda column: self.column(column, bodies), welds)

    def column(self, column: Any, rows: np.ndarray) -> Lane:
        """Return rows of a column, or a literal if the rows are constant and equal."""
        if not isinstance(column, np.ndarray):
            return column[rows]
        found = np.asarray(column[rows], np.float64)
        equal = bool((found == found[0]).all())
        return float(found[0]) if equal else jnp.asarray(found, self._q.dtype)

    def scattered(self, bodies: np.ndarray, forces: Force) -> Force:
        """Sum forces on the links that carry the given bodies. Each lane is an array over links."""
        links = np.array(self.driver.topology.body_links)[bodies]
        return over_links(self.driver, links, forces, self._q.dtype)

    @cached_property
    def joints(self) -> Any:
        """The joint motions, per link."""
        return self.driver.joints(self._q, self._v)

    @cached_property
    def _links(self) -> list:
        d = self.driver
        return list(zip(d.whole(self.joints), d.whole(d.constants), strict=True))

    def _columns(self, quantity: Quantity) -> Any:
        """Compute a quantity of all links, each lane an array. Pose and twist share one sweep."""
        if quantity not in self._found:
            d, like = self.driver, jnp.zeros(self.driver.topology.nv, self._q.dtype)
            some = (ACCELERATION,) if quantity is ACCELERATION else (POSE, TWIST)
            a = d.lanes(self._a) if quantity is ACCELERATION else None
            for one, values in zip(some, sweep(d, self.joints, *some, a=a), strict=True):
                self._found[one] = d.columns(values, like)
        return self._found[quantity]

    @cached_property
    def _axes(self) -> Any:
        d, like = self.driver, jnp.zeros(self.driver.topology.nv, self._q.dtype)
        return d.columns(d.axes(self.joints)[0], like)


def _row(columns: Any, i: Any) -> Any:
    return jax.tree.map(lambda x: x[i], columns)
