"""Robots whose wheels roll: against the oracles, each other, energy, and the wrong reduction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import wheeled
from rbjax.errors import InputError, UnknownName
from rbjax.model import State
from rbjax.wheeled import Body, Drive, Robot, SpeedServo, Steering, Wheel
from rbjax.wheeled.kinematics.velocities import constraint_rates, rolling_velocities
from rbjax.wheeled.models.equations import kinetic_energy, potential_energy
from tests.oracles import wheeled as oracle
from tests.wheeled.test_full_model import on_a_slope

KINDS = list(wheeled.kinds())
SOME = ["differential_drive", "car", "mecanum", "tractor_trailers"]
SOLVED = {"tolerance": 1e-13}


def differential(motor=None) -> Robot:
    p = oracle.DIFFERENTIAL["numbers"]
    numbers = {"radius": p["r"], "inertia": p["Iw"], "mass": p["mw"], "yaw_inertia": p["Im"]}
    wheels = [Wheel([0.0, side * p["b"]], **numbers) for side in (-1, 1)]
    drives = [Drive((i,), *([] if motor is None else [motor])) for i in (0, 1)]
    return Robot.of(Body(p["mc"], p["Ic"], [p["d"], 0.0]), wheels, drives)


def omni() -> Robot:
    p = oracle.OMNI["numbers"]
    wheels = [
        Wheel([p["l"] * np.cos(a), p["l"] * np.sin(a)], a + np.pi / 2, radius=p["r"],
              inertia=p["Iw"], kind="rollers")
        for a in np.deg2rad([0, 120, 240])
    ]  # fmt: skip
    return Robot.of(Body(p["m"], p["Iz"]), wheels, [Drive((i,)) for i in range(3)])


@pytest.mark.parametrize("fidelity", ["reduced", "dynamical"])
@pytest.mark.parametrize("case", oracle.DIFFERENTIAL["cases"])
def test_differential_drive_is_that_of_the_oracle(case, fidelity) -> None:
    torques, v, due = oracle.DIFFERENTIAL["cases"][case]
    cart = wheeled.at(differential(), fidelity)
    path = wheeled.simulate(cart, State(jnp.zeros(5), jnp.array(v)), [0.0, 5.0], torques, **SOLVED)
    assert path.success
    np.testing.assert_allclose([*path.q[-1], *path.v[-1]], due, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("case", oracle.OMNI["cases"])
def test_omnidirectional_robot_is_that_of_the_oracle(case) -> None:
    torques, v, due = oracle.OMNI["cases"][case]
    robot = wheeled.at(omni(), "reduced")
    path = wheeled.simulate(robot, State(jnp.zeros(6), jnp.array(v)), [0.0, 5.0], torques, **SOLVED)
    np.testing.assert_allclose([*path.q[-1, :3], *path.v[-1]], due, rtol=1e-10, atol=1e-10)


def test_a_blade_without_wheels_is_chaplygins_sleigh() -> None:
    (m, inertia, a), v, due = oracle.SLEIGH
    sleigh = Robot.of(Body(m, inertia, [a, 0.0]), [Wheel([0.0, 0.0])])
    start = State(jnp.array([-a, 0.0, 0.0, 0.0]), jnp.array(v))
    path = wheeled.simulate(wheeled.at(sleigh, "reduced"), start, [0.0, 5.0], **SOLVED)
    found = [*path.v[-1], path.q[-1, 2], *path.q[-1, :2]]
    np.testing.assert_allclose(found, due, rtol=1e-10, atol=1e-10)


def test_mecanum_wheels_move_as_in_modern_robotics() -> None:
    (l, w, r), displacements = oracle.MECANUM
    robot = wheeled.kinds()["mecanum"].make(
        length=2 * l, track=2 * w, radius=r, motor=SpeedServo(1.0)
    )
    base = wheeled.at(robot, "kinematic")
    for speeds, due in displacements.items():
        path = wheeled.rollout(base, wheeled.start(base), jnp.tile(jnp.array(speeds), (4, 1)), 0.25)
        np.testing.assert_allclose(path.q[-1, :3], due, atol=1e-12)
        np.testing.assert_allclose(path.q[-1, 3:], speeds, atol=1e-12)


def test_energy_by_substituted_constraints_gives_the_wrong_motion() -> None:
    """Chaplygin's error: Lagrange's equations of T with the rolling conditions put in before. Our
    Coriolis term carries the mass alone, m, and not m + mu."""
    p = oracle.OMNI["numbers"]
    mu = 3 * p["Iw"] / (2 * p["r"] ** 2)
    v = jnp.array([1.0, 0.0, 2.0])
    rate = wheeled.rates(wheeled.at(omni(), "reduced"), State(jnp.zeros(6), v), jnp.zeros(3)).v
    right = -p["m"] * v[2] * v[0] / (p["m"] + mu)
    assert abs(rate[1] - right) < 1e-12
    assert abs(rate[1] + v[2] * v[0]) > 0.1  # what the substituted energy gives


def random_state(vehicle, seed: int) -> tuple[State, jax.Array]:
    random = np.random.default_rng(seed)
    q = jnp.array(random.uniform(-0.5, 0.5, vehicle.nq))
    v = jnp.array(random.normal(size=vehicle.nv))
    return State(q, v), jnp.array(random.normal(size=vehicle.nu))


@pytest.mark.parametrize(
    "kind", [k if k in SOME else pytest.param(k, marks=pytest.mark.slow) for k in KINDS]
)
def test_all_reductions_agree(kind) -> None:
    """Newton-Euler projected, multipliers eliminated, and energies by Boltzmann and Hamel."""
    robot = on_a_slope(kind, behind=0.6)
    ours = wheeled.at(robot, "reduced")
    for seed in range(3):
        state, u = random_state(ours, seed)
        a = np.asarray(wheeled.rates(ours, state, u).v)
        for other in ("dynamical", "quasi_velocities"):
            b = np.asarray(wheeled.rates(wheeled.at(robot, other), state, u).v)
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-11 * max(1.0, np.abs(a).max()))


@pytest.mark.parametrize(
    "kind", [k if k in SOME else pytest.param(k, marks=pytest.mark.slow) for k in KINDS]
)
def test_power_of_the_drives_is_the_rate_of_energy(kind) -> None:
    """T' + U' = sum of torque times speed, with casters, trailers and Ackermann's geometry; the
    steering stands, as what turns it would add power."""
    robot = on_a_slope(kind, behind=0.6)
    vehicle = wheeled.at(robot, "reduced")
    state, u = random_state(vehicle, 7)
    u = u.at[len(robot.drives) :].set(0.0)

    def energy(q, v):
        context = vehicle.context(State(q, v), u)
        n = context.n
        w = vehicle.full_velocities(context)
        return jnp.asarray(kinetic_energy(n, context.shape, w) + potential_energy(context))

    rate = wheeled.rates(vehicle, state, u)
    _, change = jax.jvp(energy, (state.q, state.v), (rate.q, rate.v))
    layout, power = robot.layout, 0.0
    for drive, torque in zip(robot.drives, u, strict=False):
        for i, share in zip(drive.wheels, drive.split, strict=True):
            power += share * torque * rate.q[layout.shafts.start + layout.shaft[i]]
    np.testing.assert_allclose(change, power, rtol=0, atol=1e-10 * max(1.0, abs(float(power))))


@pytest.mark.parametrize("kind", SOME)
def test_velocities_satisfy_the_rows_of_all_wheels(kind) -> None:
    vehicle = wheeled.at(wheeled.kinds()[kind].make(), "reduced")
    state, u = random_state(vehicle, 3)
    context = vehicle.context(state, u)
    n = context.n
    found = constraint_rates(n, context.shape, vehicle.full_velocities(context))
    np.testing.assert_allclose(np.array(found, float), 0.0, atol=1e-14)


@pytest.mark.parametrize("kind", ["differential_drive", "mecanum", "car", "tractor_trailers"])
def test_what_holds_the_wheels_does_no_work(kind) -> None:
    """On any motion that wheels allow; and of a turn at constant speed it is m v w, to the left."""
    vehicle = wheeled.at(wheeled.kinds()[kind].make().replace(slope=[0.1, -0.05]), "reduced")
    state, u = random_state(vehicle, 5)
    context = vehicle.context(state, u)
    n = context.n
    shape = context.shape
    held = np.array(vehicle.ground_forces(context), float)
    for unit in np.eye(vehicle.nv):
        basis = np.array(rolling_velocities(n, shape, list(unit)), float)
        scale = np.abs(held * basis).max()
        assert abs(held @ basis) <= 1e-13 * max(1.0, scale)
    cart = wheeled.at(wheeled.kinds()["differential_drive"].make(caster=None, com=(0.0, 0.0)),
                      "reduced")  # fmt: skip
    context = cart.context(wheeled.start(cart, twist=[2.0, 0.0, 0.5]))
    n = context.n
    np.testing.assert_allclose(cart.ground_forces(context)[:2], [0.0, 11.0 * 2.0 * 0.5], atol=1e-12)


def test_classes_of_arrangements() -> None:
    """Campion, Bastin & D'Andrea-Novel 1996, the five classes (d_m, d_s), and two that lock."""
    kinds = wheeled.kinds()
    classes = {
        "omni_3": (3, 0), "mecanum": (3, 0), "differential_drive": (2, 0), "skid_steer": (2, 0),
        "car": (1, 1), "tricycle": (1, 1), "tractor_trailers": (2, 0), "car_trailer": (1, 1),
    }  # fmt: skip
    for name, due in classes.items():
        found = kinds[name].make().arrangement
        assert (found.mobility, found.steerability) == due, name
    body, at = Body(1.0, 1.0), [[0.5, 0.3], [-0.5, -0.2], [0.0, 0.4]]
    one = Robot.of(body, [Wheel(at[0], kind="steered")], [], [Steering((0,))]).arrangement
    assert (one.mobility, one.steerability) == (2, 1)
    wheels = [Wheel(p, kind="steered") for p in at]
    two = Robot.of(body, wheels[:2], [], [Steering((0,)), Steering((1,))]).arrangement
    assert (two.mobility, two.steerability) == (1, 2)
    with pytest.raises(InputError, match="lock the chassis"):
        Robot.of(body, wheels, [], [Steering((i,)) for i in range(3)])
    with pytest.raises(InputError, match=r"lock the chassis|contradicts"):
        Robot.of(body, [Wheel([0.0, 0.3]), Wheel([0.4, 0.3]), Wheel([0.4, 0.0], 1.0)])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_wheels_whose_headings_are_backward_roll_by_negative_rates(dtype) -> None:
    """Free velocities are ahead all the same; in f32, too, pi is the direction opposite to 0."""
    back = dtype(np.pi)
    wheels = [Wheel([0.0, 0.2], back), Wheel([0.0, -0.2], dtype(0.0))]
    cart = wheeled.at(Robot.of(Body(1.0, 1.0), wheels), "reduced")
    assert cart.robot.arrangement.mobility == 2
    state = wheeled.start(cart, twist=[0.5, 0.0, 0.5])
    np.testing.assert_allclose(state.v, [0.5, 0.5], rtol=1e-6)
    rates = wheeled.rates(cart, state, jnp.zeros(0)).q
    np.testing.assert_allclose(rates, [0.5, 0.0, 0.5, -4.0, 6.0], atol=1e-6)
    front = [Wheel([2.0, y], h, kind="steered") for y, h in ((0.5, back), (-0.5, dtype(0.0)))]
    car = Robot.of(Body(1.0, 1.0), [*wheels, *front], [], [Steering((2, 3))])
    found = wheeled.commands(car, [1.0, 0.0, 0.3])
    np.testing.assert_allclose(found.angles, np.arctan(0.6), rtol=1e-6)
    vehicle = wheeled.at(car, "reduced")
    state = wheeled.start(vehicle)
    state = state.replace(q=state.q.at[3].set(np.arctan(0.6)), v=jnp.ones(1))
    context = vehicle.context(state)
    shape = context.shape
    centre = np.array([0.0, 2.0 / 0.6])
    for wheel, e, sign in zip(front, shape.wheels[2:], (-1, 1), strict=True):
        arm = np.asarray(wheel.position) - centre
        due = sign * np.array([-arm[1], arm[0]]) / np.hypot(*arm)
        np.testing.assert_allclose(np.array(e, float), due, atol=1e-6)


def test_trailers_can_be_added_at_every_fidelity() -> None:
    robot = wheeled.with_trailers(differential(), 2, drawbar=0.7)
    for name, fidelity in wheeled.fidelities().items():
        vehicle = wheeled.at(robot, name)
        assert type(vehicle) is fidelity and vehicle.nq == 5 + 2 + 4


def test_a_car_turns_about_the_axle_of_its_rear_wheels() -> None:
    """Ackermann: each front wheel is across the line from the centre of the turn to its hub."""
    from rbjax.wheeled.kinematics.velocities import contact_velocity, twists_of

    vehicle = wheeled.at(wheeled.kinds()["car"].make(), "reduced")
    state = wheeled.start(vehicle, twist=[3.0, 0.0, 0.0])
    state = State(state.q.at[3].set(0.5), state.v)
    context = vehicle.context(state)
    n = context.n
    shape = context.shape
    twists = twists_of(n, shape, vehicle.full_velocities(context))
    for i in range(4):
        assert abs(contact_velocity(n, shape, twists, i)[1]) < 1e-14
    x, _, w = twists[0]
    np.testing.assert_allclose(w, x * np.tan(0.5) / 2.6, rtol=1e-12)


@pytest.mark.slow
def test_gradients_of_a_manoeuvre_with_respect_to_every_number() -> None:
    """Reverse against forward mode and central differences, through a rollout of a car."""
    robot = wheeled.kinds()["bicycle"].make()
    u = jnp.tile(jnp.array([300.0, 0.05]), (20, 1))

    def end(robot):
        car = wheeled.at(robot, "reduced")
        state = State(jnp.zeros(car.nq).at[3].set(0.1), jnp.array([2.0]))
        return wheeled.rollout(car, state, u, 0.05).q[-1, :3].sum()

    slopes = jax.grad(end, allow_int=True)(robot)
    leaves, tree = jax.tree.flatten(robot)
    for k, (leaf, slope) in enumerate(zip(leaves, jax.tree.leaves(slopes), strict=True)):
        assert np.isfinite(slope).all()
        if jnp.ndim(leaf) == 0 and k % 3 == 0:
            h = 1e-5 * max(1.0, abs(float(leaf)))
            ends = []
            for sign in (1, -1):
                changed = [*leaves[:k], leaf + sign * h, *leaves[k + 1 :]]
                ends.append(float(end(jax.tree.unflatten(tree, changed))))
            due = (ends[0] - ends[1]) / (2 * h)
            np.testing.assert_allclose(slope, due, rtol=1e-5, atol=1e-7)


def test_a_batch_is_its_samples_and_controls_may_be_a_function() -> None:
    cart = wheeled.at(differential(), "reduced")
    one = wheeled.start(cart, twist=[0.5, 0.0, 0.2])
    many = jax.tree.map(lambda x: jnp.stack([x, 2 * x, 3 * x]), one)
    u = jnp.full((6, 2), 0.1)
    batch = wheeled.rollout(cart, many, u, 0.1, save_every=3)
    assert batch.q.shape == (3, 3, 5)
    single = wheeled.rollout(cart, State(many.q[1], many.v[1]), u, 0.1, save_every=3)
    np.testing.assert_allclose(batch.q[1], single.q, atol=1e-14)
    asked = wheeled.rollout(cart, one, lambda t, s: jnp.full(2, 0.1), 0.1, steps=6)
    np.testing.assert_allclose(asked.q[-1], batch.q[0, -1], atol=1e-14)
    coarse = wheeled.rollout(cart, one, u, 0.1, integrator="semi_implicit_euler")
    assert 1e-6 < np.abs(coarse.q[-1] - asked.q[-1]).max() < 0.1


def test_bad_arguments_are_named() -> None:
    cart = wheeled.at(differential(), "reduced")
    state = wheeled.start(cart)
    with pytest.raises(UnknownName, match="reduced"):
        wheeled.at(differential(), "kinematics")
    with pytest.raises(UnknownName, match="rk4"):
        wheeled.rollout(cart, state, jnp.zeros((2, 2)), 0.1, integrator="rk5")
    with pytest.raises(InputError, match="ctrl has shape"):
        wheeled.rates(cart, state, jnp.zeros(3))
    with pytest.raises(InputError, match="expected a robot at a fidelity"):
        wheeled.rates(differential(), state, jnp.zeros(2))
    with pytest.raises(InputError, match="steps is None"):
        wheeled.rollout(cart, state, lambda t, s: jnp.zeros(2), 0.1)
    with pytest.raises(InputError, match="no free speed"):
        wheeled.rates(
            wheeled.at(differential(), "kinematic"), State(jnp.zeros(5), jnp.zeros(0)), [1.0, 1.0]
        )
    with pytest.raises(InputError, match=r"wheels\[1\].body"):
        Robot.of(Body(1.0, 1.0), [Wheel([0.0, 0.0]), Wheel([0.0, 0.0], body=1)])
    with pytest.raises(InputError, match="twice"):
        Robot.of(Body(1.0, 1.0), [Wheel([0.0, 0.0])], [Drive((0,)), Drive((0,))])
    with pytest.raises(UnknownName, match="caster"):
        Wheel([0.0, 0.0], kind="castor")
