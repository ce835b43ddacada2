"""Operational-space control: a frame accelerates as asked, the rest follows a posture.

    V'_c = A_d + D (V_d - V) + K e                                  the desired acceleration
    a    = a_0 + M^-1 J^T Lambda (V'_c - J' v - J a_0)              the joints' accelerations
    tau  = M a + b(q, v) - other forces
a_0 is the acceleration towards a posture, a_0 = K_0 (q_0 - q) - D_0 v. Of all accelerations that
give V'_c, a is the nearest to a_0 in the metric of the inertia (Gauss' principle): Khatib's
dynamically consistent null space: tau = J^T F + N^T tau_0 with N = 1 - M^-1 J^T Lambda J. Lambda is
damped near singular configurations (`task.py`).

(Khatib 1987; Bruyninckx & Khatib 2000; Peters et al. 2008.)
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.control.laws.controller import Controller, actuator_forces, check_controlled_model, gains
from rbjax.control.laws.references import check_configurations, check_poses, configuration
from rbjax.control.laws.task import Inertia, Motion, Task, inertia, motion, task_of
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.lanes import matvec
from rbjax.model import Model, State

WHERE = "operational_space"


class OperationalSpace(Controller):
    """See `operational_space`. Fields: task; reference; stiffness and damping (m,) of the frame;
    posture, posture_stiffness and posture_damping (nv,) of the rest."""

    task: Task
    reference: Any
    stiffness: jax.Array
    damping: jax.Array
    posture: Any
    posture_stiffness: jax.Array
    posture_damping: jax.Array

    def tau(self, t: Any, state: State) -> jax.Array:
        return actuator_forces(self.model, state, self.acceleration(t, state))

    def acceleration(self, t: Any, state: State) -> jax.Array:
        """The desired accelerations (nv,)."""
        seen = motion(self.model, self.task, self.reference, t, state)
        felt = inertia(self.model, state, seen.J)
        asked = self._posture(t, state)
        left = self._command(seen) - seen.bias - matvec(seen.J, asked)
        return asked + _joints(felt, left)

    def command(self, t: Any, state: State) -> jax.Array:
        """V'_c (m,): the acceleration that the frame is to have."""
        return self._command(motion(self.model, self.task, self.reference, t, state))

    def _command(self, seen: Motion) -> jax.Array:
        rows = self.task.rows
        back = self.damping * (seen.wanted.V[rows] - seen.V) + self.stiffness * seen.e
        return seen.wanted.A[rows] + back

    def _posture(self, t: Any, state: State) -> jax.Array:
        out = -self.posture_damping * state.v
        if self.posture is None:
            return out
        wanted = configuration(self.model, self.posture, t, state.q.dtype)
        return out + self.posture_stiffness * difference(self.model, state.q, wanted.q)


def _joints(felt: Inertia, task: jax.Array) -> jax.Array:
    """M^-1 J^T Lambda x."""
    return matvec(felt.to_joints, matvec(felt.task, task))


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
    """The law by which a frame's motion obeys V' = A_d + D (V_d - V) + K e.

    tau = M (a_0 + M^-1 J^T Lambda (V'_c - J' v - J a_0)) + b - other forces.

    Args:
        model: the robot, a tree.
        reference: of a pose (R (3, 3), p (3,)), of a position (3,), of a rotation (3, 3); or a
            function of t that returns it, whose velocity and acceleration are its derivatives.
        site, body: the name of the frame.
        task: "pose", "position" or "rotation": which motions of the frame count.
        stiffness: K, 1/s^2, a number or one for each motion, angular first, world axes.
        damping: D, 1/s, as the stiffness; 2 sqrt(K) if None.
        posture: (nq,), or a function of t, that the rest of the motion tends to; None only damps.
        posture_stiffness, posture_damping: K_0 1/s^2 and D_0 1/s, numbers or (nv,); D_0 is
            2 sqrt(K_0) if None.
        undriven: "refuse" (raise) for a robot with coordinates that no actuator drives, or
            "least_squares".

    Returns:
        A law: `law(t, state)` are controls (nu,), `law.tau(t, state)` the forces (nv,),
        `law.command(t, state)` the frame's acceleration.

    Raises:
        UnknownName: no such frame. InputError: coordinates that nothing drives, by name;
        constraints; a wrong shape; a frame that no joint moves.

    Source: Khatib 1987.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("arm7")
        >>> law = rb.control.operational_space(
        ...     model, [0.4, 0.0, 0.5], site="tool", task="position", stiffness=100.0)
        >>> law.damping.tolist()
        [20.0, 20.0, 20.0]
    """
    check_controlled_model(WHERE, model, undriven)
    what = task_of(WHERE, model, site, body, task)
    reference = check_poses(WHERE, reference, what.what)
    K = gains(WHERE, "stiffness", stiffness, what.size)
    D = 2 * jnp.sqrt(K) if damping is None else gains(WHERE, "damping", damping, what.size)
    K0 = gains(WHERE, "posture_stiffness", posture_stiffness, model.nv)
    D0 = 2 * jnp.sqrt(K0)
    if posture_damping is not None:
        D0 = gains(WHERE, "posture_damping", posture_damping, model.nv)
    if posture is not None:
        posture = check_configurations(WHERE, model, posture, "posture")
    return OperationalSpace(model, undriven, what, reference, K, D, posture, K0, D0)
