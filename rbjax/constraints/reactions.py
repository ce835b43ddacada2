"""Accelerations and multipliers of constrained motion, and the wrenches in loop joints.

M a + b = tau + sum of J_i^T f_i + G^T l
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.constraints.equations.constrained_motion import constrained_motion
from rbjax.constraints.equations.model_rows import wrenches_by_link
from rbjax.constraints.methods.soft import compliant_motion
from rbjax.constraints.rows.pairs import Pair
from rbjax.constraints.rows.soft import Soft, is_soft
from rbjax.display import displayed
from rbjax.dynamics.algorithms.rnea import wrenches_to_links
from rbjax.dynamics.drivers.choice import driver
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.errors import InputError
from rbjax.forces.acting import applied
from rbjax.forces.context import Context, FrameState
from rbjax.forces.element import Loads
from rbjax.forces.inputs import Inputs
from rbjax.lanes.arrays import pack
from rbjax.model import WORLD, Model, State
from rbjax.spatial import Force, Transform


@displayed
class ConstrainedMotion(NamedTuple):
    """Accelerations and multipliers of constrained motion.

    Fields:
        acceleration: (nv,), m/s^2 and rad/s^2.
        multipliers: (m,), N and N m.
    """

    acceleration: jax.Array
    multipliers: jax.Array


@algorithm("q", "v", "tau", "wrenches", "t", long=True)
def constrained_dynamics(
    model: Model,
    q: ArrayLike,
    v: ArrayLike,
    tau: ArrayLike,
    wrenches: ArrayLike | None = None,
    t: Any = 0.0,
) -> ConstrainedMotion:
    """Compute the accelerations and multipliers of a robot with constraints:

        M a + b = tau + sum_b J_b^T w_b + G^T l,      G a = -(G' v + ...)

    For rows of `Soft` constraints, l are the forces of MuJoCo's model (`Compliant`). Use
    `rbjax.forward_dynamics` to ignore the constraints.

    Args:
        model: the robot. Its constraints may be redundant.
        q: (nq,) configuration.
        v: (nv,) velocity.
        tau: (nv,) all applied generalized forces. `applied_forces` computes the model's.
        wrenches: (nb, 6) external [moment N m; force N] on bodies, in world axes, at their origins.
        t: time in seconds, for rows that depend on time.

    Returns:
        `ConstrainedMotion(acceleration (nv,), multipliers (m,))`. The function `multipliers`
        describes the units of the multipliers.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite, zero quaternions.

    Source: Masarati, *Multibody System Dynamics*, 8.3; Carpentier, Budhiraja & Mansard 2021.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rail = rb.constraints.Inplane.between(model, None, "lower", point=[0.0, 0, -2.0])
        >>> model = model.with_constraints(rail)
        >>> state = model.default_state()
        >>> found = rb.constraints.constrained_dynamics(model, state.q, state.v, 0 * state.v)
        >>> found.multipliers.shape
        (1,)
    """
    if not model.nv:
        return ConstrainedMotion(jnp.zeros(0, q.dtype), jnp.zeros(0, q.dtype))
    f_ext: Any = None
    if wrenches is not None:
        d = driver(model, q.dtype)
        f_ext = wrenches_to_links(d, d.joints(q, None), wrenches)
    return ConstrainedMotion(*_motion(model, t, State(q, v), tau, f_ext))


@algorithm("state", "ctrl", "t")
def multipliers(
    model: Model, state: State, ctrl: ArrayLike | None = None, t: Any = 0.0
) -> jax.Array:
    """Compute the constraint forces l (m,) of M a + b = tau + G^T l, G a = -(G' v + ...).

    No contact acts; `rb.contact.solve` gives the forces of a model with contacts.
    For rows of `Soft` constraints, l are the forces of MuJoCo's model. If rows are redundant, l has
    the least norm with each multiplier weighted by the square root of its entry of
    diag(G M^-1 G^T). Multipliers are in N for rows in m, and in N m for angles and cosines.

    Args:
        model: the robot, with constraints.
        state: `State(q (nq,), v (nv,))`, with x (nx,) if force elements have states.
        ctrl: (nu,) controls; None for no actuation.
        t: time in seconds.

    Returns:
        (m,), N, or N m for rows of angles and cosines.

    Source: Masarati, *Multibody System Dynamics*, 8.3.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rod = rb.constraints.Distance.between(model, None, "lower", point=[0.3, 0.0, 0.0],
        ...     other=[0.0, 0.0, 0.4])
        >>> rb.constraints.multipliers(model.with_constraints(rod), model.default_state()).shape
        (1,)
    """
    return _multipliers(model, state, ctrl, t)


def _multipliers(model: Model, state: State, ctrl: Any, t: Any) -> jax.Array:
    tau, f_ext, _ = applied(model, t, state, Inputs(ctrl))
    return _motion(model, t, state, tau, f_ext)[1]


def _motion(model: Model, t: Any, state: State, tau: Any, f_ext: Any) -> tuple:
    """Compute a and l by the default formulation of a rollout, without projection."""
    solve = compliant_motion if is_soft(model) else constrained_motion
    return solve(model, t, state, tau, f_ext)


@algorithm("state", "ctrl", "t")
def joint_wrenches(
    model: Model, state: State, ctrl: ArrayLike | None = None, t: Any = 0.0
) -> jax.Array:
    """Compute the wrench that each loop joint (`Pair`) exerts on its body b, or on the world.

    Args:
        model: the robot, with constraints between two frames only.
        state: `State(q (nq,), v (nv,))`, with x (nx,) if force elements have states.
        ctrl: (nu,) controls; None for no actuation.
        t: time, s.

    Returns:
        (joints, 6) [torque N m; force N] in world axes, at the origin of the joint's frame on b.

    Raises:
        InputError: the model has another constraint than a `Pair`, such as `Distance` or
            `Revolute`.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> pin = rb.constraints.Revolute.between(model, None, "lower", point=[0.0, 0.0, 1.0])
        >>> rb.constraints.joint_wrenches(model.with_constraints(pin), model.default_state()).shape
        (1, 6)
    """
    l = _multipliers(model, state, ctrl, t)
    context = Context.of(model, t, state, None)
    out, at = [], 0
    for constraint in model.constraints:
        joint = constraint.of if isinstance(constraint, Soft) else constraint
        if not isinstance(joint, Pair):
            raise InputError(
                f"joint_wrenches: the model has a {type(joint).__name__}, expected joints "
                "between two frames only; `multipliers` takes any constraint"
            )
        _, (B, wrench) = _wrenches_of_pair(context, joint, l[at : at + joint.size])
        out.append(pack([*(B.rotation @ wrench.ang), *(B.rotation @ wrench.lin)], state.v))
        at += joint.size
    return jnp.stack(out) if out else jnp.zeros((0, 6), state.q.dtype)


def body_reactions(
    context: Context, tau: Any, f_ext: Any, l: jax.Array | None = None
) -> dict[int, Force]:
    """Return the sums of the constraint forces on bodies, in world axes at the body's origin.

    tau, f_ext: all applied forces. l: the multipliers, if they are known. A force that a constraint
    exerts on a link, and not on the ends of a `Pair`, is given to the body that carries the link's
    joint.
    """
    model, top = context.model, context.model.topology
    if l is None:
        l = _motion(model, context.t, context.state, tau, f_ext)[1]
    out: dict[int, Force] = {}
    at = 0

    def put(body: int, frame: FrameState, wrench: Force) -> None:
        if body == WORLD:
            return
        force, torque = frame.rotation @ wrench.lin, frame.rotation @ wrench.ang
        arm = frame.position - context.body(body).position
        moved = Force(torque + arm.cross(force), force)
        out[body] = out[body] + moved if body in out else moved

    for constraint in model.constraints:
        joint = constraint.of if isinstance(constraint, Soft) else constraint
        if isinstance(joint, Pair):
            ends = _wrenches_of_pair(context, joint, l[at : at + joint.size])
            for place, (frame, wrench) in zip((joint.a, joint.b), ends, strict=True):
                put(_body_of(model, place), frame, wrench)
        else:
            for k, row in enumerate(constraint.rows(context)):
                for link, wrench in wrenches_by_link(row.gradient).items():
                    carrier = top.carriers[top.body_links.index(link)]
                    put(carrier, context.link(link), wrench * l[at + k])
        at += constraint.size
    return out


def _body_of(model: Model, place: Any) -> int:
    if place.site is not None:
        return model.topology.site_bodies[model.site(place.site)]
    return WORLD if place.body in (None, WORLD) else model.body(place.body)


def _wrenches_of_pair(
    context: Context, joint: Pair, l: jax.Array
) -> list[tuple[FrameState, Force]]:
    """Return the frames a and b of a pair, and the wrench on each at its origin and in its axes."""
    places = ((joint.a, START), (joint.b, END))
    ends = [_End(context, place.frame(context), index) for place, index in places]
    wrenches = [Force.zero(), Force.zero()]
    for k, row in enumerate(joint.between_frames(ends[0], ends[1], context)):
        found = wrenches_by_link(row.gradient)
        for i, end in enumerate((START, END)):
            wrenches[i] = wrenches[i] + found.get(end, Force.zero()) * l[k]
    return list(zip(ends, wrenches, strict=True))


START, END = -3, -2  # indices that recording frames use instead of a link; WORLD is -1


class _End(FrameState):
    """A frame that records the wrenches on it, in its own axes and at its origin.

    Wrenches are recorded by frame and not by link, because both frames of a constraint may be on
    one link, and a frame may be on the world.
    """

    def __init__(self, context: Context, frame: FrameState, index: int, *moved: Transform):
        super().__init__(context.links, frame.link, *frame._placed, *moved)
        self._now, self._frame, self._index, self._moved = context, frame, index, moved

    def then(self, placed: Transform) -> FrameState:
        return _End(self._now, self._frame, self._index, *self._moved, placed)

    def push_own(self, wrench: Force) -> Loads:
        for X in reversed(self._moved):
            wrench = X.T(wrench)
        return Loads({}, {self._index: wrench})
