"""Parts of inverse kinematics: weights of goals, random starts, lists of goals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rbjax as rb
from rbjax.kinematics.goals import Goal, GoalErrors, unrolled_driver
from rbjax.kinematics.joint_ranges import random_configurations

BALL_AND_SLIDE = """<mujoco><compiler angle="radian"/>
  <default><geom contype="0" conaffinity="0" size="0.1" mass="1"/></default>
  <worldbody><body><joint type="ball" range="0 0.8"/><geom/>
    <body><joint type="slide" range="-0.2 0.3"/><geom/></body>
  </body></worldbody></mujoco>"""
ARM = rb.load("double_pendulum")
TIP = Goal(body="lower", position=[0.1, 0.0, -1.5])


def test_weights_of_rotations_and_of_positions():
    both = Goal(body="lower", position=[0.1, 0.0, -1.5], rotation=np.eye(3), weight=3.0)
    driver, q = unrolled_driver(ARM, jnp.float64), jnp.array([0.3, 0.4])
    miss = GoalErrors(ARM, driver, [both], q, (2.0, 5.0))
    assert [float(x) for x in miss.weights] == [6.0] * 3 + [15.0] * 3
    assert miss.turning == [True] * 3 + [False] * 3


def test_random_configurations_stay_in_their_ranges():
    model = rb.load(BALL_AND_SLIDE, limits=True)
    near = jnp.asarray(model.default_state().q)
    found = jax.jit(lambda key: random_configurations(model, key, 50, near))(jax.random.key(0))
    assert found.shape == (50, model.nq)
    np.testing.assert_allclose(np.linalg.norm(found[:, :4], axis=1), 1.0, rtol=1e-12)
    high = float(model.joints.range[0, 1])
    angles = Rotation.from_quat(found[:, :4], scalar_first=True).magnitude()
    assert (angles <= high * (1 + 1e-9)).all() and np.ptp(angles) > 0.3 * high
    slides = found[:, 4]
    assert slides.min() >= -0.2 and slides.max() <= 0.3 and np.ptp(slides) > 0.3


def test_one_goal_or_a_list_of_them():
    for goals in (TIP, [TIP], (TIP, TIP)):
        with pytest.raises(rb.InputError, match="q has shape"):  # the goals are right
            rb.control.differential_inverse_kinematics(ARM, np.zeros(3), goals, rate=1.0)
    with pytest.raises(rb.InputError, match="expected Goals"):
        rb.control.differential_inverse_kinematics(ARM, np.zeros(2), [TIP, 3.0], rate=1.0)


def test_a_first_start_beyond_the_ranges_is_brought_back():
    ranges = jnp.array([[-0.5, 0.5], [-0.5, 0.5]])
    model = ARM.replace(joints=ARM.joints.replace(range=ranges))
    beyond = jnp.array([0.9, 0.2])
    tip = rb.frame_pose(model, beyond, "lower")[1]
    found = rb.control.inverse_kinematics(model, tip, body="lower", start=beyond, seeds=1)
    assert not found.success and (jnp.abs(found.q) <= 0.5).all()


def test_a_start_that_is_stuck_or_has_had_its_iterations_is_followed_by_the_next():
    near = rb.frame_pose(ARM, jnp.array([1.3, -0.9]), "lower")[1]
    short = rb.control.inverse_kinematics(ARM, near, body="lower", seeds=2, iterations=2)
    assert short.start == 2  # no start reaches it in two iterations, the last search does
    assert short.iterations > 2 * 2
    far = [0.0, 0.0, 9.0]
    stuck = rb.control.inverse_kinematics(ARM, far, body="lower", seeds=3, iterations=1000)
    assert not stuck.success and stuck.iterations < 300
