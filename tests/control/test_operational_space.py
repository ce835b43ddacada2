"""Operational-space control: the frame accelerates exactly as asked."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
import rbjax.control as control
from rbjax.errors import InputError
from tests.control.arms import ARM
from tests.robots import load_quietly


def circle(t):
    return jnp.array([0.5 + 0.1 * jnp.cos(2 * t), 0.1 * jnp.sin(2 * t), 0.3])


@pytest.fixture(scope="module")
def arm():
    return load_quietly(ARM)


def test_frame_accelerates_as_asked(arm):
    """J a + J' v of the forward dynamics of the controls is the command; and of all such motions
    the nearest to the posture's: M (a - a_0) is in the range of J^T."""
    posture = jnp.array([0.2, 0.1, 0.5, 0.3])
    law = control.operational_space(
        arm, circle, site="tip", task="position", stiffness=[100.0, 80.0, 60.0],
        posture=posture, posture_stiffness=5.0,
    )  # fmt: skip

    @jax.jit
    def moved(t, q, v):
        state = rb.State(q, v)
        a = rb.forward_dynamics(arm, q, v, rb.applied_forces(arm, state, law(t, state)))
        J = rb.jacobian(arm, q, site="tip")[3:]
        got = J @ a + rb.frame_bias_acceleration(arm, q, v, site="tip")[3:]
        _, p = rb.frame_pose(arm, q, site="tip")
        p_rate = jax.jvp(circle, (t,), (1.0,))[1]
        p_rate2 = jax.jvp(lambda t: jax.jvp(circle, (t,), (1.0,))[1], (t,), (1.0,))[1]
        K = jnp.array([100.0, 80.0, 60.0])
        want = p_rate2 + 2 * jnp.sqrt(K) * (p_rate - J @ v) + K * (circle(t) - p)
        a0 = 5.0 * (posture - q) - 2 * jnp.sqrt(5.0) * v
        return got, want, J, rb.mass_matrix(arm, q) @ (a - a0)

    for k in range(3):
        state = arm.random_state(jax.random.key(k))
        got, want, J, rest = map(np.asarray, moved(0.3 * k, state.q, state.v))
        assert np.abs(got - want).max() <= 1e-10 * np.abs(want).max()
        null = np.linalg.svd(J)[2][3]
        assert abs(null @ rest) <= 1e-9 * np.abs(rest).max()


@pytest.mark.slow
def test_pose_of_a_seven_joint_arm():
    """All six motions, by the forces themselves."""
    model = load_quietly("arm7")

    def reference(t):
        return rb.rotations.so3.exp(jnp.array([0.2, t, 0.1])), circle(t)

    law = control.operational_space(model, reference, site="tool", stiffness=50.0)

    @jax.jit
    def moved(t, q, v):
        state = rb.State(q, v)
        passive = rb.applied_forces(model, state, None)
        a = rb.forward_dynamics(model, q, v, law.tau(t, state) + passive)
        J = rb.jacobian(model, q, site="tool")
        got = J @ a + rb.frame_bias_acceleration(model, q, v, site="tool")
        return got, law.command(t, state)

    state = rb.State(jnp.array([0.3, 0.4, -0.5, 1.0, 0.6, 1.0, 0.2]), 0.3 * jnp.arange(7.0))
    got, want = moved(0.5, state.q, state.v)
    assert np.abs(got - want).max() <= 1e-10 * np.abs(want).max()


def test_singular_configuration(arm):
    """The straight arm cannot move along itself: forces stay bounded, also close by, and are
    continuous."""
    law = control.operational_space(arm, [2.0, 0.0, 0.4], site="tip", task="position",
                                    stiffness=100.0)  # fmt: skip
    f = jax.jit(lambda q: law.tau(0.0, rb.State(q, jnp.zeros(4))))
    taus = np.array([f(jnp.array([0.0, 0.0, bend, -0.5 * bend])) for bend in (0.0, 1e-6, 1e-4)])
    assert np.isfinite(taus).all() and np.abs(taus).max() < 2e4
    assert np.abs(taus[1] - taus[0]).max() < 1e-2 * np.abs(taus[0]).max()


def test_a_frame_that_no_joint_moves_is_rejected():
    with pytest.raises(InputError, match="no joint moves"):
        control.operational_space(load_quietly("arm7"), jnp.zeros(3), body="base",
                                  task="position", stiffness=1.0)  # fmt: skip
