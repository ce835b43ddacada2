"""Steps that take contacts and motors as dampers: their limit, their order, where others fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import wheeled
from rbjax.model import State
from rbjax.wheeled import DCMotor, Fiala, Relaxing, SpeedServo

KINDS = wheeled.kinds()
BRUSH = Fiala(15.0, 0.8, smooth_speed=0.3)
STEP = "linearly_implicit_euler"


def made(name, tyre=BRUSH, motor=None, **numbers):
    motor = motor or SpeedServo(3000.0 if "car" in name else 0.5)
    return wheeled.at(KINDS[name].make(motor=motor, **numbers), "slipping", tyre=tyre)


def end(vehicle, state, u, seconds, steps, method=STEP):
    path = wheeled.rollout(
        vehicle, state, jnp.tile(u, (steps, 1)), seconds / steps,
        integrator=method, save_every=steps,
    )  # fmt: skip
    return path.q[-1]


COMMANDS = {
    "omni_3": jnp.array([3.0, 4.0, -2.0]),
    "car": jnp.array([2.0, 0.1]),
    "differential_drive": jnp.array([3.0, 4.0]),
}


@pytest.mark.parametrize(
    ("name", "tyre"),
    [
        ("omni_3", BRUSH),
        ("differential_drive", BRUSH),
        pytest.param("car", Relaxing(BRUSH, 0.3, 0.01), marks=pytest.mark.slow),
    ],
)
def test_order_one_where_explicit_steps_blow_up(name, tyre):
    """Steps some hundred times longer than the decay of a wheel's slip."""
    vehicle = made(name, tyre)
    start, u = wheeled.start(vehicle), COMMANDS[name]
    rates = jax.jit(lambda state: wheeled.rates(vehicle, state, u))
    moving = wheeled.start(vehicle, twist=[0.3, 0.0, 0.0])
    nudged = State(moving.q, moving.v.at[-1].add(1e-4), moving.x)
    decay = abs(float(rates(nudged).v[-1] - rates(moving).v[-1])) / 1e-4
    fine = end(vehicle, start, u, 1.0, 4000)
    errors = [float(jnp.abs(end(vehicle, start, u, 1.0, k) - fine)[:3].max()) for k in (100, 400)]
    assert decay * 0.01 > 1.2 and errors[0] < 0.02 and 2.0 < errors[0] / errors[1] < 6.0
    explicit = end(vehicle, start, u, 1.0, 100, "semi_implicit_euler")
    assert not float(jnp.abs(explicit - fine)[:3].max()) < 0.1


@pytest.mark.parametrize("name", ["omni_3", "differential_drive"])
def test_endlessly_stiff_tyres_roll(name):
    """The step of the rolling robot, at any stiffness. (A traction without limit transfers loads
    without limit, where the centre of mass is above the ground.)"""
    motor = DCMotor(2.0, 0.05, gear=20.0)
    stiff = made(name, wheeled.LinearTyre(1e8, smooth_speed=1.0), motor, height=0.0)
    rolling = wheeled.at(stiff.robot, "reduced")
    twist, u = [0.3, 0.0, 0.2], COMMANDS[name]
    slip, roll = (end(x, wheeled.start(x, twist=twist), u, 0.5, 50) for x in (stiff, rolling))
    np.testing.assert_allclose(slip[:3], roll[:3], atol=1e-6)  # the stiffness is 1e8
    assert float(jnp.abs(roll[:2]).max()) > 0.05


def test_without_dampers_it_is_semi_implicit_euler():
    robot = KINDS["differential_drive"].make()
    vehicle = wheeled.at(robot, "reduced")
    start, u = wheeled.start(vehicle, twist=[0.5, 0.0, 1.0]), jnp.array([0.1, 0.2])
    a, b = (end(vehicle, start, u, 0.2, 20, method) for method in (STEP, "semi_implicit_euler"))
    np.testing.assert_allclose(a, b, rtol=1e-13)


@pytest.mark.parametrize("motor", [SpeedServo(0.5), SpeedServo(0.5, 2.0), DCMotor(2.0, 0.05)])
def test_damping_is_the_secant_to_the_free_speed(motor):
    for u, speed in ((3.0, -1.0), (0.5, 4.0), (2.0, 1.9)):
        due = motor.torque(u, speed) / (motor.free_speed(u) - speed)
        np.testing.assert_allclose(motor.damping(u, speed), due, rtol=1e-12)
    at_rest = float(motor.damping(2.0, motor.free_speed(2.0)))
    np.testing.assert_allclose(at_rest, -jax.grad(motor.torque, 1)(2.0, motor.free_speed(2.0)))


def test_damping_is_the_fall_of_the_traction():
    """Of the law at a fixed reference speed; of a carcass, over a step of its rate."""
    slides, roll, h = (0.02, -0.05), 1.5, 0.01
    ux = slides[0] + roll
    pull, _ = BRUSH.response(ux, slides[1], roll)
    found = BRUSH.damping(*slides, roll, h)
    np.testing.assert_allclose([-c * v for c, v in zip(found, slides, strict=True)], pull)
    relaxing, z = Relaxing(BRUSH, 0.3, 0.01), (0.001, -0.002)
    found = relaxing.damping(*slides, roll, h)

    def at_the_end(vx, vy):
        """The traction after a step, with the secants of now."""
        v = BRUSH.reference_speed(roll)
        G = BRUSH.secants(slides[0] / v, slides[1] / v)
        out = []
        for c, g, s, zeta in zip(relaxing.carcass, G, (vx, vy), z, strict=True):
            rate = -(g * s + c * v * zeta) / (g + c * v * 0.01)
            out.append(c * (zeta + (h + 0.01) * rate))
        return jnp.stack(out)

    slope = jax.jacfwd(lambda s: at_the_end(*s))(jnp.array(slides))
    np.testing.assert_allclose(-jnp.diag(slope), jnp.stack(found), rtol=1e-12)


def test_derivatives():
    """Forwards, backwards, and differences."""
    vehicle = made("omni_3")
    start, u = wheeled.start(vehicle), COMMANDS["omni_3"]

    @jax.jit
    def place(friction):
        tyre = BRUSH.replace(friction=friction)
        return end(vehicle.replace(tyre=tyre), start, u, 0.2, 10)[0]

    x, h = jnp.asarray(0.1), 1e-5
    due = (place(x + h) - place(x - h)) / (2 * h)
    forwards = jax.jit(jax.jacfwd(place))(x)
    assert abs(float(due)) > 1e-3
    np.testing.assert_allclose(forwards, due, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.grad(place))(x), forwards, rtol=1e-10)


def test_a_caster_that_would_lift_exerts_no_force():
    """A start from rest at full power takes the load off the front caster. Without a bound of the
    load at zero its tyre drove its wheel to a thousand turns a second, and a robot at these steps
    ended 0.2 to 0.6 m from its end at smaller ones. 5 mm: the error of the step of 5 ms."""
    robot = KINDS["differential_drive"].make(motor=wheeled.SpeedServo(5.0))
    speeds = wheeled.commands(robot, jnp.array([0.6, 0.0, 0.5])).speeds
    model = wheeled.at(robot, "slipping")
    start = wheeled.start(model)
    runs = [
        wheeled.rollout(model, start, lambda t, s: speeds, h, steps=round(2 / h), integrator=STEP)
        for h in (5e-3, 1e-3, 2e-4)
    ]
    early = State(runs[2].q[100], runs[2].v[100])
    assert wheeled.contacts(model, early, speeds).lifts[2]
    for run in runs[:2]:
        np.testing.assert_allclose(run.q[-1, :3], runs[2].q[-1, :3], atol=5e-3)
