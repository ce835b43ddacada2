"""The trot of a reference: its feet stand at the commanded velocity and swing forward."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.envs.suite.go1 import FEET, HEIGHT, HIPS, HOME, LEG
from rbjax.envs.terms import guide_until, trot_distance
from rbjax.envs.terms.trot import trot_angles
from rbjax.forces.context import Context

MODEL = rb.envs.tasks()["go1_joystick_flat"]().model
BASE = jnp.array([0.0, 0.0, HEIGHT, 1.0, 0.0, 0.0, 0.0])


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None))
def feet(t, command):
    """The places of the feet (4, 3) in the axes of the trunk."""
    angles = trot_angles(t, jnp.asarray(command), HOME, HIPS, LEG, 0.3, 2.0)
    state = rb.State(jnp.concatenate([BASE, angles]), jnp.zeros(MODEL.nv))
    robot = Context.of(MODEL, 0.0, state, jnp.zeros(MODEL.nu), 0.02)
    return jnp.stack([robot.site(foot).position.array for foot in FEET])


def test_a_foot_that_stands_moves_back_at_the_commanded_velocity():
    """Over the middle half of the stance, within a fifth: the sine is steeper in its middle."""
    command = np.array([0.4, 0.1, 0.3])
    ts = jnp.linspace(0.25 + 0.0625, 0.5 - 0.0625, 9)  # of the first diagonal pair, at 2 Hz
    for pair, shift in ((slice(0, 4, 3), 0.0), (slice(1, 3), 0.25)):
        path = np.asarray(feet(ts + shift, command))[:, pair, :2]
        mean = (path[-1] - path[0]) / float(ts[-1] - ts[0])
        x, y = np.asarray(HIPS).T[:, pair]
        want = -np.stack([command[0] - command[2] * y, command[1] + command[2] * x], -1)
        np.testing.assert_allclose(mean, 1.3 * want, rtol=0.2, atol=0.03)


def test_feet_are_lifted_in_diagonal_pairs():
    up = np.asarray(feet(jnp.full(9, 0.125), np.zeros(3)))[0, :, 2]
    assert up[0] > up[1] + 0.04 and up[3] > up[2] + 0.04 and abs(up[1] - up[2]) < 0.01


def test_the_distance_is_that_of_the_joints():
    command, time, off = jnp.array([0.5, 0.0, 0.2]), 0.3, 0.01 * jnp.arange(12)
    angles = trot_angles(time, command, HOME, HIPS, LEG, 0.3, 2.0)
    transition = SimpleNamespace(
        after=SimpleNamespace(q=jnp.concatenate([BASE, angles + off])), step=15, dt=0.02,
        variables={"command": command},
    )  # fmt: skip
    found = trot_distance(HOME, HIPS, LEG)(transition)
    np.testing.assert_allclose(found, -(off**2).sum(), rtol=1e-12)


def test_the_guide_falls_to_zero():
    env = rb.envs.make("go1_joystick_flat", guided=True)
    curriculum = guide_until("trot", 2.0, 0.5)
    found = [float(curriculum(env.default_params, p).weights["trot"]) for p in (0.0, 0.25, 0.5, 1)]
    assert found == [2.0, 1.0, 0.0, 0.0] and float(env.default_params.weights["trot"]) == 0.0
