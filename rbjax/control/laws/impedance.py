"""Impedance control: a robot that answers pushes like a spring and a damper.

    of a frame    tau = h + J^T (K e + D (V_d - V)) + N^T tau_0
    of joints     tau = h + K e + D (v_d - v)
h balances gravity and what else acts at rest; "motion" adds the velocity terms of inverse dynamics
and of the forces. tau_0 is a joint impedance about a posture, in the frame's dynamically consistent
null space, N = 1 - M^-1 J^T Lambda J, so it does not move the frame. A wrench on the frame at rest
gives the displacement K^-1 F, whatever the robot's inertia, which stays as it is.

(Hogan 1985; Albu-Schäffer, Ott & Hirzinger 2007; Ott, *Cartesian Impedance Control of Redundant and
Flexible-Joint Robots*, 2008.)
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.control.laws.controller import (
    Controller,
    actuator_forces,
    check_controlled_model,
    gains,
    holding_forces,
)
from rbjax.control.laws.references import check_configurations, check_poses, configuration
from rbjax.control.laws.task import Task, inertia, motion, task_of
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.dynamics.arguments import check_array, shape_of
from rbjax.errors import InputError
from rbjax.lanes import matvec
from rbjax.model import Model, State

#: forces that are compensated in addition to the impedance
COMPENSATE = ("rest", "motion")


class JointImpedance(Controller):
    """See `joint_impedance`. Fields: reference; stiffness and damping (nv,)."""

    reference: Any
    stiffness: jax.Array
    damping: jax.Array
    compensate: str = eqx.field(static=True)

    def tau(self, t: Any, state: State) -> jax.Array:
        wanted = configuration(self.model, self.reference, t, state.q.dtype)
        e = difference(self.model, state.q, wanted.q)
        spring = self.stiffness * e + self.damping * (wanted.v - state.v)
        return _balance(self, state) + spring


class CartesianImpedance(Controller):
    """See `cartesian_impedance`. Fields: task; reference; stiffness and damping (m, m) of the
    frame; posture, posture_stiffness and posture_damping (nv,) of the rest."""

    task: Task
    reference: Any
    stiffness: jax.Array
    damping: jax.Array
    posture: Any
    posture_stiffness: jax.Array
    posture_damping: jax.Array
    compensate: str = eqx.field(static=True)

    def tau(self, t: Any, state: State) -> jax.Array:
        seen = motion(self.model, self.task, self.reference, t, state)
        slip = seen.wanted.V[self.task.rows] - seen.V
        wrench = matvec(self.stiffness, seen.e) + matvec(self.damping, slip)
        rest = -self.posture_damping * state.v
        if self.posture is not None:
            wanted = configuration(self.model, self.posture, t, state.q.dtype)
            rest = rest + self.posture_stiffness * difference(self.model, state.q, wanted.q)
        felt = inertia(self.model, state, seen.J)
        wrench = wrench - matvec(felt.task, matvec(felt.to_joints.T, rest))
        return _balance(self, state) + rest + matvec(seen.J.T, wrench)


def _balance(law: JointImpedance | CartesianImpedance, state: State) -> jax.Array:
    if law.compensate == "rest":
        return holding_forces(law.model, state)
    return actuator_forces(law.model, state, jnp.zeros_like(state.v))


def joint_impedance(
    model: Model,
    reference: Any,
    *,
    stiffness: Any,
    damping: Any,
    compensate: str = "rest",
    undriven: str = "refuse",
) -> JointImpedance:
    """The law that makes each joint a spring and a damper about a motion.

    tau = h + K (q_d - q) + D (v_d - v).

    Args:
        model: the robot, a tree.
        reference: (nq,) a configuration, or a function of t that returns one.
        stiffness: K, N m/rad or N/m, a number or (nv,).
        damping: D, N m s/rad or N s/m, a number or one a coordinate.
        compensate: "rest", gravity and the other forces at rest; "motion", the velocity terms too.
        undriven: "refuse" (raise) for a robot with coordinates that no actuator drives, or
            "least_squares".

    Returns:
        A law: `law(t, state)` are controls (nu,), `law.tau(t, state)` the forces (nv,).

    Raises:
        InputError: coordinates that nothing drives, by name; constraints; a wrong shape.

    Source: Hogan 1985.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("arm7")
        >>> law = rb.control.joint_impedance(model, jnp.zeros(7), stiffness=50.0, damping=5.0)
        >>> law.tau(0.0, model.default_state()).shape
        (7,)
    """
    where = "joint_impedance"
    check_controlled_model(where, model, undriven)
    _check_compensate(where, compensate)
    return JointImpedance(
        model, undriven, check_configurations(where, model, reference),
        gains(where, "stiffness", stiffness, model.nv), gains(where, "damping", damping, model.nv),
        compensate,
    )  # fmt: skip


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
    """The law that makes a frame a spring and a damper about a motion.

    tau = h + J^T (K e + D (V_d - V)) + N^T (K_0 (q_0 - q) - D_0 v).

    Args:
        model: the robot, a tree.
        reference: of a pose (R (3, 3), p (3,)), of a position (3,), of a rotation (3, 3); or a
            function of t that returns it.
        site, body: the name of the frame.
        task: "pose", "position" or "rotation": which motions of the frame count, m in number.
        stiffness: K, N m/rad and N/m, a number, (m,) or a matrix (m, m); angular first, world axes.
        damping: D, N m s/rad and N s/m, as the stiffness.
        posture: (nq,), or a function of t, that the rest of the motion tends to.
        posture_stiffness, posture_damping: K_0 and D_0, numbers or (nv,).
        compensate: "rest", gravity and the other forces at rest; "motion", the velocity terms too.
        undriven: "refuse" (raise) for a robot with coordinates that no actuator drives, or
            "least_squares".

    Returns:
        A law: `law(t, state)` are controls (nu,), `law.tau(t, state)` the forces (nv,).

    Raises:
        UnknownName: no such frame. InputError: coordinates that nothing drives, by name;
        constraints; a wrong shape; a frame that no joint moves.

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
    _check_compensate(where, compensate)
    what = task_of(where, model, site, body, task)
    reference = check_poses(where, reference, what.what)
    if posture is not None:
        posture = check_configurations(where, model, posture, "posture")
    return CartesianImpedance(
        model, undriven, what, reference, _matrix(where, "stiffness", stiffness, what.size),
        _matrix(where, "damping", damping, what.size), posture,
        gains(where, "posture_stiffness", posture_stiffness, model.nv),
        gains(where, "posture_damping", posture_damping, model.nv), compensate,
    )  # fmt: skip


def _matrix(where: str, name: str, value: Any, m: int) -> jax.Array:
    """(m, m) from a number, (m,) or a matrix."""
    if len(shape_of(where, name, value)) == 2:
        return check_array(where, name, value, (m, m))
    return jnp.diag(gains(where, name, value, m))


def _check_compensate(where: str, value: Any) -> None:
    if value not in COMPENSATE:
        raise InputError(
            f"{where}: compensate is {value!r}, expected one of {', '.join(COMPENSATE)}"
        )
