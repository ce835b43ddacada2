"""Muscles against MuJoCo's own functions of them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rbjax.forces.actuators.activation import Muscle, Recruitment
from tests.tolerances import F64_ROUNDING

SHAPE = np.array([0.75, 1.05, -1.0, 200.0, 0.5, 1.6, 1.5, 1.3, 1.2])
RANGE, ACCELERATION = np.array([-0.4, 0.9]), np.array(7.0)


@pytest.mark.parametrize("force", [-1.0, 30.0])
def test_curves(force):
    parameters = SHAPE.copy()
    parameters[2] = force
    arrays = (jnp.asarray(x) for x in (parameters, RANGE, ACCELERATION))
    muscle = Muscle(*arrays, scaled=force < 0)
    lengths, speeds = np.linspace(-3, 6, 91), np.linspace(-9, 9, 91)
    # the knots of the curves too
    optimal = (RANGE[1] - RANGE[0]) / 0.3
    knots = RANGE[0] + (np.array([0.5, 0.75, 1.0, 1.3, 1.6]) - 0.75) * optimal
    lengths = np.append(lengths, knots)
    speeds = np.append(speeds, np.array([-1, 0, 0.2, 0.1, -0.5]) * optimal * 1.5)
    length, speed = (x.ravel() for x in np.meshgrid(lengths, speeds))
    active = muscle.active(jnp.asarray(length), jnp.asarray(speed), float)
    passive = muscle.passive(jnp.asarray(length), float)
    given = (RANGE, float(ACCELERATION), parameters)
    gains = [mujoco.mju_muscleGain(x, y, *given) for x, y in zip(length, speed, strict=True)]
    biases = [mujoco.mju_muscleBias(x, *given) for x in length]
    peak = abs(min(*gains, *biases))
    np.testing.assert_allclose(active, gains, rtol=0, atol=F64_ROUNDING * peak * 10)
    np.testing.assert_allclose(passive, biases, rtol=0, atol=F64_ROUNDING * peak * 10)


@pytest.mark.parametrize("width", [0.0, 0.4])
def test_recruitment(width):
    times = np.array([0.01, 0.04])
    limits = jnp.array([-np.inf, np.inf])
    activation = Recruitment(limits, jnp.asarray(times), jnp.asarray(width), width > 0)
    u, a = (x.ravel() for x in np.meshgrid(np.linspace(-0.5, 1.5, 41), np.linspace(-0.3, 1.3, 33)))
    found = activation.rate(jnp.asarray(u), jnp.asarray(a))
    given = np.array([*times, width])
    expected = [mujoco.mju_muscleDynamics(x, y, given) for x, y in zip(u, a, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_curves_have_finite_derivatives_at_their_knots():
    muscle = Muscle(*(jnp.asarray(x) for x in (SHAPE, RANGE, ACCELERATION)), scaled=True)
    optimal = (RANGE[1] - RANGE[0]) / 0.3
    lengths = RANGE[0] + (np.array([0.3, 0.5, 0.75, 1.0, 1.3, 1.6, 2.0]) - 0.75) * optimal
    length, V = (x.ravel() for x in np.meshgrid(lengths, [-2.0, -1.0, 0.0, 0.2, 1.0]))

    def active(muscle, length, speed):
        return muscle.active(length, speed, float)

    slope = jax.vmap(jax.grad(active, argnums=(0, 1, 2)), (None, 0, 0))
    found = jax.jit(slope)(muscle, jnp.asarray(length), jnp.asarray(V * optimal * 1.5))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
