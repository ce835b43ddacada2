"""Control laws of a frame: operational-space control and Cartesian impedance.

    e = [log(R_d R^T); p_d - p],   V = J v,   V' = J a + J' v          (world axes, angular first)
    operational space   a = a_0 + M^-1 J^T Lambda (V'_c - J' v - J a_0),   Lambda = (J M^-1 J^T)^-1
    impedance           tau = h + J^T (K e + D (V_d - V)) + N^T tau_0,   N = 1 - M^-1 J^T Lambda J

a_0 and tau_0 pull towards a posture in the dynamically consistent null space of the frame. Near a
singular configuration Lambda is damped: (A + d 1)^-1 for A = J M^-1 J^T, with d = d_max (1 - s /
s_0)^2 if s = 1 / tr((A + tiny)^-1) < s_0, else 0.
Source: Khatib 1987; Bruyninckx & Khatib 2000; Hogan 1985; Ott, *Cartesian Impedance Control of
Redundant and Flexible-Joint Robots*, 2008; Nakamura & Hanafusa 1986 and Chiaverini 1997 (damping).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import choice
from rbjax.control.laws.controller import (
    COMPENSATE,
    Controller,
    PoseReference,
    actuator_forces,
    balancing_forces,
    check_configurations,
    check_controlled_model,
    check_poses,
    configuration,
    gains,
    pose,
)
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.frames import frame_bias_acceleration, frame_pose, jacobian
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.dynamics.arguments import check_array, shape_of
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_frame
from rbjax.kinematics.goals import Goal, body_of
from rbjax.lanes import ldlt, matmat, matvec
from rbjax.model import Model, State
from rbjax.model.record import Record
from rbjax.rotations import so3

#: kinds of tasks: the controlled parts of the pose, and their rows in [angular; linear]
KINDS = {
    "pose": (("rotation", "position"), slice(0, 6)),
    "position": (("position",), slice(3, 6)),
    "rotation": (("rotation",), slice(0, 3)),
}
#: relative to the mean of diag(A): the threshold s_0 of damping, and the damping d_max
NEAR, DAMPED = 1e-3, 1e-2


class FrameTask(Record):
    """A frame and the controlled part of its pose. All fields are static.

    site, body: the name of the frame; one of the two is None.
    kind: "pose", "position" or "rotation".
    """

    site: str | None = eqx.field(static=True)
    body: str | None = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    @property
    def rows(self) -> slice:
        """The rows of the twist [angular; linear] that the task controls."""
        return KINDS[self.kind][1]

    @property
    def parts(self) -> tuple[str, ...]:
        """The controlled parts: "rotation", "position" or both."""
        return KINDS[self.kind][0]

    @property
    def size(self) -> int:
        """Number of rows."""
        return self.rows.stop - self.rows.start

    @property
    def frame(self) -> dict[str, Any]:
        """The frame's name, as keyword arguments of the frame algorithms."""
        return {"body": self.body, "site": self.site}


class TaskMotion(NamedTuple):
    """A task at a state.

    e: error, (m,).
    V: velocity, (m,).
    J: Jacobian, (m, nv).
    bias: J' v, (m,).
    desired: the reference.
    """

    e: jax.Array
    V: jax.Array
    J: jax.Array
    bias: jax.Array
    desired: PoseReference


def task_of(where: str, model: Model, site: Any, body: Any, kind: Any) -> FrameTask:
    """Build the task of a frame; raise InputError unless a joint moves the frame."""
    choice(f"task of {where}", kind, KINDS)
    check_frame(where, site, body)
    carrier = body_of(model, Goal(site=site, body=body, position=[0.0, 0.0, 0.0]))
    if carrier < 0 or model.topology.body_links[carrier] < 0:
        raise InputError(f"{where}: no joint moves {site or body!r}, expected one that moves")
    return FrameTask(site, body, kind)


def motion(model: Model, task: FrameTask, reference: Any, t: Any, state: State) -> TaskMotion:
    """Compute pose error, twist, Jacobian and bias acceleration of a task, and its reference."""
    q, v = state.q, state.v
    desired = pose(reference, t, task.parts, q.dtype)
    R, p = frame_pose(model, q, **task.frame)
    turn = (desired.R[:, None, :] * R[None, :, :]).sum(-1)
    e = jnp.concatenate([so3.log(turn), desired.p - p])[task.rows]
    J = jacobian(model, q, **task.frame)[task.rows]
    bias = frame_bias_acceleration(model, q, v, **task.frame)[task.rows]
    return TaskMotion(e, matvec(J, v), J, bias, desired)


class TaskInertia(NamedTuple):
    """The dynamics of a task: M^-1 J^T (nv, m), and the task inertia Lambda (m, m)."""

    to_joints: jax.Array
    task: jax.Array


def task_inertia(model: Model, state: State, J: jax.Array) -> TaskInertia:
    """Compute the inertia of a task with Jacobian J, damped near singular configurations."""
    M, m = mass_matrix(model, state.q), J.shape[0]
    factors = ldlt([list(row) for row in M])
    columns = [factors.solve(list(row)) for row in J]
    to_joints = jnp.stack([jnp.stack([jnp.asarray(x, M.dtype) for x in c]) for c in columns], 1)
    A = matmat(J, to_joints)
    one, mean = jnp.eye(m, dtype=A.dtype), jnp.trace(A) / m
    tiny = 8 * jnp.finfo(A.dtype).eps * mean
    s = 1 / jnp.trace(_inverse(A + tiny * one)) / mean
    d = DAMPED * mean * jnp.square(jnp.maximum(1 - s / NEAR, 0.0))
    return TaskInertia(to_joints, _inverse(A + d * one))


def _inverse(A: jax.Array) -> jax.Array:
    """Return the inverse of a symmetric positive definite matrix."""
    factors = ldlt([list(row) for row in A])
    columns = [factors.solve(list(row)) for row in jnp.eye(A.shape[0], dtype=A.dtype)]
    out = jnp.stack([jnp.stack([jnp.asarray(x, A.dtype) for x in c]) for c in columns])
    return (out + out.T) / 2


class FrameController(Controller):
    """A controller of a frame.

    task: the frame and the controlled part of its pose, of m rows.
    reference: the frame's reference, an array or a function of t.
    stiffness, damping: gains of the task, (m,) or (m, m).
    posture: reference of the null-space motion, (nq,) or a function of t; None only damps.
    posture_stiffness, posture_damping: gains of the null-space motion, (nv,).
    """

    task: FrameTask
    reference: Any
    stiffness: jax.Array
    damping: jax.Array
    posture: Any
    posture_stiffness: jax.Array
    posture_damping: jax.Array

    def _posture(self, t: Any, state: State) -> jax.Array:
        """Return the pull K_0 (q_0 - q) - D_0 v (nv,) towards the posture q_0 in the null space."""
        out = -self.posture_damping * state.v
        if self.posture is None:
            return out
        desired = configuration(self.model, self.posture, t, state.q.dtype)
        return out + self.posture_stiffness * difference(self.model, state.q, desired.q)


class OperationalSpace(FrameController):
    """The controller that `operational_space` builds."""

    def tau(self, t: Any, state: State) -> jax.Array:
        return actuator_forces(self.model, state, self.acceleration(t, state))

    def acceleration(self, t: Any, state: State) -> jax.Array:
        """Return the desired accelerations (nv,)."""
        frame = motion(self.model, self.task, self.reference, t, state)
        inertia = task_inertia(self.model, state, frame.J)
        rest = self._posture(t, state)
        left = self._command(frame) - frame.bias - matvec(frame.J, rest)
        return rest + matvec(inertia.to_joints, matvec(inertia.task, left))

    def command(self, t: Any, state: State) -> jax.Array:
        """Return the desired acceleration V'_c (m,) of the frame, with feedback."""
        return self._command(motion(self.model, self.task, self.reference, t, state))

    def _command(self, frame: TaskMotion) -> jax.Array:
        rows = self.task.rows
        back = self.damping * (frame.desired.V[rows] - frame.V) + self.stiffness * frame.e
        return frame.desired.A[rows] + back


class CartesianImpedance(FrameController):
    """The controller that `cartesian_impedance` builds."""

    compensate: str = eqx.field(static=True)

    def tau(self, t: Any, state: State) -> jax.Array:
        frame = motion(self.model, self.task, self.reference, t, state)
        slip = frame.desired.V[self.task.rows] - frame.V
        wrench = matvec(self.stiffness, frame.e) + matvec(self.damping, slip)
        rest = self._posture(t, state)
        inertia = task_inertia(self.model, state, frame.J)
        wrench = wrench - matvec(inertia.task, matvec(inertia.to_joints.T, rest))
        h = balancing_forces(self.model, state, self.compensate)
        return h + rest + matvec(frame.J.T, wrench)


def operational_space(
    model: Model,
    reference: Any,
    *,
    site: str | None = None,
    body: str | None = None,
    task: str = "pose",
    stiffness: Any,
    damping: Any = None,
    posture: Any = None,
    posture_stiffness: Any = 10.0,
    posture_damping: Any = None,
    undriven: str = "refuse",
) -> OperationalSpace:
    """Build the controller under which a frame obeys V' = A_d + D (V_d - V) + K e.

        tau = M (a_0 + M^-1 J^T Lambda (V'_c - J' v - J a_0)) + b - other forces.

    Args:
        model: the robot, a tree.
        reference: a pose (R (3, 3), p (3,)), a position (3,) or a rotation (3, 3), as the task
            needs; or a function of t that returns it, whose derivatives are the desired velocity
            and acceleration.
        site, body: the name of the frame; give exactly one of the two.
        task: "pose", "position" or "rotation", the controlled part of the frame's pose.
        stiffness: K, 1/s^2, a number or (m,) for m rows, angular first, world axes.
        damping: D, 1/s, a number or (m,); 2 sqrt(K) if None.
        posture: (nq,) or a function of t, reference of the null-space motion; None only damps it.
        posture_stiffness, posture_damping: K_0 1/s^2 and D_0 1/s (2 sqrt(K_0) if None), or (nv,).
        undriven: "refuse" to raise for dofs without an actuator; "least_squares" to allow them.

    Returns:
        A controller: `law(t, state)` returns controls (nu,), `law.tau(t, state)` forces (nv,),
            `law.command(t, state)` the desired acceleration of the frame.

    Raises:
        UnknownName: no such frame.
        InputError: undriven dofs, constraints, a wrong shape, a frame that no joint moves.

    Source: Khatib 1987.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("arm7")
        >>> law = rb.control.operational_space(
        ...     model, [0.4, 0.0, 0.5], site="tool", task="position", stiffness=100.0)
        >>> law.damping.tolist()
        [20.0, 20.0, 20.0]
    """
    where = "operational_space"
    check_controlled_model(where, model, undriven)
    frame = task_of(where, model, site, body, task)
    reference = check_poses(where, reference, frame.parts)
    K = gains(where, "stiffness", stiffness, frame.size)
    D = 2 * jnp.sqrt(K) if damping is None else gains(where, "damping", damping, frame.size)
    K0 = gains(where, "posture_stiffness", posture_stiffness, model.nv)
    D0 = 2 * jnp.sqrt(K0)
    if posture_damping is not None:
        D0 = gains(where, "posture_damping", posture_damping, model.nv)
    if posture is not None:
        posture = check_configurations(where, model, posture, "posture")
    return OperationalSpace(model, undriven, frame, reference, K, D, posture, K0, D0)


def cartesian_impedance(
    model: Model,
    reference: Any,
    *,
    site: str | None = None,
    body: str | None = None,
    task: str = "pose",
    stiffness: Any,
    damping: Any,
    posture: Any = None,
    posture_stiffness: Any = 0.0,
    posture_damping: Any = 0.0,
    compensate: str = "rest",
    undriven: str = "refuse",
) -> CartesianImpedance:
    """Build the controller that makes a frame a spring and damper about a reference motion.

        tau = h + J^T (K e + D (V_d - V)) + N^T (K_0 (q_0 - q) - D_0 v).

    Args:
        model: the robot, a tree.
        reference: a pose (R (3, 3), p (3,)), a position (3,) or a rotation (3, 3), as the task
            needs; or a function of t that returns it.
        site, body: the name of the frame; give exactly one of the two.
        task: "pose", "position" or "rotation", the controlled part of the frame's pose, of m rows.
        stiffness: K, N m/rad and N/m, a number, (m,) or a matrix (m, m); angular first, world axes.
        damping: D, N m s/rad and N s/m, in the same form as the stiffness.
        posture: (nq,) or a function of t, reference of the null-space motion; None only damps it.
        posture_stiffness, posture_damping: K_0 and D_0, numbers or (nv,).
        compensate: "rest" for gravity and other forces at rest; "motion" to add velocity terms.
        undriven: "refuse" to raise for dofs without an actuator; "least_squares" to allow them.

    Returns:
        A controller: `law(t, state)` returns controls (nu,), `law.tau(t, state)` forces (nv,).

    Raises:
        UnknownName: no such frame.
        InputError: undriven dofs, constraints, a wrong shape, a frame that no joint moves.

    Source: Hogan 1985; Ott 2008.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("arm7")
        >>> law = rb.control.cartesian_impedance(
        ...     model, [0.4, 0.0, 0.5], site="tool", task="position", stiffness=500.0, damping=50.0)
        >>> law.stiffness.shape
        (3, 3)
    """
    where = "cartesian_impedance"
    check_controlled_model(where, model, undriven)
    choice(f"compensate of {where}", compensate, COMPENSATE)
    frame = task_of(where, model, site, body, task)
    reference = check_poses(where, reference, frame.parts)
    if posture is not None:
        posture = check_configurations(where, model, posture, "posture")
    return CartesianImpedance(
        model, undriven, frame, reference, _matrix(where, "stiffness", stiffness, frame.size),
        _matrix(where, "damping", damping, frame.size), posture,
        gains(where, "posture_stiffness", posture_stiffness, model.nv),
        gains(where, "posture_damping", posture_damping, model.nv), compensate,
    )  # fmt: skip


def _matrix(where: str, name: str, value: Any, m: int) -> jax.Array:
    """Return a matrix (m, m) from a number, a diagonal (m,) or a matrix."""
    if len(shape_of(where, name, value)) == 2:
        return check_array(where, name, value, (m, m))
    return jnp.diag(gains(where, name, value, m))
