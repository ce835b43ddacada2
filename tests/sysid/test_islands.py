"""Parts of a robot that do not act on each other: several numbers in one direction, equal parts
side by side, against the whole robot in one piece."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import PD, Derived, Grid, Setup, Tilt, Unknown
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation.equal_parts import equal_parts
from rbjax.sysid.simulation.jacobian_colouring import ALL, colour_jacobian, independent_parts
from rbjax.sysid.simulation.runs import Run
from rbjax.sysid.simulation.setup import read_sensor, simulate_motion
from rbjax.sysid.simulation.simulation_error import SimulationError, state_of_readings

GRID = Grid(0.01, 2, "rk4", 3)
N = 12


def leg(name: str, side: float, calf: bool = True) -> str:
    below = (
        f'<body name="{name}calf" pos="0 0 -.2"><joint name="{name}knee" axis="0 1 0"/>'
        '<inertial pos="0 0 -.1" mass=".4" diaginertia="2e-3 2e-3 1e-4"/></body>'
    )
    return (
        f'<body name="{name}thigh" pos=".1 {side} 0"><joint name="{name}hip" axis="1 0 0"/>'
        f'<inertial pos="0 {side} -.1" mass="1" diaginertia="4e-3 3e-3 2e-3"/>'
        f"{below if calf else ''}</body>"
    )


def robot(*legs: str) -> rb.Model:
    names = [n for text in legs for n in text.split('joint name="')[1:]]
    motors = "".join(f'<motor joint="{n.split(chr(34))[0]}"/>' for n in names)
    with warnings.catch_warnings(action="ignore"):
        model = rb.load(
            '<mujoco><worldbody><body name="base" pos="0 0 1">'
            '<inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>'
            f"{''.join(legs)}</body></worldbody><actuator>{motors}</actuator></mujoco>"
        )
    n = model.nv
    joints = model.joints.replace(
        armature=0.01 + 0.002 * np.arange(n), damping=0.2 + 0.05 * np.arange(n)
    )
    dry = rb.forces.JointFriction.of(
        model, model.joint_names, coulomb=0.1 + 0.01 * np.arange(n), smoothing=0.05
    )
    return model.replace(joints=joints).with_forces(dry)


def problem(model: rb.Model) -> tuple[Setup, dict, Run]:
    n = model.nv
    setup = Setup.of(model, PD(jnp.full(n, 20.0), jnp.full(n, 1.5)), delay=0.013)
    sought = {
        "armature": Unknown("joints.armature", positive=True),
        "dry": Unknown("forces.0.coulomb", positive=True),
        "bias": Unknown("sensors.q.bias"), "delay": Unknown("delay"),
        "mass": Unknown("bodies.mass", positive=True),
    }  # fmt: skip
    rng = np.random.default_rng(0)
    t = jnp.arange(N + 1) * 0.01
    draw = [rng.normal(size=(1, N + 1, n)) for _ in range(2)]
    seen = {"q": jnp.asarray(draw[0]), "v": jnp.asarray(draw[1])}
    start = rb.State(seen["q"][:, 0] * 0.1, seen["v"][:, 0])
    commands = jnp.asarray(rng.normal(size=(1, N, n)))
    times = dict.fromkeys(seen, t[None])
    weights = {k: jnp.full_like(x, 1.5) for k, x in seen.items()}
    return setup, sought, Run(start, commands, times, seen, weights)


def in_one_piece(setup: Setup, of: Unknowns, run: Run, x: jax.Array) -> jax.Array:
    """The residual of the whole robot."""
    n, nv = sum(of.sizes), setup.model.nv
    now = of.write(setup, x[:n])
    first = state_of_readings(now, jax.tree.map(lambda a: a[0], run.start), True)
    first = rb.State(first.q + x[n : n + nv], first.v + x[n + nv :])
    path = simulate_motion(lambda p: of.write(setup, p), x[:n], first, run.commands[0], GRID)
    off = [read_sensor(now, path, GRID, k, run.times[k][0]) - run.values[k][0] for k in "qv"]
    return 1.5 * jnp.concatenate([a.ravel() for a in off])


def check(model: rb.Model) -> SimulationError:
    setup, sought, run = problem(model)
    of = Unknowns.of("test", sought, setup)
    error = SimulationError(setup, of, run, GRID, estimate_initial_state=True)
    x = np.append(of.read(setup), 0.01 * np.random.default_rng(1).normal(size=2 * model.nv))
    r, J = error.slopes(x)
    whole = jax.jit(lambda x: in_one_piece(setup, of, run, x))
    want = np.asarray(jax.jit(jax.jacfwd(whole))(x))
    np.testing.assert_allclose(r[0], whole(x), atol=1e-12)
    np.testing.assert_allclose(J[0], want, atol=1e-10 * np.abs(want).max())
    np.testing.assert_allclose(error.residuals(x), r, atol=1e-12)
    A = np.append(want, r[0][:, None], 1)
    R = error.triangle(x)
    np.testing.assert_allclose(R.T @ R, A.T @ A, atol=1e-12 * np.abs(A.T @ A).max())
    return error


@pytest.mark.slow
def test_equal_legs():
    error = check(robot(leg("l", 0.1), leg("r", -0.1)))
    assert len(equal_parts(error.setup)) == 2
    # two armatures, frictions, biases, masses and four numbers of the start; base mass and delay
    assert error.colouring.seeds.shape == (2 * 4 + 4 + 2, 4 * 4 + 8 + 2)


@pytest.mark.slow
def test_legs_of_different_shapes():
    error = check(robot(leg("l", 0.1), leg("r", -0.1, calf=False)))
    assert equal_parts(error.setup) is None
    assert error.colouring.seeds.shape[0] == 14


def test_whose_numbers_are_whose():
    model = robot(leg("l", 0.1), leg("r", -0.1))
    setup = Setup.of(model, delay=0.0)
    pair = jnp.array([model.body("lthigh"), model.body("rthigh")])

    def both(setup: Setup, p: jax.Array) -> Setup:  # the second moves nothing where the first is 0
        bodies = setup.model.bodies
        mass = bodies.mass.at[pair].add(p[0] * jnp.array([1.0, p[1]]))
        return setup.replace(model=setup.model.replace(bodies=bodies.replace(mass=mass)))

    sought = {
        "one": Unknown("bodies.mass", model.body("rthigh"), positive=True),
        "two": Derived((0.0, 0.0), both), "tilt": Tilt(),
    }  # fmt: skip
    found = colour_jacobian(setup, Unknowns.of("test", sought, setup), 0, "q")
    right = independent_parts(setup)[model.joint("rhip")]
    assert list(found.part_of_unknown) == [right, ALL, right, ALL, ALL]


def test_corrections_of_the_start_are_those_of_their_joints():
    setup = Setup.of(robot(leg("l", 0.1, calf=False), leg("r", -0.1, calf=False)))
    parts = [*independent_parts(setup)]
    assert len({*parts}) == 2
    bias = Unknowns.of("test", {"bias": Unknown("sensors.q.bias")}, setup)

    def found(x: jax.Array) -> jax.Array:
        colouring = colour_jacobian(setup, bias, 2 * setup.model.nv, "q")  # of q and v
        assert list(colouring.part_of_unknown) == parts * 3
        return x

    for run in (lambda f: f, jax.make_jaxpr):  # also while a program is traced
        run(found)(0.0)


def test_what_is_one_part():
    two = robot(leg("l", 0.1), leg("r", -0.1))
    assert independent_parts(Setup.of(two)) is not None
    assert independent_parts(Setup.of(robot(leg("l", 0.1)))) is None
    assert independent_parts(Setup.of(two, lambda t, reading, command: command)) is None
    held = rb.forces.GravityCompensation(jnp.ones(two.nb), two.body_names)  # by its bodies
    assert independent_parts(Setup.of(two.with_forces(held))) is None
    names = two.joint_names[::2]
    geared = two.with_constraints(rb.constraints.Gear(*names, -1.0))
    assert independent_parts(Setup.of(geared)) is None
    setup, sought, _ = problem(two)
    of = Unknowns.of("test", sought, setup)
    assert colour_jacobian(setup, of, 0, ("q", "gyro:tool")) is None
