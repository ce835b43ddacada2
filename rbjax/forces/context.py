"""`Context`, the state of motion as an argument of force elements, constraints and sensors.

Vectors are `Vec3` of lanes: they add, subtract, scale, have `dot`, `cross` and `norm`, and accept
(3,) arrays as operands. Poses and velocities are computed once, on first use. `on_each` sums one
force over many bodies, by unrolled code or by a loop whose program contains the force once.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.display import displayed
from rbjax.dynamics.algorithms.kinematics import LinkMotion
from rbjax.dynamics.algorithms.rnea import LinkForces, generalized_of_links
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.errors import InputError
from rbjax.forces.element import Loads
from rbjax.forces.joint_state import JointState
from rbjax.joints.joint import Block
from rbjax.lanes import Lane, Mat3, Vec3, add, as_arrays, is_literal
from rbjax.model import WORLD, Frame, Model, State, without_constants
from rbjax.model.leaves import frame_transform, site_transform, table
from rbjax.model.links import lane
from rbjax.spatial import Force, Motion, Transform


@displayed
@dataclass(frozen=True)
class Context:
    """The state of motion at an instant, as the argument of a force element, constraint or sensor.

    Fields:
        model, links: the robot, and the motion of its links.
        t: time in s.
        q, v: configuration (nq,), velocity (nv,).
        ctrl: controls (nu,), or None.
        x: state (size,) of the element.
        dt: time step in s; None if no step is fixed.
        a: accelerations (nv,), used by the accelerations of frames; None for zero.
    """

    model: Model
    t: Any
    q: jax.Array
    v: jax.Array
    ctrl: Any
    x: Any
    links: LinkMotion
    dt: Any = None
    a: Any = None
    #: generalized forces of the actuators by dof, clipped to the joints' force ranges; only for
    #: elements with `after_actuators`
    driven: Mapping[int, Lane] = field(default_factory=dict, repr=False, compare=False)
    #: factors, by tendon, of the forces of its actuators, which keep their sum within its range
    scales: Mapping[int, Lane] = field(default_factory=dict, repr=False, compare=False)
    #: accelerations and forces that sensors read (`rbjax.sensors.Solution`), or None
    solution: Any = field(default=None, repr=False, compare=False)
    found: dict[int, tuple] = field(default_factory=dict, repr=False, compare=False)

    @property
    def state(self) -> State:
        """The state with q, v and x."""
        return State(self.q, self.v, self.x)

    @property
    def h(self) -> Any:
        """The time step in s: dt, or the model's timestep if dt is None."""
        return self.model.timestep if self.dt is None else self.dt

    @classmethod
    def of(
        cls, model: Model, t: Any, state: State, ctrl: Any, dt: Any = None,
        d: Driver | None = None,
    ) -> Context:  # fmt: skip
        """Make the context of a state with the x of all elements, on a driver (None: default)."""
        links = LinkMotion(driver(model, state.q.dtype) if d is None else d, state.q, state.v)
        own = without_constants(model)  # a user's element may change the leaves of the model
        return cls(own, t, state.q, state.v, ctrl, state.x, links, dt)

    def accelerating(self, a: jax.Array) -> Context:
        """Return a copy with the accelerations a (nv,)."""
        return replace(self, a=a, links=self.links.accelerating(a))

    def with_own(self, x: Any) -> Context:
        """Return a copy with the state x of one element."""
        return replace(self, x=x)

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return the result of `make`, computed once per key (an object) and context. Use it for
        values that depend only on t, q, v and ctrl, and that both `loads` and `rate` need."""
        if id(key) not in self.found:
            self.found[id(key)] = key, make()
        return self.found[id(key)][1]

    def link(self, link: int) -> FrameState:
        """Return the frame of a link."""
        return FrameState(self.links, link)

    def body(self, body: str | int) -> FrameState:
        """Return the frame of a body."""
        if isinstance(body, int) and body == WORLD:
            return FrameState(self.links, WORLD)
        b = self.model.body(body)
        return FrameState(self.links, self.model.topology.body_links[b], self.links.weld(b))

    def site(self, site: str | int) -> FrameState:
        """Return the frame of a site."""
        s = self.model.site(site)
        placed = site_transform(self.model, s, self.q.dtype)
        return self.body(self.model.topology.site_bodies[s]).then(placed)

    def frame(self, at: Frame) -> FrameState:
        """Return the frame of an `rb.Frame`."""
        body, placed = frame_transform(self.model, at, self.q.dtype)
        return self.body(body).then(placed)

    def joint(self, joint: str | int) -> JointState:
        """Return a joint with its coordinates q and v."""
        top = self.model.topology
        j = self.model.joint(joint)
        nq, nv = top.joints[j].nq, top.joints[j].nv
        qs, vs = top.joint_q[j], top.joint_v[j]
        q, v = [self.q[qs + k] for k in range(nq)], [self.v[vs + k] for k in range(nv)]
        return JointState(top.joint_kinds[j], q, v, vs)

    def dofs(self, joints: Iterable[str | int]) -> list[tuple[int, Lane]]:
        """List the index and the velocity of each dof of joints."""
        return [(i, v) for j in map(self.joint, joints) for i, v in enumerate(j.v, j.start)]

    def generalized(self, tau: Any) -> Loads:
        """Make loads from generalized forces (nv,)."""
        nv = self.model.nv
        if np.shape(tau) != (nv,):
            raise InputError(f"generalized: tau has shape {np.shape(tau)}, expected ({nv},)")
        return Loads({i: tau[i] for i in range(nv)})

    def generalized_of(self, wrenches: LinkForces) -> jax.Array:
        """Compute the generalized forces (nv,) of forces on links, the sum of J_i^T f_i."""
        d = self.links.driver
        return d.pack(generalized_of_links(d, self.links.joints, wrenches), self.v)


class FrameState:
    """A frame of a body or site, fixed to a link, at an instant."""

    def __init__(self, links: LinkMotion, link: int, *placed: Transform):
        self._links, self.link, self._placed = links, link, placed

    def then(self, placed: Transform) -> FrameState:
        """Return the frame with the pose `placed` in this frame."""
        return FrameState(self._links, self.link, *self._placed, placed)

    def at(self, point: Any) -> FrameState:
        """Return the parallel frame with its origin at a point (3,) in this frame."""
        return self.then(Transform(Mat3.identity(), _vector("at", point)))

    @cached_property
    def pose(self) -> Transform:
        """The pose in the world."""
        return functools.reduce(Transform.then, self._placed, self._links.pose(self.link))

    @property
    def on_link(self) -> Transform:
        """The pose in the link that carries the frame."""
        still = Transform(Mat3.identity(), Vec3.zero())
        return functools.reduce(Transform.then, self._placed, still)

    @property
    def position(self) -> Vec3:
        """The origin of the frame in the world, m."""
        return self.pose.p

    @property
    def rotation(self) -> Mat3:
        """The rotation matrix from frame axes to world axes."""
        return self.pose.R

    @cached_property
    def twist(self) -> Motion:
        """The angular and linear velocity at the frame's origin, in frame axes."""
        return functools.reduce(lambda V, X: X(V), self._placed, self._links.twist(self.link))

    @cached_property
    def velocity(self) -> Vec3:
        """The velocity of the frame's origin in world axes, m/s."""
        return self.rotation @ self.twist.lin

    @cached_property
    def angular_velocity(self) -> Vec3:
        """The angular velocity in world axes, rad/s."""
        return self.rotation @ self.twist.ang

    @cached_property
    def own_acceleration(self) -> Motion:
        """The angular and classical linear acceleration at the frame's origin, in frame axes."""
        V, a = self._links.twist(self.link), self._links.acceleration(self.link)
        for X in self._placed:
            centripetal = X.E @ V.ang.cross(V.ang.cross(X.p))
            V, a = X(V), X(a) + Motion(Vec3.zero(), centripetal)
        return a

    @cached_property
    def acceleration(self) -> Vec3:
        """The acceleration of the frame's origin in world axes, m/s^2, without gravity. In a force
        element it contains only the velocity terms (v' = 0)."""
        return self.rotation @ self.own_acceleration.lin

    @cached_property
    def angular_acceleration(self) -> Vec3:
        """The angular acceleration in world axes, rad/s^2. In a force
        element it contains only the velocity terms (v' = 0)."""
        return self.rotation @ self.own_acceleration.ang

    def push(self, force: Any, torque: Any = None, *, at: Any = None) -> Loads:
        """Make loads of a force (3,) N and a torque (3,) N m in world axes.

        at: point (3,) in the world at which the force acts; None for the frame's origin.
        A frame of the world gives no loads.
        """
        force = _vector("push", force)
        moment = Vec3.zero() if torque is None else _vector("push", torque)
        if at is not None:
            moment = moment + (_vector("push", at) - self.position).cross(force)
        E = self.rotation.T
        return self.push_own(Force(E @ moment, E @ force))

    def push_own(self, wrench: Force) -> Loads:
        """Make loads of a wrench [torque; force] in frame axes, at the frame's origin."""
        return Loads() if self.link == WORLD else Loads({}, {self.link: self._on_link(wrench)})

    def _on_link(self, wrench: Force) -> Force:
        return functools.reduce(lambda f, X: X.T(f), reversed(self._placed), wrench)

    def arms(self, wrench: Force) -> dict[int, Lane]:
        """Compute J^T w of a wrench in frame axes at the frame's origin, by dof."""
        if not self._links.driver.listed:
            return self.world_arms(self.rotation @ wrench.lin, self.rotation @ wrench.ang)
        wrench, out, at, top = self._on_link(wrench), {}, self.link, self._links.driver.topology
        block: Block = ()
        while at != WORLD:
            X, joint = self._links.to_parent(at)
            out[at], block = joint.project(wrench, block)
            wrench, at = X.T(wrench), top.parents[at]
        return {i: arm for i, arm in out.items() if i < top.nv}

    def world_arms(self, force: Vec3, torque: Vec3) -> dict[int, Lane]:
        """Compute J^T w of a force and a torque in world axes at the frame's origin, by dof."""
        d = self._links.driver
        if d.listed:
            E = self.rotation.T
            return self.arms(Force(E @ torque, E @ force))
        out: dict[int, Lane] = {}
        for i in () if self.link == WORLD else d.topology.ancestors[self.link]:
            pose, S = self._links.pose(i), self._links.axis(i)
            moment = torque + (self.position - pose.p).cross(force)
            out[i] = add((pose.R @ S.ang).dot(moment), (pose.R @ S.lin).dot(force))
        return out


def _vector(where: str, x: Any) -> Vec3:
    if isinstance(x, Vec3):
        shapes = [np.shape(a) for a in x]
        if any(shapes):
            raise InputError(
                f"{where}: a Vec3 has entries of the shapes {shapes}, expected scalars; a product "
                "of two vectors is a.dot(b) or a.cross(b)"
            )
        return x
    if np.shape(x) != (3,):
        raise InputError(f"{where}: a vector has shape {np.shape(x)}, expected (3,) or a Vec3")
    return Vec3(*(x[i] for i in range(3)))


def on_each(
    context: Context, bodies: Sequence[int], act: Callable[..., Loads], *numbers: Any
) -> Loads:
    """Sum act(frame, *numbers) over bodies.

    Args:
        context: context.
        bodies: body indices, which may repeat. Bodies fixed to the world are skipped.
        act: function of a body's frame and its parameters that returns `Loads`, a sum of results
            of `push`. It computes with lanes and does not branch on their values. If it pushes only
            its body and reads only the body's pose and velocity, the bodies can be evaluated in a
            loop. Otherwise the code is unrolled.
        numbers: parameters of all bodies: arrays (n,), passed to `act` as a lane; arrays (n, 3),
            passed as a `Vec3`; or pytrees of these arrays.

    Returns:
        The sum of the `Loads`.

    Example:
        >>> import rbjax as rb, jax
        >>> class Breeze(rb.forces.Element):
        ...     drag: jax.Array  # (nb,) N s/m
        ...     def loads(self, context):
        ...         slow = lambda body, drag: body.push(body.velocity * -drag)
        ...         return rb.forces.on_each(context, range(context.model.nb), slow, self.drag)
        >>> model = rb.load("double_pendulum")
        >>> model = model.with_forces(Breeze(jax.numpy.ones(2)))
        >>> rb.applied_forces(model, model.default_state()).tolist()
        [0.0, 0.0]
    """
    moving = [i for i, b in enumerate(bodies) if context.model.topology.body_links[b] != WORLD]
    columns = jax.tree.map(lambda x: _lanes(table(x, context.q.dtype)), numbers)

    def written_out() -> Loads:
        each = frames_of(context, bodies, *numbers)
        return sum((act(frame, *own) for frame, own in each), Loads())

    if isinstance(context.links.driver, Unrolled) or not moving:
        return written_out()
    rows, index = np.array(moving), np.array(bodies)[moving]
    own = _known(context.links.column, columns, rows)
    leaves, tree = jax.tree.flatten((*context.links.columns(index), own))

    def one(lanes: list) -> Force:
        left = iter(lanes)
        given = [x if is_literal(x) else next(left) for x in leaves]
        pose, twist, weld, own = jax.tree.unflatten(tree, given)
        links: Any = _Still(pose, twist)
        found: Any = act(FrameState(links, _OWN, weld), *own)
        if found.tau or isinstance(found.wrenches, Force) or found.wrenches.keys() - {_OWN}:
            raise _NotItsOwn
        force = found.wrenches.get(_OWN, Force.zero())
        return as_arrays(force, jnp.zeros((), context.q.dtype))

    try:
        forces = jax.lax.map(one, [x for x in leaves if not is_literal(x)])
    except _NotItsOwn:
        return written_out()
    return Loads({}, context.links.scattered(index, forces))


def frames_of(context: Context, bodies: Sequence[int], *numbers: Any) -> Iterator[tuple]:
    """Yield, for each body that can move, its frame and its rows of the parameters `numbers`."""
    columns = jax.tree.map(lambda x: _lanes(table(x, context.q.dtype)), numbers)
    for i, b in enumerate(bodies):
        if context.model.topology.body_links[b] != WORLD:
            yield context.body(b), _known(lane, columns, i)


#: placeholder index of the body's link in a loop over bodies
_OWN = -2


class _NotItsOwn(Exception):
    """Raised for a force that the loop over bodies cannot evaluate: it acts on something other than
    its body, or it reads more than the body's pose and twist."""


class _Still:
    """A substitute for `LinkMotion` that has the pose and the twist of one link only.
    `on_each` uses it in its loop over the bodies."""

    def __getattr__(self, name: str) -> Any:
        raise _NotItsOwn

    def __init__(self, pose: Transform, twist: Motion):
        self._pose, self._twist = pose, twist

    def pose(self, link: int) -> Transform:
        return self._pose

    def twist(self, link: int) -> Motion:
        return self._twist


def _lanes(x: Any) -> Any:
    return Vec3(*(x[:, k] for k in range(3))) if np.ndim(x) == 2 else x


def _known(lane: Callable, columns: Any, i: Any) -> Any:
    return jax.tree.map(lambda x: x if is_literal(x) else lane(x, i), columns)
