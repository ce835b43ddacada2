"""Gravity compensation: what keeps a robot at rest wherever it is.

    tau = g(q) - sum of J_b^T w_b - other forces at rest
w_b are wrenches that the surroundings are known to give, as at the feet of a standing robot. A
robot on a floating base has no actuators at its base: the wrenches must balance the forces there,
and `law.allocated(t, state).residual` is the rest.

(Siciliano et al., *Robotics*, 8.5.1; for floating bases Righetti et al. 2011.)
"""

from __future__ import annotations

from typing import Any

import jax

from rbjax.control.laws.controller import Controller, check_controlled_model, holding_forces
from rbjax.dynamics.algorithms.jacobians import generalized_forces
from rbjax.dynamics.arguments import check_array, check_takes
from rbjax.model import Model, State

WHERE = "gravity_compensation"


class GravityCompensation(Controller):
    """See `gravity_compensation`. Fields: wrenches (nb, 6), a function of (t, state), or None."""

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
    """The controller that balances gravity and the other forces at rest.

    tau = g(q) - sum of J_b^T w_b - other forces at v = 0.

    Args:
        model: the robot, a tree.
        wrenches: (nb, 6) [moment N m; force N] on bodies, world axes, at each body's frame origin,
            that the surroundings give; or a function (t, state) that returns them.
        undriven: "refuse" (raise) for a robot with coordinates that no actuator drives, or
            "least_squares":
            the actuated joints get their forces, `law.allocated(t, state)` has the residual.

    Returns:
        A law: `law(t, state)` are controls (nu,), `law.tau(t, state)` the forces (nv,).

    Raises:
        InputError: coordinates that nothing drives, by name; constraints; a wrong shape.

    Source: Siciliano et al., *Robotics*, 8.5.1.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("arm7")
        >>> law = rb.control.gravity_compensation(model)
        >>> law(0.0, model.default_state()).shape
        (7,)
    """
    check_controlled_model(WHERE, model, undriven)
    if callable(wrenches):
        check_takes(WHERE, "wrenches", wrenches, "t", "state")
    elif wrenches is not None:
        wrenches = check_array(WHERE, "wrenches", wrenches, (model.nb, 6))
    return GravityCompensation(model, undriven, wrenches)
