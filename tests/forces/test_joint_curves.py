"""Torques and friction by position: against numpy's Chebyshev series, energy and slopes."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import chebyshev

import rbjax as rb
from tests.forces.against_mujoco import DRIVERS, applied, costs_nothing, energy_slope, slopes
from tests.tolerances import F64_ROUNDING, GRADIENT

MODEL = rb.load("cart_pole")
RNG = np.random.default_rng(3)
RANGE = np.array([[-0.4, 0.5], [0.2, 1.9]])
TORQUE, COULOMB = RNG.normal(size=(2, 6)), 1 + RNG.uniform(size=(2, 3))


def curves(**more):
    given = {"torque": TORQUE, "coulomb": COULOMB, "smoothing": [0.05, 0.2]} | more
    return rb.forces.JointCurves.of(MODEL, MODEL.joint_names, RANGE, **given)


def by_numpy(q, v, breakaway=0.0, stribeck=0.1):
    x = np.clip(2 * (q - RANGE[:, 0]) / np.ptp(RANGE, axis=1) - 1, -1, 1)
    c, F = ([chebyshev.chebval(x[:, j], k[j]) for j in range(2)] for k in (TORQUE, COULOMB))
    more = 1 + breakaway * np.exp(-((v / stribeck) ** 2))
    return -np.stack(c, 1) - np.stack(F, 1) * more * np.tanh(v / np.array([0.05, 0.2]))


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("breakaway", [0.0, 0.7])
def test_they_are_numpys_series(driver, breakaway):
    """Within the range, at its ends and beyond."""
    q = np.concatenate([RNG.uniform(-1, 2.5, (40, 2)), RANGE.T])
    v = 0.3 * RNG.normal(size=q.shape)
    model = MODEL.replace(driver=driver)
    plain = applied(model)(q, v, np.zeros((len(q), 1)))
    found = applied(model.with_forces(curves(breakaway=breakaway)))(q, v, np.zeros((len(q), 1)))
    want = by_numpy(q, v, breakaway)
    np.testing.assert_allclose(found - plain, want, atol=10 * F64_ROUNDING)


def test_one_coefficient_is_coulomb_friction():
    """That of `JointFriction`."""
    q, v = RNG.uniform(-1, 1, (10, 2)), RNG.normal(size=(10, 2))
    one = curves(torque=0.0, coulomb=[0.7, 0.2], smoothing=0.1)
    other = rb.forces.JointFriction.of(MODEL, MODEL.joint_names, [0.7, 0.2], smoothing=0.1)
    a, b = (applied(MODEL.with_forces(e))(q, v, np.zeros((10, 1))) for e in (one, other))
    np.testing.assert_allclose(a, b, atol=F64_ROUNDING)


@pytest.mark.parametrize("terms", [1, 2, 3, 6])
def test_the_torque_is_the_gradient_of_its_energy(terms):
    """Within the range and beyond it."""
    element = curves(torque=TORQUE[:, :terms], coulomb=0.0)
    for q in ([0.1, 1.0], [-0.9, 2.2]):
        force, slope = energy_slope(MODEL.with_forces(element), np.array(q))
        own, weight = energy_slope(MODEL, np.array(q))
        np.testing.assert_allclose(force - own, slope - weight, atol=1e-12)


def test_slopes():
    def f(at):
        element, q, v = at
        return rb.applied_forces(MODEL.with_forces(element), rb.State(q, v))

    at = (curves(breakaway=0.5), jnp.array([0.1, 1.0]), jnp.array([0.04, -0.1]))
    assert slopes(f, at) < GRADIENT


def test_zeros_cost_nothing():
    none = curves(torque=np.zeros((2, 1)), coulomb=np.zeros((2, 1)))
    assert costs_nothing(none, MODEL)


def test_what_it_cannot_act_on_is_named():
    ball = rb.load("quadruped")
    with pytest.raises(rb.InputError, match="expected hinges or slides"):
        rb.forces.JointCurves.of(ball, ball.joint_names[:1], [-1.0, 1.0])
    with pytest.raises(rb.InputError, match="torque"):
        curves(torque=np.zeros((3, 4)))
    with pytest.raises(rb.InputError, match="joints is empty"):
        rb.forces.JointCurves.of(MODEL, (), [-1.0, 1.0])
    with pytest.raises(rb.InputError, match="range is"):
        rb.forces.JointCurves.of(MODEL, MODEL.joint_names, [1.0, 1.0])
