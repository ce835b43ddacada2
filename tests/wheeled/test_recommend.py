"""The recommended fidelity is accurate enough on the manoeuvre, and the sentence has the number."""

import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import recommend, wheeled
from rbjax.errors import InputError, UnknownName
from rbjax.recommend.manoeuvre import Manoeuvre
from rbjax.wheeled import DCMotor, Fiala, SpeedServo

KINDS = wheeled.kinds()
slow = pytest.mark.slow


@pytest.fixture
def steady_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step of the first fidelity takes a microsecond, of the second two, and so on."""
    cost = {name: i + 1.0 for i, name in enumerate(wheeled.fidelities())}
    monkeypatch.setattr(Manoeuvre, "step_us", lambda self, name, _: cost[name])


def cart(motor=None, **numbers):
    return KINDS["differential_drive"].make(caster=None, wheel_mass=2.0, motor=motor, **numbers)


def bicycle(**numbers):
    return KINDS["bicycle"].make(motor=SpeedServo(2000.0, 4000.0), lag=0.1, **numbers)


def check(r: recommend.FidelityRecommendation, accuracy: float) -> None:
    """The cheapest of the good ones, with its numbers in the sentence."""
    best = min((x for x in r.candidates if x.success), key=lambda x: x.cost)
    assert (r.name, r.dt, r.error, r.cost) == (best.name, best.dt, best.error, best.cost)
    assert r.model.name == r.name and r.error <= accuracy
    assert f"{r.name} with steps of {r.dt:.2g} s is off by {r.error:.1e}" in r.reason
    assert f"(requested: {accuracy:.1e})" in r.reason


def test_inertia_decides_by_the_lag_of_the_servo(steady_clock) -> None:
    """m_e v' = 2 k (u - v / r) / r lags behind its command by v tau (1 - exp(-t / tau))."""
    robot, speed, r = cart(SpeedServo(0.05), height=0.0), 5.0, 0.08
    mass = 10.0 + 2 * 2.0 + 2 * (2.0 * r**2 / 2) / r**2
    lag = mass * r**2 / (2 * 0.05)
    behind = speed * r * lag * (1 - np.exp(-1 / lag))
    rolls = ["kinematic", "reduced", "dynamical"]
    coarse = recommend.fidelity(robot, [speed, speed], 1.1 * behind, among=rolls)
    check(coarse, 1.1 * behind)
    assert coarse.name == "kinematic"
    assert coarse.reason.startswith(
        "cost decides: reduced would take 2e+02 us per second of motion; "
    )
    np.testing.assert_allclose(coarse.error, behind, rtol=1e-3)
    assert np.isnan(coarse.share) and np.isnan(coarse.lifts)
    fine = recommend.fidelity(robot, [speed, speed], 0.9 * behind, among=rolls)
    check(fine, 0.9 * behind)
    assert fine.name == "reduced"
    assert fine.reason.startswith(f"inertia decides: kinematic is off by {behind:.1e}")
    equal = [x for x in fine.candidates if x.name != "kinematic"]
    assert {x.name for x in equal} == set(rolls[1:])
    np.testing.assert_allclose(equal[0].error, equal[1].error, atol=1e-12)


@slow
def test_slip_decides_where_a_corner_needs_more_friction_than_there_is() -> None:
    speed, angle, friction = 15.0, 0.1, 0.8
    robot, tyre, controls = bicycle(), Fiala(15.0, friction), [speed / 0.3, angle]
    twist = [speed, 0.0, 0.0]
    among = ["kinematic", "reduced", "slipping"]
    r = recommend.fidelity(robot, controls, 0.05, twist=twist, horizon=2.0, tyre=tyre, among=among)
    check(r, 0.05)
    assert r.name == "slipping"
    # of the corner at rest; the centre of mass is ahead of the rear axle
    turn = speed * np.tan(angle) / 2.6
    due = turn * speed / (9.81 * friction)
    np.testing.assert_allclose(r.share, due, rtol=0.05)
    assert due > 1 and f"rolling needs {r.share:.2g} of the traction" in r.reason
    rolling = next(x for x in r.candidates if x.name == "reduced")
    assert r.reason.startswith(f"slip decides: reduced is off by {rolling.error:.1e}")
    finest = wheeled.at(robot, "slipping", tyre=tyre)
    start = wheeled.start(finest, twist=twist)
    want = wheeled.simulate(finest, start, [0.0, 2.0], controls, tolerance=1e-9).q[-1, :3]
    steps = round(2.0 / r.dt)
    table = jnp.tile(jnp.array(controls), (steps, 1))
    found = wheeled.rollout(r.model, r.state, table, r.dt, save_every=steps).q[-1, :3]
    assert np.abs(found - want).max() <= 0.05
    ideal = wheeled.at(robot, "reduced")
    there = wheeled.simulate(ideal, wheeled.start(ideal, twist=twist), [0.0, 2.0], controls)
    away = np.hypot(*(there.q[-1, :2] - want[:2]))
    np.testing.assert_allclose(rolling.error, away, rtol=0.02)
    assert r.lifts == np.inf  # a bicycle is held up: all its wheels are in one plane


@slow
def test_a_slow_manoeuvre_is_kinematic(steady_clock) -> None:
    """Ideal servos on wheels that grip: an arc in closed form."""
    robot, u = cart(SpeedServo(5.0)), [5.2, 5.0]  # the right one first
    v, w = 0.08 * 5.1, 0.08 * 0.2 / 0.4
    r = recommend.fidelity(robot, u, 0.02, twist=[v, 0.0, w], horizon=4.0)
    check(r, 0.02)
    assert r.name == "kinematic" and r.share < 0.1 and r.lifts == np.inf
    steps = round(4.0 / r.dt)
    found = wheeled.rollout(r.model, r.state, jnp.tile(jnp.array(u), (steps, 1)), r.dt)
    arc = [v / w * np.sin(4 * w), v / w * (1 - np.cos(4 * w)), 4 * w]
    np.testing.assert_allclose(found.q[-1, :3], arc, atol=1e-9)
    finest = wheeled.at(robot, "slipping")
    start = wheeled.start(finest, twist=[v, 0.0, w])
    due = wheeled.simulate(finest, start, [0.0, 4.0], u).q[-1, :3]
    assert np.abs(found.q[-1, :3] - due).max() <= 0.02


@slow
def test_torques_and_a_table_of_them() -> None:
    """Every fidelity that rolls, one of them with rows and multipliers: one motion to rounding."""
    robot = cart()
    t = np.arange(100) * 0.02
    table = 0.1 * np.stack([np.sin(t), np.cos(t)], -1)
    rolls = ["kinematic", "reduced", "dynamical", "quasi_velocities", "constrained"]
    r = recommend.fidelity(robot, table, 1e-4, dt=0.02, among=rolls)
    check(r, 1e-4)
    assert r.reason.startswith("kinematic is not tried, because drives[0] is a TorqueSource")
    assert [x.name for x in r.candidates] == rolls[1:]
    np.testing.assert_allclose([x.error for x in r.candidates], r.error, rtol=0, atol=1e-11)
    assert r.name != "constrained"
    found = wheeled.rollout(r.model, r.state, jnp.repeat(table, round(0.02 / r.dt), 0), r.dt)
    fine = wheeled.rollout(r.model, r.state, jnp.repeat(table, 40, 0), 0.0005)
    assert np.abs(found.q[-1, :3] - fine.q[-1, :3]).max() <= 1e-4


@slow
def test_a_wheel_lifts() -> None:
    """Braking at mu g with the centre of mass at h: the rear lifts if mu h > its way to the front
    axle."""
    lifts = []
    for height in (0.9, 2.4):
        robot = KINDS["car"].make(drive="all", motor=SpeedServo(1e4), height=height)
        r = recommend.fidelity(
            robot, [0.0, 0.0, 0.0], 0.2, twist=[10.0, 0.0, 0.0], horizon=0.5, dt=0.005,
            tyre=Fiala(30.0, 0.8), among=["slipping"],
        )  # fmt: skip
        lifts.append(r.lifts)
        assert ("a wheel lifts at" in r.reason) == (r.lifts < np.inf)
    assert lifts[0] == np.inf and lifts[1] < 0.05


def test_controls_of_a_function_and_motors_with_a_free_speed() -> None:
    """A function of time and of coordinates; held over a step, as `rollout` holds it."""
    robot = cart(DCMotor(2.0, 0.05, gear=20.0))

    def volts(t, state):
        return jnp.stack([2.0 + jnp.sin(t), 2.0 - state.q[2]])

    r = recommend.fidelity(robot, volts, 1e-3, horizon=0.5, among=["kinematic"])
    check(r, 1e-3)
    steps = round(0.5 / r.dt)
    found = wheeled.rollout(r.model, r.state, volts, r.dt, steps=steps).q[-1, :3]
    due = wheeled.simulate(r.model, r.state, [0.0, 0.5], volts).q[-1, :3]
    assert np.abs(found - due).max() <= 1.5e-3


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"robot": "cart"}, "robot is 'cart', expected a Robot"),
        ({"accuracy": 1e-12}, "accuracy is 1e-12, expected at least 1e-10"),
        ({"horizon": -1.0}, "horizon is -1.0, expected a positive time"),
        ({"ctrl": np.zeros((5, 2)), "horizon": 1.0}, "leave out the horizon"),
        ({"ctrl": np.zeros((0, 2))}, r"ctrl has shape \(0, 2\), expected \(1, 2\)"),
        ({"ctrl": np.zeros(3)}, r"ctrl has shape \(3,\)"),
        ({"ctrl": lambda t: None}, "ctrl"),
        ({"q": np.zeros(3)}, r"q has shape \(3,\), expected \(5,\)"),
        ({"twist": [np.nan, 0.0, 0.0]}, r"twist\[0\] is nan"),
        ({"among": ["kinematic"]}, r"no fidelity is left .*drives\[0\] is a TorqueSource"),
        ({"tyre": "soft"}, "tyre is str, expected a law of tyres"),
    ],
)
def test_wrong_inputs(given: dict, message: str) -> None:
    given = {"robot": cart(), "ctrl": [0.0, 0.0], "accuracy": 1e-3} | given
    with pytest.raises(InputError, match=message):
        recommend.fidelity(**given)


def test_unknown_names() -> None:
    with pytest.raises(UnknownName, match="slipping"):
        recommend.fidelity(cart(), [0.0, 0.0], 1e-3, among=["sliding"])
