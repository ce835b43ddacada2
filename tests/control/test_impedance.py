"""Impedance: a robot that is pushed gives way by K^-1 F."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
import rbjax.control as control
from tests.control.arms import ARM
from tests.robots import load_quietly

START = jnp.array([0.2, -0.6, 1.2, 0.4])


@pytest.fixture(scope="module")
def arm():
    return load_quietly(ARM)


def settled(model, law, push, steps=4000):
    """The configuration after a constant force on the hand, at its frame's origin, for 8 s."""
    wrenches = jnp.zeros((steps, model.nb, 6)).at[:, -1, 3:].set(push)
    start = rb.State(START, jnp.zeros(4))
    run = rb.rollout(model, start, law, 2e-3, wrenches=wrenches, save_every=steps)
    assert np.abs(run.v[-1]).max() < 1e-7
    return run.q[-1]


def test_frame_gives_way_by_its_stiffness(arm):
    """Through the actuators; the spring of the shoulder and gravity are balanced, and the posture
    does not stiffen the frame."""
    p0 = rb.forward_kinematics(arm, START).p[-1]
    K = np.array([[300.0, 50.0, 0.0], [50.0, 200.0, 30.0], [0.0, 30.0, 400.0]])
    law = control.cartesian_impedance(
        arm, p0, body="hand", task="position", stiffness=K, damping=[60.0, 60.0, 60.0],
        posture=START, posture_stiffness=2.0, posture_damping=1.0,
    )  # fmt: skip
    push = np.array([3.0, -4.0, 5.0])
    p = rb.forward_kinematics(arm, settled(arm, law, push)).p[-1]
    np.testing.assert_allclose(p - p0, np.linalg.solve(K, push), atol=1e-7)


def test_joints_give_way_by_their_stiffness(arm):
    """K (q_d - q) + J^T F = 0 in the end."""
    K = np.array([20.0, 30.0, 25.0, 10.0])
    law = control.joint_impedance(arm, START, stiffness=K, damping=4.0)
    push = np.array([2.0, 3.0, -4.0])
    q = settled(arm, law, push)
    J = rb.jacobian(arm, q, "hand")[3:]
    np.testing.assert_allclose(K * (q - START), J.T @ push, atol=1e-6)


def test_motion_is_compensated(arm):
    """With the velocity terms: M a = K e + D e' exactly."""
    state = arm.random_state(jax.random.key(2))
    law = control.joint_impedance(arm, START, stiffness=20.0, damping=3.0, compensate="motion")
    tau = rb.applied_forces(arm, state, law(0.0, state))
    a = rb.forward_dynamics(arm, state.q, state.v, tau)
    want = 20.0 * (START - state.q) - 3.0 * state.v
    np.testing.assert_allclose(rb.mass_matrix(arm, state.q) @ a, want, rtol=1e-9, atol=1e-9)
