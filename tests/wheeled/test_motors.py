"""Motors: textbook figures of a DC motor, energy balance, limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.wheeled import DCMotor, SpeedServo, TorqueSource
from tests.wheeled.laws import numbers, slopes_agree

R, K, N = 2.0, 0.05, 20.0
MOTORS = {
    "torque": TorqueSource(),
    "servo": SpeedServo(0.5, 3.0),
    "endless servo": SpeedServo(0.5),
    "plain": DCMotor(R, K, N),
    "dc": DCMotor(R, K, N, battery=12.0, friction=0.02, rotor_inertia=1e-5),
}
EVERY = pytest.mark.parametrize("motor", MOTORS.values(), ids=MOTORS.keys())


def test_figures_of_a_dc_motor():
    motor, V = MOTORS["plain"], 12.0
    free = V / (N * K)
    np.testing.assert_allclose(motor.torque(V, 0.0), N * K * V / R)  # stalled
    np.testing.assert_allclose(motor.free_speed(V), free)
    np.testing.assert_allclose(motor.power_in(V, 0.0), V * V / R)
    np.testing.assert_allclose(motor.torque(V, free / 2) * free / 2, V * V / (4 * R))  # its most
    half = motor.torque(V, free / 2) * free / 2 / motor.power_in(V, free / 2)
    np.testing.assert_allclose(half, 0.5)
    np.testing.assert_allclose(MOTORS["dc"].inertia, 4e-3)
    assert motor.inertia == 0


def test_limits():
    dc, servo = MOTORS["dc"], MOTORS["servo"]
    np.testing.assert_allclose(dc.torque(1e3, 0.0), N * K * 12 / R)
    np.testing.assert_allclose(dc.torque(0.1, 0.0), N * K * 0.1 / R, rtol=1e-4)
    np.testing.assert_allclose(servo.torque(100.0, 0.0), 3.0)
    np.testing.assert_allclose(servo.torque(0.1, 0.0), 0.05, rtol=1e-4)
    np.testing.assert_allclose(MOTORS["endless servo"].torque(100.0, 0.0), 50.0)
    slope = jax.grad(lambda limit: SpeedServo(jnp.array(0.5), limit).torque(3.0, 1.0))
    assert slope(jnp.array(jnp.inf)) == 0


@EVERY
def test_power_in_is_torque_and_heat(motor):
    u, speed = np.random.default_rng(0).normal(size=(2, 300)) * 15
    power, heat = motor.power_in(u, speed), motor.heat(u, speed)
    torque = motor.torque(u, speed)
    scale = np.abs(power) + np.abs(torque * speed) + np.abs(heat)
    assert np.max(np.abs(power - torque * speed - heat) / scale) < 1e-14
    assert np.all(heat >= 0)


@EVERY
def test_free_speed(motor):
    u = np.linspace(-20, 20, 9)
    if isinstance(motor, TorqueSource):
        with pytest.raises(rb.InputError, match="TorqueSource has no free speed: its torque is"):
            motor.free_speed(u)
        return
    np.testing.assert_allclose(motor.torque(u, motor.free_speed(u)), 0, atol=1e-13)


@EVERY
def test_derivatives(motor):
    row, back = numbers(motor) if jax.tree.leaves(motor) else (jnp.zeros(0), lambda x: motor)
    at = jnp.array([3.0, 1.0])

    def f(x):
        motor, (u, speed) = back(x[:-2]), x[-2:]
        return jnp.stack([motor.torque(u, speed), motor.power_in(u, speed)])

    if np.isfinite(row).all():
        assert slopes_agree(f, jnp.concatenate([row, at])) < 1e-10
    else:
        jac = jax.jacrev(f)(jnp.concatenate([row, at]))
        assert np.isfinite(jac).all()


def test_bad_numbers():
    with pytest.raises(rb.InputError, match=r"DCMotor\(resistance=...\): got 0.0, expected"):
        DCMotor(0.0, 0.05)
    with pytest.raises(rb.InputError, match=r"gear=.* expected finite numbers"):
        DCMotor(1.0, 0.05, gear=np.inf)
    with pytest.raises(rb.InputError, match=r"limit=.* got -3.0, expected numbers above 0"):
        SpeedServo(1.0, -3.0)
    with pytest.raises(rb.InputError, match=r"friction=.* got the shape \(2,\)"):
        DCMotor(1.0, 0.05, friction=[0.1, 0.2])
