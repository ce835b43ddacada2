"""Optimal control by samples: splines, costs, optima, seeds, penalties, bad input."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import Constraint, Control, Cost, Equations, Problem, Sampling
from rbjax.control.optimal.shooting.sampling import Draw, control_at, sampled_cost, sampled_motion
from rbjax.control.status import FINISHED, NOT_FINITE

N, H = 6, 0.5


@functools.cache
def line():
    """The problem without changes: one program for all that solve it alike."""
    return mass_on_a_line()


def mass_on_a_line(**more):
    """x'' = u from rest at 1 to 0, in few steps."""
    f = lambda t, x, u: jnp.stack([x[0] + H * x[1] + 0.5 * H * H * u[0], x[1] + H * u[0]])  # noqa: E731
    end = lambda t, x, u: 2.0 * x  # noqa: E731
    given = {"running": [Control()], "terminal": [end], "bounds": (-1.0, 1.0)} | more
    return Problem(Equations(f, 2, 1, discrete=True), N, H, **given)


def best_cost():
    """The optimum of `mass_on_a_line` by dense least squares, whose controls are in the bounds."""
    A, B = np.array([[1, H], [0, 1.0]]), np.array([H * H / 2, H])
    G = np.stack([np.linalg.matrix_power(A, N - 1 - k) @ B for k in range(N)], 1)
    free = np.linalg.matrix_power(A, N) @ [1.0, 0.0]
    J = np.concatenate([np.sqrt(H) * np.eye(N), 2 * G])
    r = np.concatenate([np.zeros(N), 2 * free])
    u = np.linalg.lstsq(J, -r, rcond=None)[0]
    assert np.abs(u).max() < 1
    return 0.5 * ((J @ u + r) ** 2).sum()


START = jnp.array([1.0, 0.0])
SMALL = {"samples": 64, "points": N, "spline": "hold"}


@pytest.mark.parametrize("spline", ["hold", "linear", "cubic"])
def test_a_spline_goes_through_its_points(spline):
    """With as many points as knots: all of them; between two, the line, the nearest, the cubic."""
    points = jnp.asarray(np.random.default_rng(0).normal(size=(5, 2)))
    how = Sampling(spline=spline)
    at = lambda k, horizon: np.asarray(control_at(how, points, jnp.asarray(float(k)), horizon))  # noqa: E731
    for k in range(5):
        assert np.abs(at(k, 5) - points[k]).max() < 1e-15
        assert np.abs(at(4 * k, 17) - points[k]).max() < 1e-15
    p = np.asarray(points)
    quarter = at(5, 17)  # a quarter from point 1 to point 2
    if spline == "hold":
        want = p[1]
    elif spline == "linear":
        want = 0.75 * p[1] + 0.25 * p[2]
    else:  # Catmull & Rom 1974, in their matrix form
        t = 0.25
        M = 0.5 * np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]])
        want = np.array([1, t, t * t, t**3]) @ M @ p[0:4]
    assert np.abs(quarter - want).max() < 1e-14
    assert np.abs(np.asarray(control_at(how, points[:1], jnp.asarray(3.0), 9)) - p[0]).max() == 0


def test_the_cost_of_a_draw_is_that_of_its_motion():
    """Rolled by hand, with the penalty of a constraint that is not held."""
    problem = mass_on_a_line(constraints=[Constraint(lambda t, x, u: x[1], -0.1, 0.1, name="v")])
    how = Sampling(**SMALL, penalty=7.0)
    u = np.linspace(-0.8, 0.9, N)
    draw = Draw(jnp.asarray(u)[:, None], jnp.zeros(0), jnp.zeros(2))
    cost = jax.jit(lambda draw: sampled_cost(how, problem, START, draw))(draw)
    x, want = np.array([1.0, 0.0]), 0.0
    for k in range(N):
        off = max(abs(x[1]) - 0.1, 0.0)
        want += 0.5 * H * u[k] ** 2 + 3.5 * off**2
        x = np.array([x[0] + H * x[1] + 0.5 * H * H * u[k], x[1] + H * u[k]])
    want += 2 * (x @ x)
    assert abs(cost - want) < 1e-12 * want
    knots, us = jax.jit(lambda draw: sampled_motion(how, problem, START, draw))(draw)
    assert np.abs(knots.state[-1] - x).max() < 1e-14 and np.abs(us[:, 0] - u).max() == 0


def test_cross_entropy_finds_the_optimum():
    """To 1e-6 of dense least squares; it says that it has finished, not that it has converged."""
    found = rb.control.solve(
        line(), START, method=Sampling("cross_entropy", **SMALL | {"samples": 200}),
        iterations=150, tolerance=1e-12,
    )  # fmt: skip
    assert found.status == FINISHED and not found.success and found.gap == 0
    assert found.summary().startswith("finished")
    assert 0 <= found.cost / best_cost() - 1 < 1e-6
    costs = found.costs[np.isfinite(found.costs)]
    assert (np.diff(costs) <= 0).all() and len(costs) == found.iterations


@pytest.mark.parametrize(
    "update, within", [("mppi", 1e-3), pytest.param("predictive", 1e-2, marks=pytest.mark.slow)]
)
def test_samples_come_near(update, within):
    """One seed gives one motion, another one another, and `vmap` tries many."""
    method = Sampling(update, **SMALL, cooling=0.93)

    def ask(seed):
        return rb.control.solve(line(), START, method=method, iterations=80, seed=seed)

    one, same, other = ask(1), ask(1), ask(2)
    assert 0 <= one.cost / best_cost() - 1 < within
    assert (jnp.abs(one.ctrl) <= 1).all()
    assert (one.ctrl == same.ctrl).all() and (one.ctrl != other.ctrl).any()
    many = jax.vmap(lambda seed: ask(seed).cost)(jnp.arange(1, 3))
    assert np.abs(many - jnp.stack([one.cost, other.cost])).max() < 1e-12


def test_bounds_that_bind():
    problem = mass_on_a_line(bounds=(-0.3, 0.2))
    method = Sampling("cross_entropy", **SMALL)
    found = rb.control.solve(problem, START, method=method, iterations=30)
    assert found.ctrl.min() >= -0.3 and found.ctrl.max() <= 0.2
    assert found.ctrl.min() < -0.2999


@pytest.mark.slow
def test_ddp_from_a_sampled_start():
    method = Sampling("mppi", **SMALL, ddp_after=3)
    found = rb.control.solve(line(), START, method=method)
    assert found.success and abs(found.cost / best_cost() - 1) < 1e-9
    assert "sampled_ddp" in rb.control.methods()


def test_a_cost_of_nan_is_named():
    problem = mass_on_a_line(terminal=[lambda t, x, u: jnp.nan * x[0]])
    found = rb.control.solve(problem, START, method=Sampling(**SMALL), iterations=2)
    assert found.status == NOT_FINITE


def test_numbers_and_free_starts_are_drawn():
    """A free final time, and a free first velocity."""
    problem = mass_on_a_line(
        running=[Cost(Control(), 0.0)], terminal=[lambda t, x, u: x - 2.0 - 0.0 * t],
        free_time=(1.0, 4.0), free_start=np.array([False, True]),
    )  # fmt: skip
    method = Sampling("cross_entropy", **SMALL)
    found = rb.control.solve(problem, START, method=method, iterations=30)
    assert found.states[0, 0] == 1.0 and found.states[0, 1] != 0.0
    assert 1.0 <= found.duration <= 4.0 and found.cost < 0.1


def test_the_acrobot_is_spongs():
    """M, gravity and energy of *The swing up control problem for the acrobot*, 1995."""
    model = rb.load("acrobot")
    m1 = m2 = l1 = 1.0
    c1, c2, I1, I2, g = 0.5, 1.0, 0.083, 0.33, 9.8
    a, b = 0.4, -0.9
    d11 = m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2 * np.cos(b)) + I1 + I2
    d12 = m2 * (c2**2 + l1 * c2 * np.cos(b)) + I2
    M = [[d11, d12], [d12, m2 * c2**2 + I2]]
    q = jnp.array([a, b])
    assert np.abs(rb.mass_matrix(model, q) - np.array(M)).max() < 1e-13
    low = m2 * c2 * g * np.sin(a + b)
    want = [(m1 * c1 + m2 * l1) * g * np.sin(a) + low, low]
    assert np.abs(rb.gravity_forces(model, q) - np.array(want)).max() < 1e-13
    assert model.nu == 1 and model.keyframe_names == ("down", "up")


@pytest.mark.slow
@pytest.mark.parametrize("name, share", [("cart_pole", 0.95), ("acrobot", 0.5)])
def test_swing_ups_at_the_first_try(name, share):
    from benchmarks.shared import swing_up

    row = swing_up.run(swing_up.tasks()[name], 20, 20, attempts=1)
    assert row["solved"] >= share, row["failures"]


@pytest.mark.slow
def test_mujoco_swings_up_too():
    """The controls of an acrobot's swing-up, rolled by MuJoCo C, end where the solution does."""
    from benchmarks.shared import swing_up

    task = swing_up.tasks()["acrobot"]
    state = rb.State(task.hanging, jnp.zeros(2))
    found = rb.control.solve(
        task.problem, state, method=swing_up.METHOD, iterations=300, tolerance=1e-7, seed=3
    )
    path = Path(rb.loading.__file__).parent / "scenes" / "acrobot.xml"
    robot = mujoco.MjModel.from_xml_path(str(path))
    robot.opt.timestep, robot.opt.disableflags = 0.025, mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(robot)
    data.qpos[:] = state.q
    for u in np.asarray(found.ctrl):
        data.ctrl[:] = u
        mujoco.mj_step(robot, data)
    assert np.abs(data.qpos - found.states.q[-1]).max() < 1e-8
    assert np.abs(data.qvel - found.states.v[-1]).max() < 1e-8


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_ddp_from_samples_obeys_the_seed(dtype):
    """Of a cost with many valleys few samples find different ones; the same seed the same one."""
    with jax.enable_x64(dtype == "float64"):
        line = rb.control.Equations(lambda t, x, u: u, 1, 1)
        wave = jnp.asarray(6.0)  # a number that the cost closes over

        def valleys(t, x, u):
            return jnp.cos(wave * x[0]) + 0.01 * (x[0] - 0.2) ** 2

        problem = rb.control.Problem(
            line, 5, 0.4, running=[rb.control.Cost(rb.control.Control(), 1e-3)],
            terminal=[valleys], bounds=(-2.0, 2.0),
        )  # fmt: skip
        method = Sampling("predictive", samples=10, points=1, spread=0.6, ddp_after=1)
        start = jnp.zeros(1)
        ends = [float(rb.control.solve(problem, start, method=method, seed=k).states[-1, 0])
                for k in (0, 0, 1, 2, 3, 4, 5)]  # fmt: skip
        assert ends[0] == ends[1]
        assert len({round(x, 2) for x in ends}) > 1
