"""Computed torque: inverse dynamics and a linear law for the error.

    tau = M(q) a + b(q, v) - other forces ,      a such that  e'' + D e' + K e = 0
e = q_d - q on the manifold. Of hinges and slides  a = a_d + D (v_d - v) + K e. Of an attitude
e = phi with q_d = q exp(phi), and in body axes, with E = exp(phi),
    phi' = J_l^-1(phi) (E w_d - w)
    w'   = E w_d' - w x E w_d - J_l(phi) phi'' - (dJ_l/dt) phi' ,     phi'' = -D phi' - K phi
so the error obeys the linear equation exactly there too, as long as its angle stays below pi.

(Luh, Walker & Paul 1980; Siciliano et al., *Robotics*, 8.5.2; Bullo & Murray 1999 for attitudes.)
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.control.laws.controller import Controller, actuator_forces, check_controlled_model, gains
from rbjax.control.laws.references import Followed, check_configurations, configuration
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.lanes import matvec
from rbjax.model import Model, State, spans
from rbjax.rotations import so3

WHERE = "computed_torque"


class ComputedTorque(Controller):
    """See `computed_torque`. Fields: reference; stiffness and damping (nv,), 1/s^2 and 1/s."""

    reference: Any
    stiffness: jax.Array
    damping: jax.Array

    def tau(self, t: Any, state: State) -> jax.Array:
        return actuator_forces(self.model, state, self.acceleration(t, state))

    def acceleration(self, t: Any, state: State) -> jax.Array:
        """The desired accelerations (nv,)."""
        wanted = configuration(self.model, self.reference, t, state.q.dtype)
        return tracking_acceleration(self.model, state, wanted, self.stiffness, self.damping)


def computed_torque(
    model: Model,
    reference: Any,
    *,
    stiffness: Any,
    damping: Any = None,
    undriven: str = "refuse",
) -> ComputedTorque:
    """The law that makes the error of a motion obey e'' + D e' + K e = 0.

    tau = M a + b - other forces, a = a_d + D (v_d - v) + K e for coordinates that add.

    Args:
        model: the robot, a tree. Forces of other elements are compensated too.
        reference: (nq,) a configuration; or a function of t that returns one, whose velocity and
            acceleration are its derivatives; or one that returns (q, v, a).
        stiffness: K, 1/s^2, a number or (nv,).
        damping: D, 1/s, a number or one a coordinate; 2 sqrt(K), critical, if None.
        undriven: "refuse" (raise) for a robot with coordinates that no actuator drives, or
            "least_squares".

    Returns:
        A law: `law(t, state)` are controls (nu,), `law.tau(t, state)` the forces (nv,) for
        `rollout(tau=...)`, `law.acceleration(t, state)` the accelerations (nv,).

    Raises:
        InputError: coordinates that nothing drives, by name; constraints; a wrong shape.

    Source: Luh, Walker & Paul 1980; Siciliano et al., *Robotics*, 8.5.2.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("arm7")
        >>> law = rb.control.computed_torque(model, jnp.zeros(7), stiffness=25.0)
        >>> law.damping.tolist()
        [10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0]
    """
    check_controlled_model(WHERE, model, undriven)
    reference = check_configurations(WHERE, model, reference)
    K = gains(WHERE, "stiffness", stiffness, model.nv)
    D = 2 * jnp.sqrt(K) if damping is None else gains(WHERE, "damping", damping, model.nv)
    return ComputedTorque(model, undriven, reference, K, D)


def tracking_acceleration(
    model: Model, state: State, wanted: Followed, K: jax.Array, D: jax.Array
) -> jax.Array:
    """a (nv,) with which the error obeys its equation."""
    q, v = state.q, state.v
    e = difference(model, q, wanted.q)
    a = wanted.a + D * (wanted.v - v) + K * e
    for span in spans(model.topology):
        if span.attitude:
            at = span.attitude[1]
            turning = _turning(e[at], v[at], wanted.v[at], wanted.a[at], K[at], D[at])
            a = a.at[at].set(turning)
    return a


def _turning(
    phi: jax.Array, w: jax.Array, w_d: jax.Array, a_d: jax.Array, K: jax.Array, D: jax.Array
) -> jax.Array:
    """w' of a body whose error phi shall obey phi'' + D phi' + K phi = 0; body axes."""
    E = so3.exp(phi)
    there = matvec(E, w_d)
    rate = matvec(so3.inverse_left_jacobian(phi), there - w)
    J, J_rate = jax.jvp(so3.left_jacobian, (phi,), (rate,))
    wanted = -D * rate - K * phi
    return matvec(E, a_d) - jnp.cross(w, there) - matvec(J, wanted) - matvec(J_rate, rate)
