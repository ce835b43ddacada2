"""Slip at the singular motions of a wheel, free rollers, laws of a user."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.wheeled import LinearTyre, RollingResistance
from tests.wheeled.laws import EVERY, by_complex_step, slopes_agree

# u_x, u_y, r phi': rolls, stands, is locked, spins on the spot, backwards, against its way, drifts
MOTIONS = np.array([
    [5.0, 0.0, 5.0], [0.0, 0.0, 0.0], [7.0, 0.5, 0.0], [0.0, 0.0, 9.0], [-3.0, 0.1, -3.2],
    [-2.0, 0.0, 4.0], [0.0, 2.0, 0.0], [1e-9, 0.0, 0.0], [6.0, 3.0, 7.0],
])  # fmt: skip


def test_slip():
    """Far above v_n the theoretical slip, whichever way the wheel turns."""
    law = LinearTyre(1.0, smooth_speed=1e-3)
    for ux, uy, roll in MOTIONS:
        if abs(roll) < 1e-3:
            continue
        want = [(ux - roll) / abs(roll), uy / abs(roll)]
        np.testing.assert_allclose(law.slip(ux, uy, roll), want, rtol=1e-6)
    np.testing.assert_array_equal(law.slip(0.0, 0.0, 0.0), [0.0, 0.0])
    np.testing.assert_allclose(law.slip(0.0, 0.0, 5.0), [-1.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(law.slip(2.0, -1.0, 0.0), [2000.0, -1000.0])


@EVERY
def test_power_is_lost_in_every_motion(law):
    rng = np.random.default_rng(2)
    u = np.concatenate([MOTIONS, rng.normal(size=(300, 3)) * 10 ** rng.uniform(-9, 3, (300, 1))])
    (x, y), rates = law.response(*jnp.asarray(u.T))
    power = x * (u[:, 0] - u[:, 2]) + y * u[:, 1]
    assert rates == () and law.size == 0 and law.stored() == 0.0
    assert np.all(power <= 0) and np.isfinite(power).all()
    slides = np.hypot(u[:, 0] - u[:, 2], u[:, 1]) > 0
    assert np.all(power[slides] < 0)


@EVERY
def test_derivatives_by_motion(law):
    def f(x):
        return jnp.concatenate([jnp.stack(law.response(*m)[0]) for m in x.reshape(-1, 3)])

    assert slopes_agree(f, jnp.ravel(MOTIONS)) < 1e-10


def test_rolling_resistance():
    drag = RollingResistance(0.015, 0.05)
    np.testing.assert_allclose(drag.torque(2000.0, 0.3, 4.0), -9.0)
    np.testing.assert_allclose(drag.torque(2000.0, 0.3, -4.0), 9.0)
    speeds = jnp.array([0.0, 1e-9, -0.02, 0.3])
    assert np.all(drag.torque(2000.0, 0.3, speeds) * speeds <= 0)
    leaves, tree = jax.tree.flatten(drag)

    def f(x):
        return jax.tree.unflatten(tree, [x[0], x[1]]).torque(x[2], x[3], x[4])[None]

    at = jnp.array([*leaves, 2000.0, 0.3, 0.03])
    assert slopes_agree(f, at) < 1e-10
    assert np.isfinite(by_complex_step(f, at.at[4].set(0.0))).all()
    with pytest.raises(rb.InputError, match=r"smooth_speed=.* above 0"):
        RollingResistance(0.01, -1.0)
    with pytest.raises(rb.InputError, match=r"coefficient=.* got the shape \(2,\)"):
        RollingResistance([0.01, 0.02])


@pytest.mark.parametrize("wrong", [[0.01, 0.02, 0.03], float("nan")], ids=["shape", "nan"])
@pytest.mark.parametrize("make", [
    RollingResistance, rb.wheeled.LinearTyre, lambda x: rb.wheeled.Fiala(20.0, x),
    lambda x: rb.wheeled.DCMotor(x, 0.05), lambda x: rb.wheeled.SpeedServo(0.4, x),
], ids=["resistance", "linear", "fiala", "motor", "servo"])  # fmt: skip
def test_wrong_numbers_are_rejected(make, wrong):
    """Numbers are checked whether or not equinox has resolved the types of the fields."""
    make(0.5)
    with pytest.raises(rb.InputError, match=r"\(\w+=\.\.\.\): "):
        make(wrong)


def test_a_law_of_a_user():
    """A law gives secants and slopes, and no more."""

    class Cubic(rb.wheeled.Tyre):
        smooth_speed: jax.Array
        c: jax.Array

        @property
        def slopes(self):
            return self.c, self.c

        def secants(self, sx, sy):
            return (self.c * (1 + sx * sx + sy * sy),) * 2

    law = Cubic(jnp.array(0.1), jnp.array(2.0))
    found = jax.jit(lambda law: law.response(1.0, 0.0, 1.0 / 1.5)[0])(law)
    slip = (1 - 1 / 1.5) / np.hypot(0.1, 1 / 1.5)
    np.testing.assert_allclose(found, [-2 * slip * (1 + slip**2), 0], rtol=1e-14)
    with pytest.raises(rb.InputError, match="smooth_speed"):
        Cubic(jnp.array(0.0), jnp.array(2.0))
    with pytest.raises(TypeError, match="abstract"):
        rb.wheeled.Tyre()
