"""Drag on turning bodies: on a double pendulum by hand."""

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb

MODEL = rb.load("double_pendulum")
DRAG = np.array([0.3, 0.7])
BODIES = MODEL.body_names[-2:]


def torques(v, drag=DRAG):
    state = MODEL.default_state().replace(v=jnp.asarray(v))
    air = MODEL.with_forces(rb.forces.RotationalDrag(jnp.asarray(drag), BODIES))
    return rb.applied_forces(air, state) - rb.applied_forces(MODEL, state)


def test_each_joint_carries_the_drag_of_all_arms_after_it():
    found = jax.jit(torques)
    for v in ([1.5, -0.4], [-2.0, 3.0], [0.0, 0.0]):
        w = np.cumsum(v)  # in the world
        on_arm = -DRAG * np.abs(w) * w
        np.testing.assert_allclose(found(v), np.cumsum(on_arm[::-1])[::-1], atol=1e-11)


def test_it_has_a_derivative_at_rest():
    slope = jax.jit(jax.jacfwd(torques))(jnp.zeros(2))
    np.testing.assert_allclose(slope, 0.0, atol=1e-5)
