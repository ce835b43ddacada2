"""Control of a flexible arm: a motor moves a hinge, and the beam comes to rest."""

import functools

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from tests.flexible.beams import on_a_hinge


@functools.cache
def arm() -> rb.Model:
    """A rigid link and a beam with 0.1 kg at its tip, hanging at rest."""
    return on_a_hinge({"k_y": 1}, E=5e8, damping=1e-3)


def test_a_regulator_brings_a_flexible_arm_to_rest() -> None:
    """From 0.5 rad with a bent beam: the regulator damps hinge and beam by the motor alone."""
    model = arm()
    rest, zero = model.default_state(), jnp.zeros(1)
    weights = jnp.array([10.0, 1.0, 1.0, 1.0, 0.1, 0.1])
    found = rb.control.lqr_at(model, rest, zero, weights, jnp.array([0.1]))
    assert bool(found.success)
    start = rest.replace(q=jnp.array([0.5, 0.3, 0.0]))
    policy = rb.control.feedback(model, rest, zero, found.K)
    path = rb.rollout(model, start, policy, 2e-3, steps=2000, integrator="implicitfast")
    free = rb.rollout(
        model, start, jnp.zeros((2000, 1)), 2e-3, integrator="implicitfast", save_every=2000
    )
    end = np.abs(np.concatenate([path.q[-1], path.v[-1]])).max()
    assert end < 1e-3
    assert np.abs(np.concatenate([free.q[-1], free.v[-1]])).max() > 100 * end


def test_an_optimal_motion_from_rest_to_rest() -> None:
    """The hinge turns by 0.5 rad in 0.8 s, and the beam is at rest at the end."""
    model = arm()
    goal = model.default_state()
    start = goal.replace(q=jnp.array([0.5, 0.0, 0.0]))
    problem = rb.control.Problem(
        model, 40, 0.02, running=[rb.control.Cost(rb.control.Control(), 1e-3)],
        terminal=[rb.control.Cost(rb.control.StateError(goal), 100.0)], integrator="rk4",
    )  # fmt: skip
    found = rb.control.solve(problem, start)
    assert bool(found.success)
    assert np.abs(np.asarray(found.states.q[-1])).max() < 0.02
