"""Wheeled robots in optimal control: the steps of `rollout`, and optima that are known."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import control, wheeled
from rbjax.control.optimal.shooting.expansion import read_columns
from rbjax.errors import InputError, UnknownName
from tests.tolerances import F64_TRANSFORM, GRADIENT, relative_error

KINDS = wheeled.kinds()
DT, PARTS = 0.03, 3


@functools.cache
def vehicle(name: str) -> wheeled.RobotModel:
    if name == "wheels that relax":
        car = KINDS["bicycle"].make(motor=wheeled.SpeedServo(500.0), lag=0.1)
        tyre = wheeled.Relaxing(wheeled.Fiala(15.0, 0.9, smooth_speed=1.0), 0.3)
        return wheeled.at(car, "slipping", tyre=tyre)
    if name == "no velocities":
        return wheeled.at(KINDS["bicycle"].make(motor=wheeled.SpeedServo(1.0)), "kinematic")
    return wheeled.at(KINDS["differential_drive"].make(caster=None), "reduced")


EVERY = pytest.mark.parametrize("name", ["wheels that relax", "no velocities", "cart"])


def duals(name: str):
    """A system, a state in motion, and three rows of controls."""
    one = vehicle(name)
    method = "linearly_implicit_euler" if one.nx else "rk4"
    start = wheeled.start(one, pose=[0.3, -0.2, 7.0], twist=[4.0, 0.0, 0.1])
    rng = np.random.default_rng(0)
    u = jnp.asarray(rng.uniform(0.05, 0.2, (3, one.nu)))
    if one.nx:
        start = start.replace(x=jnp.asarray(rng.uniform(0.01, 0.02, one.nx)))
    if name != "cart":
        u = u.at[:, 0].add(14.0)  # rad/s
    return wheeled.controlled(one, integrator=method, parts=PARTS), start, u


@EVERY
def test_steps_are_those_of_rollout(name) -> None:
    system, start, u = duals(name)

    def both(start, u):
        states = [start]
        for k in range(3):
            states.append(system.step(k * DT, states[-1], u[k], DT))
        path = wheeled.rollout(
            system.model, start, jnp.repeat(u, PARTS, 0), DT / PARTS, integrator=system.integrator,
            save_every=PARTS,
        )  # fmt: skip
        return jax.tree.map(lambda *x: jnp.stack(x), *states), rb.State(path.q, path.v, path.x)

    ours, due = jax.jit(both)(start, u)
    assert relative_error(ours.q[-1], start.q) > 0.01  # it moves
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(due), strict=True):
        assert relative_error(one, other) < F64_TRANSFORM


@EVERY
def test_derivatives_of_a_step_are_its_differences(name) -> None:
    system, start, u = duals(name)

    def both(start, u):
        def at(d):
            return system.step(0.0, system.plus(start, d[: system.n]), u + d[system.n :], DT)

        def slopes(h):
            d = h * jnp.eye(system.n + system.nu)
            return jax.vmap(system.minus)(jax.vmap(at)(d), jax.vmap(at)(-d)).T / (2 * h)

        found = system.linear(0.0, start, u, DT)
        without_h2 = (4 * slopes(1e-5) - slopes(2e-5)) / 3
        return jnp.concatenate([found.A, found.B], 1), without_h2

    found, due = jax.jit(both)(start, u[0])
    assert found.shape == (system.n, system.n + system.nu)
    assert relative_error(found, due) < GRADIENT


@EVERY
def test_what_a_cost_reads_is_expanded_only(name) -> None:
    """The columns of velocities are q's neighbours, with or without states of tyres."""
    one = vehicle(name)
    problem = control.Problem(one, 2, DT, running=[control.Control()])
    n, nq, nv = problem.n, one.nq, one.nv
    for part, due in (
        (lambda k, knot, u: knot.state.v, range(nq, nq + nv)),
        (lambda k, knot, u: knot.state.q * u[0], [*range(nq), *range(n, n + one.nu)]),
    ):
        np.testing.assert_array_equal(read_columns(problem, part), due)


def test_an_error_of_a_state_is_a_difference_of_all_numbers() -> None:
    """A heading of 7 is not one of 7 - 2 pi."""
    system, start, u = duals("wheels that relax")
    turned = start.replace(q=start.q.at[2].add(-2 * np.pi))
    for reference in (turned, rb.State(turned.q, turned.v)):
        off = control.StateError(reference)(system.model, 0.0, start, u[0])
        due = np.zeros(system.n)
        due[2] = 2 * np.pi
        np.testing.assert_allclose(off, due, atol=1e-14)


def test_motors_with_a_battery_have_a_range() -> None:
    motor = wheeled.DCMotor(2.0, 0.05, gear=20.0, battery=12.0)
    robot = KINDS["bicycle"].make(motor=motor)
    system = wheeled.controlled(wheeled.at(robot, "reduced"))
    low, high = system.ctrl_range
    np.testing.assert_array_equal(low, [-36.0, -np.inf])
    np.testing.assert_array_equal(high, [36.0, np.inf])
    assert float(motor.torque(36.0, 0.0)) > 0.99 * float(motor.torque(1e4, 0.0))
    problem = control.Problem(system, 2, DT, running=[control.Control()])
    assert problem.bounded and float(problem.high[0]) == 36.0


def test_bad_arguments_are_named() -> None:
    with pytest.raises(InputError, match="expected a robot at a fidelity"):
        wheeled.controlled(KINDS["bicycle"].make())
    with pytest.raises(UnknownName, match="euler"):
        wheeled.controlled(vehicle("cart"), integrator="euler")
    with pytest.raises(InputError, match="parts"):
        wheeled.controlled(vehicle("cart"), parts=0)
    with pytest.raises(InputError, match="a design gave"):
        wheeled.controlled(vehicle("cart")).with_model(3.0)
    problem = control.Problem(vehicle("cart"), 2, DT, running=[control.Control()])
    with pytest.raises(InputError, match=r"state\.q"):
        control.solve(problem, rb.State(jnp.zeros(3), jnp.zeros(2)))


@pytest.mark.slow
def test_three_omni_wheels_take_the_least_torques_of_a_closed_form() -> None:
    """Straight ahead the robot is a mass: the heading stays 0 by symmetry, steps of rk4 are exact,
    and the least squares of torques that give a force F are F r (-sin a) / (3/2)."""
    robot, steps, h = KINDS["omni_3"].make(), 20, 0.1
    omni = wheeled.at(robot, "reduced")
    goal = jnp.array([1.0, 0.0, 0.0])
    problem = control.Problem(
        omni, steps, h, running=[control.Control()],
        terminal=[
            control.Cost(lambda t, state, ctrl: state.q[:3] - goal, 1e3),
            control.Cost(control.Velocity(), 1e2),
        ],
    )  # fmt: skip
    found = control.solve(problem, wheeled.start(omni))

    wheel, angles = robot.wheels[0], 2 * np.pi * np.arange(3) / 3
    r = float(wheel.radius)
    mass = float(robot.bodies[0].mass + 3 * wheel.mass + 1.5 * wheel.inertia / r**2)
    A, b = np.array([[1, h], [0, 1]]), np.array([h * h / 2, h]) / mass
    G = np.stack([np.linalg.matrix_power(A, steps - 1 - k) @ b for k in range(steps)], 1)
    W, R = np.diag([1e3, 1e2]), h * r**2 / 1.5 * np.eye(steps)
    F = np.linalg.solve(R + G.T @ W @ G, G.T @ W @ [1.0, 0.0])
    off = G @ F - [1.0, 0.0]
    assert found.success
    np.testing.assert_allclose(found.cost, (F @ R @ F + off @ W @ off) / 2, rtol=1e-10)
    np.testing.assert_allclose(found.ctrl, F[:, None] * r * -np.sin(angles) / 1.5, atol=1e-9)


@pytest.mark.slow
def test_a_cart_parks_at_an_optimum_by_its_mass_too() -> None:
    """Sideways, which no wheel allows at once. The gradient by the mass, a number of the design,
    is that of `rollout` with the controls held."""
    cart, steps, h = vehicle("cart"), 40, 0.1
    start = wheeled.start(cart, pose=[0.5, 0.6, 0.3])
    problem = control.Problem(
        cart, steps, h, running=[control.Control()],
        terminal=[
            control.Cost(lambda t, state, ctrl: state.q[:3], 1e3),
            control.Cost(control.Velocity(), 1e2),
        ],
    )  # fmt: skip
    found = control.solve(problem, start)
    assert found.success
    cost, path = _cost_and_path(cart, start, found.ctrl, h)
    np.testing.assert_allclose(found.cost, cost, rtol=1e-12)
    assert relative_error(found.states.q, path.q) < F64_TRANSFORM
    assert np.abs(path.q[-1, :3]).max() < 1e-3 and np.abs(path.v[-1]).max() < 1e-2
    slope = jax.grad(lambda u: _cost_and_path(cart, start, u, h)[0])
    assert np.abs(slope(found.ctrl)).max() < 1e-6 * np.abs(slope(jnp.zeros((steps, 2)))).max()


def _cost_and_path(cart, start, u, h):
    path = wheeled.rollout(cart, start, u, h)
    end = 1e3 * (path.q[-1, :3] ** 2).sum() + 1e2 * (path.v[-1] ** 2).sum()
    return 0.5 * (h * (u * u).sum() + end), path


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ddp", "exact_ddp"])
def test_a_car_that_slips_changes_lanes_as_by_quasi_newton_shooting(method) -> None:
    """SciPy's BFGS on the controls, with gradients through `rollout`, from the same start."""
    import scipy.optimize

    robot = KINDS["bicycle"].make(motor=wheeled.SpeedServo(2000.0), lag=0.1)
    car = wheeled.at(robot, "slipping", tyre=wheeled.Fiala(15.0, 0.9, smooth_speed=1.0))
    implicit, parts, steps, h = "linearly_implicit_euler", 5, 40, 0.05
    start = wheeled.start(car, twist=[15.0, 0.0, 0.0])
    begin = jnp.tile(jnp.array([50.0, 0.0]), (steps, 1))

    def path_of(u):
        return wheeled.rollout(
            car, start, jnp.repeat(u, parts, 0), h / parts, integrator=implicit, save_every=parts
        )

    def cost_of(u):
        path = path_of(u)
        running = ((u[:, 0] - 50) / 10) ** 2 + (10 * u[:, 1]) ** 2 + (path.v[:-1, 0] - 15) ** 2
        q, v = path.q[-1], path.v[-1]
        end = 100 * ((q[1] - 3) ** 2 + q[2] ** 2) + 10 * (v[1:3] ** 2).sum()
        return (h * running.sum() + end) / 2

    C = control.Cost
    problem = control.Problem(
        wheeled.controlled(car, integrator=implicit, parts=parts), steps, h,
        running=[
            lambda t, state, ctrl: jnp.stack([(ctrl[0] - 50) / 10, 10 * ctrl[1]]),
            lambda t, state, ctrl: state.v[:1] - 15,
        ],
        terminal=[
            C(lambda t, state, ctrl: jnp.stack([state.q[1] - 3, state.q[2]]), 100.0),
            C(lambda t, state, ctrl: state.v[1:3], 10.0),
        ],
    )  # fmt: skip
    found = control.solve(problem, start, ctrl=begin, method=method)
    assert found.success
    path = path_of(found.ctrl)
    for one, other in ((found.states.q, path.q), (found.states.v, path.v)):
        assert relative_error(one, other) < F64_TRANSFORM
    slope = jax.jit(jax.value_and_grad(lambda z: cost_of(z.reshape(steps, 2))))
    value, gradient = slope(found.ctrl.ravel())
    np.testing.assert_allclose(found.cost, value, rtol=1e-12)
    assert np.abs(gradient).max() < 1e-7 * np.abs(slope(begin.ravel())[1]).max()
    peer = scipy.optimize.minimize(
        lambda z: [np.asarray(x, float) for x in slope(z)], begin.ravel(), jac=True,
        method="BFGS", options={"gtol": 1e-7, "maxiter": 3000},
    )  # fmt: skip
    assert float(found.cost) < peer.fun * (1 + 1e-6)
    np.testing.assert_allclose(path.q[-1, 1], 3.0, atol=0.01)
