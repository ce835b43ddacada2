"""Robots whose wheels slip: limits, loads, balance of power, gradients, every kind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import wheeled
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.wheeled import Fiala, LinearTyre, Relaxing, RollingResistance, TMeasy
from rbjax.wheeled.kinematics.velocities import contact_velocity, twists_of
from rbjax.wheeled.models.equations import kinetic_energy, potential_energy
from rbjax.wheeled.models.forces import wheel_loads

KINDS = wheeled.kinds()
SOME = ["differential_drive", "car_trailer"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["differential_drive", "omni_3"])
def test_stiff_tyres_roll_without_slip(kind) -> None:
    """As the stiffness grows ten times, the distance from the ideal motion falls ten times."""
    robot = KINDS[kind].make(**({} if kind == "omni_3" else {"caster": None}))
    u = jnp.array([0.06, 0.05, 0.02][: robot.nu])
    ideal = wheeled.at(robot, "reduced")
    twist = [0.4, 0.0, 0.3]
    due = wheeled.simulate(ideal, wheeled.start(ideal, twist=twist), [0.0, 0.5], u).q[-1, :3]
    apart = []
    for stiffness in (20.0, 200.0):
        slips = wheeled.at(robot, "slipping", tyre=LinearTyre(stiffness, smooth_speed=0.5))
        start = wheeled.start(slips, twist=twist)
        found = wheeled.simulate(slips, start, [0.0, 0.5], u, tolerance=1e-8).q[-1, :3]
        apart.append(float(np.abs(found - due).max()))
    assert apart[0] < 0.05
    assert 5 < apart[0] / apart[1] < 20


@pytest.mark.parametrize(
    "kind", [k if k in SOME else pytest.param(k, marks=pytest.mark.slow) for k in KINDS]
)
def test_power_is_balanced(kind) -> None:
    """T' + U' = drives - what contacts dissipate - rolling resistance, on a slope."""
    robot = KINDS[kind].make().replace(slope=[0.1, -0.05], resistance=RollingResistance(0.02))
    vehicle = wheeled.at(robot, "slipping", tyre=Fiala(15.0, 0.8))
    random = np.random.default_rng(2)
    q, v = (jnp.array(random.uniform(-0.4, 0.4, k)) for k in (vehicle.nq, vehicle.nv))
    v = v.at[2 + len(robot.bodies) :].mul(10.0)
    u = jnp.array(random.normal(size=robot.nu)).at[len(robot.drives) :].set(0.0)

    def energy(q, v):
        context = vehicle.context(State(q, v), u)
        n = context.n
        return jnp.asarray(kinetic_energy(n, context.shape, v) + potential_energy(context))

    rate = wheeled.rates(vehicle, State(q, v), u)
    _, change = jax.jvp(energy, (q, v), (rate.q, rate.v))
    context = vehicle.context(State(q, v), u)
    n = context.n
    shape = context.shape
    twists = twists_of(n, shape, context.v)
    loads, forces = vehicle.wheel_forces(context)
    shafts = v[2 + len(robot.bodies) :]
    power, sliding = 0.0, []
    for drive, torque in zip(robot.drives, u, strict=False):
        for i, share in zip(drive.wheels, drive.split, strict=True):
            power += share * torque * shafts[robot.layout.shaft[i]]
    for i, (wheel, e, f, load) in enumerate(
        zip(n.wheels, shape.wheels, forces, loads, strict=True)
    ):
        along, across = contact_velocity(n, shape, twists, i)
        roll = wheel.radius * shafts[wheel.shaft]
        across = 0.0 if wheel.kind == "caster" else across
        x, y = f[0] * e[0] + f[1] * e[1], f[1] * e[0] - f[0] * e[1]
        sliding.append(x * (along - roll) + y * across)
        # every contact dissipates, and a wheel that would lift has none
        assert sliding[-1] < 0 or (load < 0 and sliding[-1] == 0)
        resistance = robot.resistance.torque(jnp.maximum(load, 0.0), wheel.radius, roll)
        power += resistance * shafts[wheel.shaft]
    due = power + sum(sliding)
    np.testing.assert_allclose(change, due, rtol=1e-9, atol=1e-9)


def test_loads_carry_the_weight_and_balance_the_moments_of_the_tyres() -> None:
    vehicle = wheeled.at(KINDS["car"].make(), "slipping", tyre=Fiala(15.0, 0.9))
    state = wheeled.start(vehicle, twist=[15.0, 0.0, 0.0])
    v = state.v.at[1].set(0.8).at[3].mul(1.05).at[4].mul(1.04)
    context = vehicle.context(State(state.q, v))
    n = context.n
    at_rest = np.array(wheel_loads(n), float)
    loads, forces = (np.array(x, float) for x in vehicle.wheel_forces(context))
    places = np.array([w.position for w in vehicle.robot.wheels])
    body = n.bodies[0]
    weight, com = body.mass * 9.81, np.array(body.moment, float) / body.mass
    for found in (at_rest, loads):
        np.testing.assert_allclose(found.sum(), weight, rtol=1e-12)
    np.testing.assert_allclose((places - com).T @ at_rest, 0, atol=1e-9 * weight)
    due = -0.5 * forces.sum(0)  # the height times the forces on the ground
    np.testing.assert_allclose((places - com).T @ loads, due, atol=1e-9 * weight)
    assert loads[0] > at_rest[0] and loads[1] < at_rest[1]  # it slides left: the left is loaded


def test_locked_wheels_brake_with_the_whole_friction() -> None:
    """v^2 / (2 mu g) where all wheels are held by a servo at speed zero."""
    from rbjax.wheeled import SpeedServo

    car = KINDS["car"].make(drive="all", motor=SpeedServo(1e4))
    vehicle = wheeled.at(car, "slipping", tyre=Fiala(30.0, 0.7))
    start = wheeled.start(vehicle, twist=[10.0, 0.0, 0.0])
    path = wheeled.simulate(vehicle, start, [0.0, 1.0], tolerance=1e-8)
    np.testing.assert_allclose(path.v[-1, 0], 10.0 - 0.7 * 9.81, rtol=2e-2)


def test_relaxing_tyres_have_states_and_reach_the_steady_force() -> None:
    robot = KINDS["bicycle"].make()
    steady = Fiala(15.0, 0.9, smooth_speed=0.01)
    vehicle = wheeled.at(robot, "slipping", tyre=Relaxing(steady, 0.3))
    plain = wheeled.at(robot, "slipping", tyre=steady)
    assert vehicle.nx == 4
    start, other = (wheeled.start(x, twist=[10.0, 0.0, 0.0]) for x in (vehicle, plain))
    q = start.q.at[3].set(0.03)
    path = wheeled.simulate(vehicle, State(q, start.v, start.x), [0.0, 0.02, 2.0], tolerance=1e-8)
    ends = wheeled.simulate(plain, State(q, other.v), [0.0, 0.02, 2.0], tolerance=1e-8)
    assert abs(path.v[1, 1]) < 0.9 * abs(ends.v[1, 1])  # it takes a way to build up
    np.testing.assert_allclose(path.v[-1, :3], ends.v[-1, :3], rtol=0.02, atol=0.01)


def test_gradients_with_respect_to_tyres_and_wheels() -> None:
    """Reverse mode against central differences of a manoeuvre."""
    robot = KINDS["differential_drive"].make(caster=None, wheel_mass=5.0)

    def end(numbers):
        law = Fiala(numbers[0], numbers[1], numbers[2])
        vehicle = wheeled.at(robot, "slipping", tyre=law)
        start = wheeled.start(vehicle, twist=[1.0, 0.0, 1.0])
        return wheeled.rollout(vehicle, start, jnp.full((40, 2), 0.3), 0.002).q[-1, :3].sum()

    at = jnp.array([12.0, 0.6, 0.5])
    slope = jax.grad(end)(at)
    for k in range(3):
        h = 1e-6 * at[k]
        due = (end(at.at[k].add(h)) - end(at.at[k].add(-h))) / (2 * h)
        np.testing.assert_allclose(slope[k], due, rtol=1e-5, atol=1e-8)


def test_numbers_along_and_across() -> None:
    """Two equal numbers are one number, closed over or as arguments; across counts by itself."""
    robot = KINDS["bicycle"].make()
    tyres = [
        Fiala(12.0, 0.8),
        Fiala([12.0, 12.0], [0.8, 0.8]),
        TMeasy(25.0, 0.1, 1.0, 0.4, 0.8),
        TMeasy([25.0, 25.0], 0.1, [1.0, 1.0], 0.4, [0.8, 0.8]),
    ]

    @jax.jit
    def closed(q, v):
        vehicles = [wheeled.at(robot, "slipping", tyre=x) for x in tyres]
        return [wheeled.rates(x, State(q, v), jnp.ones(2)).v for x in vehicles]

    v = jnp.array([8.0, 0.3, 0.1, 27.0, 26.0])
    found = closed(jnp.full(6, 0.1), v)
    for one, two in (found[:2], found[2:]):
        np.testing.assert_allclose(two, one, rtol=1e-13)
    given = wheeled.at(robot, "slipping", tyre=Fiala([12.0, 12.0], [0.8, 0.8]))
    rate = wheeled.rates(given, State(jnp.full(6, 0.1), v), jnp.ones(2)).v
    np.testing.assert_allclose(rate, found[0], rtol=1e-12)
    slick = wheeled.at(robot, "slipping", tyre=Fiala([12.0, 6.0], [0.8, 0.4]))
    less = wheeled.rates(slick, State(jnp.full(6, 0.1), v), jnp.ones(2)).v
    assert abs(less[1] - rate[1]) > 0.1


def test_what_cannot_slip_is_refused() -> None:
    with pytest.raises(InputError, match="inertia"):
        robot = wheeled.Robot.of(wheeled.Body(1.0, 1.0), [wheeled.Wheel([0.0, 0.0])])
        wheeled.at(robot, "slipping")
    with pytest.raises(InputError, match="one for each"):
        wheeled.at(KINDS["bicycle"].make(), "slipping", tyre=(Fiala(10.0, 0.9),))
    with pytest.raises(InputError, match="relaxes"):
        wheeled.at(KINDS["omni_3"].make(), "slipping", tyre=Relaxing(Fiala(10.0, 0.9), 0.1))
