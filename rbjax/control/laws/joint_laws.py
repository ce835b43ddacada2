"""Control laws of joints: computed torque, gravity compensation, impedance.

    computed torque        tau = M(q) a + b(q, v) - other forces,   e'' + D e' + K e = 0
    gravity compensation   tau = g(q) - sum of J_b^T w_b - other forces at rest
    impedance              tau = h + K e + D (v_d - v)

e = q_d - q on the manifold. For hinges and slides  a = a_d + D (v_d - v) + K e. For an attitude
e = phi with q_d = q exp(phi), in body axes, with E = exp(phi),

    phi' = J_l^-1(phi) (E w_d - w)
    w'   = E w_d' - w x E w_d - J_l(phi) phi'' - (dJ_l/dt) phi' ,     phi'' = -D phi' - K phi

Source: Luh, Walker & Paul 1980; Siciliano et al., *Robotics*, 8.5; Bullo & Murray 1999
(attitudes); Righetti et al. 2011 (floating bases); Hogan 1985 (impedance).
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import choice
from rbjax.control.laws.controller import (
    COMPENSATE,
    Controller,
    Followed,
    actuator_forces,
    balancing_forces,
    check_configurations,
    check_controlled_model,
    configuration,
    gains,
    holding_forces,
)
from rbjax.dynamics.algorithms.frames import generalized_forces
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.dynamics.arguments import check_array, check_takes
from rbjax.lanes import matvec
from rbjax.model import Model, State, joint_slices
from rbjax.rotations import so3


class JointController(Controller):
    """A controller of joints, with a reference and gains stiffness and damping (nv,)."""

    reference: Any
    stiffness: jax.Array
    damping: jax.Array


class ComputedTorque(JointController):
    """The controller that `computed_torque` builds. Stiffness is in 1/s^2, damping in 1/s."""

    def tau(self, t: Any, state: State) -> jax.Array:
        return actuator_forces(self.model, state, self.acceleration(t, state))

    def acceleration(self, t: Any, state: State) -> jax.Array:
        """Return the desired accelerations (nv,)."""
        desired = configuration(self.model, self.reference, t, state.q.dtype)
        return tracking_acceleration(self.model, state, desired, self.stiffness, self.damping)


def computed_torque(
    model: Model, reference: Any, *, stiffness: Any, damping: Any = None, undriven: str = "refuse"
) -> ComputedTorque:
    """Build the controller under which the tracking error obeys e'' + D e' + K e = 0.

        tau = M a + b - other forces, a = a_d + D (v_d - v) + K e for hinges and slides.

    Args:
        model: the robot, a tree. Forces of other elements are compensated too.
        reference: (nq,) a configuration; or a function of t that returns one, whose derivatives are
            the desired velocity and acceleration; or a function of t that returns (q, v, a).
        stiffness: K, 1/s^2, a number or (nv,).
        damping: D, 1/s, a number or (nv,); 2 sqrt(K), critical, if None.
        undriven: "refuse" to raise for dofs without an actuator; "least_squares" to allow them.

    Returns:
        A controller: `law(t, state)` returns controls (nu,), `law.tau(t, state)` forces (nv,) for
            `rollout(tau=...)`, `law.acceleration(t, state)` the desired accelerations (nv,).

    Raises:
        InputError: undriven dofs (with their names), constraints, a wrong shape.

    Source: Luh, Walker & Paul 1980; Siciliano et al., *Robotics*, 8.5.2.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("arm7")
        >>> law = rb.control.computed_torque(model, jnp.zeros(7), stiffness=25.0)
        >>> law.damping.tolist()
        [10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0]
    """
    where = "computed_torque"
    check_controlled_model(where, model, undriven)
    reference = check_configurations(where, model, reference)
    K = gains(where, "stiffness", stiffness, model.nv)
    D = 2 * jnp.sqrt(K) if damping is None else gains(where, "damping", damping, model.nv)
    return ComputedTorque(model, undriven, reference, K, D)


def tracking_acceleration(
    model: Model, state: State, desired: Followed, K: jax.Array, D: jax.Array
) -> jax.Array:
    """Return the acceleration a (nv,) under which the tracking error obeys e'' + D e' + K e = 0."""
    q, v = state.q, state.v
    e = difference(model, q, desired.q)
    a = desired.a + D * (desired.v - v) + K * e
    for span in joint_slices(model.topology):
        if span.attitude:
            at = span.attitude[1]
            turning = _turning(e[at], v[at], desired.v[at], desired.a[at], K[at], D[at])
            a = a.at[at].set(turning)
    return a


def _turning(
    phi: jax.Array, w: jax.Array, w_d: jax.Array, a_d: jax.Array, K: jax.Array, D: jax.Array
) -> jax.Array:
    """Return w' in body axes, under which the error obeys phi'' + D phi' + K phi = 0."""
    E = so3.exp(phi)
    there = matvec(E, w_d)
    rate = matvec(so3.inverse_left_jacobian(phi), there - w)
    J, J_rate = jax.jvp(so3.left_jacobian, (phi,), (rate,))
    desired = -D * rate - K * phi
    return matvec(E, a_d) - jnp.cross(w, there) - matvec(J, desired) - matvec(J_rate, rate)


class GravityCompensation(Controller):
    """The controller that `gravity_compensation` builds, with external wrenches or None."""

    wrenches: Any

    def tau(self, t: Any, state: State) -> jax.Array:
        tau = holding_forces(self.model, state)
        if self.wrenches is None:
            return tau
        w = self.wrenches(t, state) if callable(self.wrenches) else self.wrenches
        return tau - generalized_forces(self.model, state.q, w.astype(tau.dtype))


def gravity_compensation(
    model: Model, *, wrenches: Any = None, undriven: str = "refuse"
) -> GravityCompensation:
    """Build the controller that balances gravity and the other forces at rest.

        tau = g(q) - sum of J_b^T w_b - other forces at v = 0.

    Args:
        model: the robot, a tree.
        wrenches: (nb, 6) external [moment N m; force N] on bodies, world axes, at each body's frame
            origin; or a function (t, state) that returns them.
        undriven: "refuse" to raise if no actuator drives some dof; "least_squares" for the nearest
            forces, with the residual in `law.allocated(t, state)`.

    Returns:
        A controller: `law(t, state)` returns controls (nu,), `law.tau(t, state)` forces (nv,).

    Raises:
        InputError: undriven dofs (with their names), constraints, a wrong shape.

    Source: Siciliano et al., *Robotics*, 8.5.1.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("arm7")
        >>> law = rb.control.gravity_compensation(model)
        >>> law(0.0, model.default_state()).shape
        (7,)
    """
    check_controlled_model("gravity_compensation", model, undriven)
    if callable(wrenches):
        check_takes("gravity_compensation", "wrenches", wrenches, "t", "state")
    elif wrenches is not None:
        wrenches = check_array("gravity_compensation", "wrenches", wrenches, (model.nb, 6))
    return GravityCompensation(model, undriven, wrenches)


class JointImpedance(JointController):
    """The controller that `joint_impedance` builds."""

    compensate: str = eqx.field(static=True)

    def tau(self, t: Any, state: State) -> jax.Array:
        desired = configuration(self.model, self.reference, t, state.q.dtype)
        e = difference(self.model, state.q, desired.q)
        spring = self.stiffness * e + self.damping * (desired.v - state.v)
        return balancing_forces(self.model, state, self.compensate) + spring


def joint_impedance(
    model: Model,
    reference: Any,
    *,
    stiffness: Any,
    damping: Any,
    compensate: str = "rest",
    undriven: str = "refuse",
) -> JointImpedance:
    """Build the controller that makes each joint a spring and damper about a reference motion.

        tau = h + K (q_d - q) + D (v_d - v).

    Args:
        model: the robot, a tree.
        reference: (nq,) a configuration, or a function of t that returns one.
        stiffness: K, N m/rad or N/m, a number or (nv,).
        damping: D, N m s/rad or N s/m, a number or (nv,).
        compensate: "rest" for gravity and other forces at rest; "motion" to add velocity terms.
        undriven: "refuse" to raise for dofs without an actuator; "least_squares" to allow them.

    Returns:
        A controller: `law(t, state)` returns controls (nu,), `law.tau(t, state)` forces (nv,).

    Raises:
        InputError: undriven dofs (with their names), constraints, a wrong shape.

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
    choice(f"compensate of {where}", compensate, COMPENSATE)
    return JointImpedance(
        model, undriven, check_configurations(where, model, reference),
        gains(where, "stiffness", stiffness, model.nv), gains(where, "damping", damping, model.nv),
        compensate,
    )  # fmt: skip
