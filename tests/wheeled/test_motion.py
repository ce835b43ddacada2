"""Whole manoeuvres: gradients by every number, the balance of energy, rows over a million steps."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import wheeled
from rbjax.compiling import compiler_options
from rbjax.model import State
from rbjax.wheeled import DCMotor, Relaxing, RollingResistance, SpeedServo
from rbjax.wheeled.kinematics.velocities import (
    constraint_rates,
    contact_velocity,
    drive_speeds,
    twists_of,
)
from rbjax.wheeled.models.equations import kinetic_energy, potential_energy
from rbjax.wheeled.models.forces import wheel_loads
from rbjax.wheeled.models.robot_model import as_state
from rbjax.wheeled.models.slipping import Slipping
from rbjax.wheeled.motion.rollout import INTEGRATORS
from tests.wheeled.laws import LAWS, by_complex_step, numbers

KINDS = wheeled.kinds()
slow = pytest.mark.slow


# ---------------------------------------------------------------- gradients by every number


def table(robot, steps: int, dt: float) -> jax.Array:
    """Torques that speed up and brake; a car steers to and fro."""
    t = np.arange(steps) * dt
    if robot.steerings:
        return jnp.array(np.stack([300 * np.sin(t), 0.06 * np.cos(1.2 * t)], -1))
    return jnp.array(np.stack([0.02 * np.sin(t + i) for i in range(robot.nu)], -1))


def end_of(vehicle, twist, u, dt):
    """The pose at the end by all numbers of a vehicle in a row: of real ones by `rollout`, of
    complex ones by the steps of its method."""
    start = wheeled.start(vehicle, twist=twist)
    row, back = numbers(vehicle)

    def end(row):
        own, dtype = back(row), row.dtype
        if not jnp.iscomplexobj(row):
            return wheeled.rollout(own, start, u, dt, save_every=len(u)).q[-1, :3]
        context = own.context(jax.tree.map(lambda x: x.astype(dtype), start))
        n = context.n

        def once(y, u):
            after = INTEGRATORS["rk4"](own, n, y, list(u), dt)
            return jax.tree.map(lambda x: jnp.asarray(x, dtype), after), None

        begin = (context.q, context.v, context.x)
        q = jax.lax.scan(once, begin, u.astype(dtype))[0][0]
        return jnp.stack(q[:3])

    return row, end


def soft(*laws):
    """Laws whose contacts are not too stiff for the steps."""
    return tuple(law.replace(smooth_speed=jnp.asarray(0.5)) for law in laws)


COULOMB = wheeled.Coulomb([0.8, 0.6], [0.08, 0.1])
TWO = {name: LAWS[f"{name}, two"] for name in ("linear", "saturated", "fiala", "pacejka", "tmeasy")}
RELAXING = Relaxing(soft(TWO["fiala"])[0], [0.3, 0.4], 0.01)
# steps are stable: where wheels chatter, a slope is rounding that has grown
GRADIENTS = {
    "car, rolling": ("car", "reduced", None, 0.01),
    "omni_3, rolling": ("omni_3", "reduced", None, 0.01),
    "car, four laws": (
        "car", "slipping",
        soft(TWO["saturated"], TWO["fiala"], TWO["pacejka"], TWO["tmeasy"]), 0.002,
    ),
    "car, relaxing": (
        "car", "slipping", (RELAXING, RELAXING, *soft(COULOMB, TWO["linear"])), 0.004,
    ),
    "omni_3, three laws": (
        "omni_3", "slipping", soft(COULOMB, TWO["pacejka"], TWO["tmeasy"]), 0.001,
    ),
}  # fmt: skip


@slow
@pytest.mark.parametrize("case", GRADIENTS)
def test_gradients_of_ten_seconds_by_every_number(case) -> None:
    """Reverse mode = forward mode = complex steps, of each number of each wheel and each tyre."""
    kind, fidelity, tyre, dt = GRADIENTS[case]
    robot = KINDS[kind].make(**({"wheel_mass": 2.0} if kind == "omni_3" else {}))
    vehicle = wheeled.at(robot, fidelity, **({} if tyre is None else {"tyre": tyre}))
    twist = [8.0, 0.0, 0.0] if kind == "car" else [0.5, 0.1, 0.3]
    row, end = end_of(vehicle, twist, table(robot, round(10.0 / dt), dt), dt)

    def run(f):
        return np.asarray(jax.jit(f, compiler_options=compiler_options())(row))

    due = run(lambda x: by_complex_step(end, x))
    largest = np.abs(due).max(1, keepdims=True)
    assert np.isfinite(due).all() and (largest > 1).all()
    # below this a slope is rounding of what cancels, or of a number that does nothing
    counts = np.abs(due) > 1e-7 * largest
    for found in (run(jax.jacfwd(end)), run(jax.jacrev(end))):
        off = np.abs(found - due)
        assert (off[counts] / np.abs(due)[counts]).max() < 1e-7
        assert (off / largest).max() < 1e-11


# ---------------------------------------------------------------- balance of energy


def energy(vehicle, state, u):
    context = vehicle.context(state, u)
    n = context.n
    w = vehicle.full_velocities(context)
    return kinetic_energy(n, context.shape, w) + potential_energy(context)


def power(vehicle, state, u):
    """What drives take in less their heat; what contacts and rolling resistance take away."""
    context = vehicle.context(state, u)
    n = context.n
    robot, w = vehicle.robot, vehicle.full_velocities(context)
    shape, shafts = context.shape, w[2 + len(n.bodies) :]
    total, lost = 0.0, 0.0
    for i, drive in enumerate(robot.drives):
        speed = drive_speeds(n, shafts)[i]
        total += drive.motor.power_in(u[i], speed)
        lost += drive.motor.heat(u[i], speed)
    slips = isinstance(vehicle, Slipping)
    loads, forces = vehicle.wheel_forces(context) if slips else (wheel_loads(n), None)
    if slips:  # a wheel that would lift has no contact
        loads = [jnp.maximum(load, 0.0) for load in loads]
    twists = twists_of(n, shape, w)
    for i, (wheel, (c, s)) in enumerate(zip(n.wheels, shape.wheels, strict=True)):
        roll = wheel.radius * shafts[wheel.shaft]
        drag = robot.resistance.torque(loads[i], wheel.radius, roll) * shafts[wheel.shaft]
        lost -= drag
        if slips:
            along, across = contact_velocity(n, shape, twists, i)
            across = 0.0 if wheel.kind == "caster" else across
            (x, y) = forces[i]
            lost -= (c * x + s * y) * (along - roll) + (c * y - s * x) * across
    return jnp.stack([total - lost, lost])


def balance(vehicle, control, seconds: float, twist):
    """E at both ends and the integrals of `power`, by one adaptive solution of all."""
    start = wheeled.start(vehicle, twist=twist)

    def rate(t, y, _):
        state, u = y[0], control(t)
        context = vehicle.context(state, u)
        return as_state(*vehicle.rates(context), state.q.dtype), power(vehicle, state, u)

    def solved(start):
        out = diffrax.diffeqsolve(
            diffrax.ODETerm(rate), diffrax.Dopri8(), 0.0, seconds, None, (start, jnp.zeros(2)),
            stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12), max_steps=200_000,
            adjoint=diffrax.ForwardMode(),
        )  # fmt: skip
        end, work = jax.tree.map(lambda x: x[-1], out.ys)
        return energy(vehicle, start, control(0.0)), energy(vehicle, end, control(seconds)), work

    return map(np.asarray, jax.jit(solved, compiler_options=compiler_options())(start))


MOTORS = {
    "dc": DCMotor(0.5, 0.05, gear=20.0, battery=24.0, friction=0.01, rotor_inertia=2e-4),
    "servo": SpeedServo(0.4, 2.0),
}
TYRE = LAWS["fiala, two"].replace(smooth_speed=jnp.asarray(0.5))
BALANCES = [
    ("differential_drive", "reduced", "dc"),
    ("tricycle", "quasi_velocities", "dc"),
    ("car", "dynamical", "servo"),
    ("mecanum", "reduced", "servo"),
    ("car_trailer", "reduced", "dc"),
    ("differential_drive", "slipping", "dc"),
    ("bicycle", "slipping", "servo"),
    ("omni_3", "slipping", "dc"),
    ("skid_steer", "slipping", "dc"),
    ("tractor_trailers", "slipping", "servo"),
]


@pytest.mark.parametrize(
    ("kind", "fidelity", "motor"),
    [x if i == 0 else pytest.param(*x, marks=slow) for i, x in enumerate(BALANCES)],
)
def test_energy_along_a_motion(kind, fidelity, motor) -> None:
    """With motors, rolling resistance, a slope, steering to and fro, and slip."""
    robot = KINDS[kind].make(motor=MOTORS[motor])
    # what turns wheels of Ackermann's geometry unevenly does work on their yaw_inertia
    still = [w.replace(yaw_inertia=0.0) if w.kind == "steered" else w for w in robot.wheels]
    robot = robot.replace(wheels=tuple(still), resistance=RollingResistance(0.02, 0.2),
                          slope=[0.06, -0.04])  # fmt: skip
    options = {"tyre": TYRE} if fidelity == "slipping" else {}
    vehicle = wheeled.at(robot, fidelity, **options)
    size, count = (12.0 if motor == "dc" else 8.0), len(robot.drives)

    def control(t):
        driving = [size * (1 + 0.5 * jnp.sin(2 * t + i)) for i in range(count)]
        return jnp.stack([*driving, *[0.3 * jnp.cos(2 * t)] * len(robot.steerings)])

    before, after, (work, lost) = balance(vehicle, control, 2.0, [0.5, 0.0, 0.1])
    assert lost > 1e-3 * abs(after) and abs(after - before) > 1e-2 * abs(after)
    scale = max(abs(before), abs(after), lost)
    assert abs(after - before - work) < 1e-9 * scale


# ---------------------------------------------------------------- rows over a million steps

A_MILLION = {"steps": 1_000_000, "save_every": 100_000}


def to_and_fro(t, state):
    return 0.05 * jnp.stack([jnp.sin(t), -jnp.cos(0.7 * t)])


@slow
@pytest.mark.parametrize("fidelity", ["reduced", "constrained"])
def test_rows_hold_over_a_million_steps(fidelity) -> None:
    """Reduced velocities cannot leave the rows; those of all bodies are put back on them."""
    vehicle = wheeled.at(KINDS["differential_drive"].make(caster=None), fidelity)
    start = wheeled.start(vehicle, twist=[0.5, 0.0, 0.4])
    # closed over, so that the robot's zeros vanish: a tenth of the time
    run = jax.jit(
        lambda x: wheeled.rollout(vehicle, x, to_and_fro, 1e-3, **A_MILLION),
        compiler_options=compiler_options(),
    )
    path = run(start)
    assert path.success and np.abs(np.diff(path.q[:, :2], axis=0)).max() > 1.0
    off = 0.0
    for state in map(path.state, range(11)):
        context = vehicle.context(State(state.q, state.v))
        n = context.n
        found = constraint_rates(n, context.shape, vehicle.full_velocities(context))
        off = max(off, np.abs(np.array(found, float)).max())
        if fidelity == "constrained":  # v as it is kept
            found = constraint_rates(n, context.shape, context.v)
            off = max(off, np.abs(np.array(found, float)).max())
    assert off < (1e-15 if fidelity == "reduced" else 1e-12)


@slow
def test_rows_of_the_model_hold_over_a_million_steps() -> None:
    model = wheeled.full_model(KINDS["differential_drive"].make(caster=None))
    rolling = np.array([0.5 + 0.4 * 0.2, 0.5 - 0.4 * 0.2]) / 0.08
    start = State(jnp.zeros(5), jnp.array([0.5, 0.0, 0.4, *rolling]))
    path = rb.rollout(model, start, to_and_fro, 1e-3, integrator="rk4", **A_MILLION)
    assert path.success
    off = [rb.constraints.residual(model, path.state(i))[1] for i in range(11)]
    assert np.abs(off).max() < 1e-12
