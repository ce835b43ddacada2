"""Tasks of a frame: error, velocity, Jacobian, and the operational-space inertia.

    e = [log(R_d R^T); p_d - p],   V = J v,   V' = J a + J' v          (world axes, angular first)
    Lambda = (J M^-1 J^T)^-1                                             the task's inertia
Near a singular configuration J M^-1 J^T cannot be inverted: Lambda is then damped,
    (A + d 1)^-1,   d = d_max (1 - s / s_0)^2  where  s = 1 / tr((A + tiny)^-1) < s_0,  else 0
s is below the smallest eigenvalue of A = J M^-1 J^T, smooth, and not below a sixth of it. Away from
singularities d is zero and the task is exact. s_0 and d_max are shares of tr(A) / rows.

(Khatib, *A unified approach for motion and force control*, 1987; Nakamura & Hanafusa 1986 and
Chiaverini 1997 for the damping.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.control.laws.references import Pose, pose
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.frames import frame_bias_acceleration, frame_pose
from rbjax.dynamics.algorithms.jacobians import jacobian
from rbjax.dynamics.arguments import check_static
from rbjax.errors import InputError
from rbjax.kinematics.goals import Goal, body_of
from rbjax.lanes import ldlt, matmat, matvec
from rbjax.model import Model, State
from rbjax.model.record import Record
from rbjax.rotations import so3

#: kinds of tasks: the controlled motions, and their rows in [angular; linear]
KINDS = {
    "pose": (("rotation", "position"), slice(0, 6)),
    "position": (("position",), slice(3, 6)),
    "rotation": (("rotation",), slice(0, 3)),
}
#: the least s, as a share of tr(A) / rows, that is not damped, and the damping at s = 0
NEAR, DAMPED = 1e-3, 1e-2


class Task(Record):
    """A frame and which of its six motions count. Static throughout."""

    site: str | None = eqx.field(static=True)
    body: str | None = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    @property
    def rows(self) -> slice:
        """Among [angular; linear]."""
        return KINDS[self.kind][1]

    @property
    def what(self) -> tuple[str, ...]:
        """Which of rotation and position count."""
        return KINDS[self.kind][0]

    @property
    def size(self) -> int:
        """How many motions count."""
        return self.rows.stop - self.rows.start

    @property
    def frame(self) -> dict[str, str | None]:
        """The frame's name, as the algorithms take it."""
        return {"body": self.body, "site": self.site}


class Motion(NamedTuple):
    """A task at a state: error e, velocity V, J (m, nv), J' v (m,), and the reference."""

    e: jax.Array
    V: jax.Array
    J: jax.Array
    bias: jax.Array
    wanted: Pose


def task_of(where: str, model: Model, site: Any, body: Any, kind: Any) -> Task:
    """The task of a frame that a joint moves."""
    if kind not in KINDS:
        raise InputError(f"{where}: task is {kind!r}, expected one of {', '.join(KINDS)}")
    if (site is None) == (body is None):
        got = "neither" if site is None else "both"
        raise InputError(f"{where}: got {got} of site and body, expected exactly one")
    check_static(where, "site", site)
    check_static(where, "body", body)
    carrier = body_of(model, Goal(site=site, body=body, position=[0.0, 0.0, 0.0]))
    if carrier < 0 or model.topology.body_links[carrier] < 0:
        raise InputError(f"{where}: no joint moves {site or body!r}, expected one that moves")
    return Task(site, body, kind)


def motion(model: Model, task: Task, reference: Any, t: Any, state: State) -> Motion:
    """A task and its reference at a state."""
    q, v = state.q, state.v
    wanted = pose(reference, t, task.what, q.dtype)
    R, p = frame_pose(model, q, **task.frame)
    turn = (wanted.R[:, None, :] * R[None, :, :]).sum(-1)
    e = jnp.concatenate([so3.log(turn), wanted.p - p])[task.rows]
    J = jacobian(model, q, **task.frame)[task.rows]
    bias = frame_bias_acceleration(model, q, v, **task.frame)[task.rows]
    return Motion(e, matvec(J, v), J, bias, wanted)


class Inertia(NamedTuple):
    """M^-1 J^T (nv, m) and Lambda (m, m)."""

    to_joints: jax.Array
    task: jax.Array


def inertia(model: Model, state: State, J: jax.Array) -> Inertia:
    """The inertia of a task with the Jacobian J, damped near singular configurations."""
    M, m = mass_matrix(model, state.q), J.shape[0]
    factors = ldlt([list(row) for row in M])
    columns = [factors.solve(list(row)) for row in J]
    to_joints = jnp.stack([jnp.stack([jnp.asarray(x, M.dtype) for x in c]) for c in columns], 1)
    A = matmat(J, to_joints)
    one, mean = jnp.eye(m, dtype=A.dtype), jnp.trace(A) / m
    tiny = 8 * jnp.finfo(A.dtype).eps * mean
    s = 1 / jnp.trace(_inverse(A + tiny * one)) / mean
    d = DAMPED * mean * jnp.square(jnp.maximum(1 - s / NEAR, 0.0))
    return Inertia(to_joints, _inverse(A + d * one))


def _inverse(A: jax.Array) -> jax.Array:
    """Of a symmetric positive definite matrix."""
    factors = ldlt([list(row) for row in A])
    columns = [factors.solve(list(row)) for row in jnp.eye(A.shape[0], dtype=A.dtype)]
    out = jnp.stack([jnp.stack([jnp.asarray(x, A.dtype) for x in c]) for c in columns])
    return (out + out.T) / 2
