"""Constraints by the augmented Lagrangian: closed forms, limits along the path, obstacles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import (
    Capsule,
    Clearance,
    Configuration,
    Constraint,
    Control,
    Cost,
    Equations,
    HalfSpace,
    Problem,
    Sphere,
    StateError,
    Velocity,
    solve,
)
from rbjax.control.status import CONVERGED, INFEASIBLE, STUCK
from rbjax.errors import InputError


def rest_to_rest(n):
    """x'' = u over a distance 1 in a time 1: J = h sum u^2 = 12 n^2 / (n^2 - 1)."""
    h = 1.0 / n

    def step(t, x, u):
        v = x[1] + h * u[0]
        return jnp.stack([x[0] + h * v, v])

    goal = jnp.asarray([1.0, 0.0])
    there = Constraint(lambda t, x, u: x - goal, where="end", name="there")
    return Problem(
        Equations(step, 2, 1, discrete=True), n, h, running=[Cost(Control(), 2.0)],
        constraints=[there],
    )  # fmt: skip


@pytest.mark.parametrize("n", [10, pytest.param(20, marks=pytest.mark.slow),
                               pytest.param(50, marks=pytest.mark.slow)])  # fmt: skip
def test_rest_to_rest_costs_what_the_closed_form_says(n):
    s = solve(rest_to_rest(n), jnp.zeros(2), violation=1e-11, tolerance=1e-14)
    assert s.success
    np.testing.assert_allclose(s.cost, 12 * n**2 / (n**2 - 1), rtol=1e-9)
    np.testing.assert_allclose(np.diff(s.ctrl[:, 0], 2), 0.0, atol=1e-7)  # linear in time
    np.testing.assert_allclose(s.ctrl[0, 0], -s.ctrl[-1, 0], rtol=1e-8)


@pytest.mark.slow
def test_limits_of_joints_and_speeds_are_held_along_the_path():
    model = rb.load("pendulum")
    rest = model.default_state()
    goal = rb.State(rest.q + 1.0, rest.v)
    problem = Problem(
        model, 30, 0.05, running=[Cost(Control(), 1e-3)], terminal=[Cost(StateError(goal), 100.0)],
        bounds=None,
        constraints=[Constraint(Velocity(), -0.9, 0.9, "all"),
                     Constraint(Configuration(), -0.1, 0.8, "all")],
    )  # fmt: skip
    s = solve(problem, rest)
    assert s.success
    assert jnp.abs(s.states.v).max() < 0.9 + 1e-6 and s.states.q.max() < 0.8 + 1e-6
    assert jnp.abs(s.states.v).max() > 0.9 - 1e-4 and s.states.q.max() > 0.8 - 1e-4


@pytest.mark.slow
def test_a_point_goes_around_an_obstacle():
    ball = Sphere([0.5, 0.05, 0.0], 0.2)

    def clear(t, x, u):
        return ball.distance(jnp.concatenate([x, jnp.zeros(1)]))[None]

    problem = Problem(
        Equations(lambda t, x, u: u, 2, 2), 20, 0.05, running=[Control()],
        terminal=[Cost(lambda t, x, u: x - jnp.asarray([1.0, 0.0]), 1e3)],
        constraints=[Constraint(clear, 0.0, jnp.inf, "all", "ball")],
    )  # fmt: skip
    s = solve(problem, jnp.zeros(2))
    assert s.success
    off = np.linalg.norm(s.states - np.asarray([0.5, 0.05]), axis=1)
    assert abs(off.min() - 0.2) < 1e-4
    np.testing.assert_allclose(s.states[-1], [1.0, 0.0], atol=1e-2)


@pytest.mark.slow
def test_what_cannot_be_held_together_is_named():
    def at(x, name):
        return Constraint(lambda t, s, u: s - x, where="end", name=name)

    system = Equations(lambda t, x, u: x + u, 1, 1, discrete=True)
    problem = Problem(
        system, 4, 1.0, running=[Cost(Control(), 1e-3)], bounds=(-1.0, 1.0),
        constraints=[at(0.5, "near"), at(30.0, "far away")],
    )  # fmt: skip
    s = solve(problem, jnp.zeros(1))
    assert s.status == INFEASIBLE
    assert "infeasible" in s.summary() and "far away" in s.summary()


def test_distances_are_those_of_the_shapes():
    p = jnp.asarray([[2.0, 0.0, 0.0], [0.0, 3.0, 0.5], [0.0, 0.0, 0.1]])
    np.testing.assert_allclose(Sphere([0, 0, 0.0], 0.5).distance(p)[0], 1.5, atol=2e-6)
    capsule = Capsule([0, 0, -1.0], [0, 0, 1.0], 0.25)
    np.testing.assert_allclose(capsule.distance(p), [1.75, 2.75, -0.25], atol=2e-6)
    np.testing.assert_allclose(capsule.distance(jnp.asarray([0, 0, 3.0])), 1.75, atol=2e-6)
    found = HalfSpace([0, 0, 2.0], 0.1).distance(p)
    np.testing.assert_allclose(found, [-0.1, 0.4, 0.0], atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ddp", "sqp", "exact_ddp", "exact_sqp"])
def test_the_acrobot_ends_upright(method):
    """From rest at the bottom, with an end state as a constraint, from controls of zero and from
    random ones. Its multipliers bend the cost far from the model of an iteration."""
    model = rb.load("acrobot")
    upright = Constraint(StateError(model.keyframe("up")), where="end", name="upright")
    problem = Problem(
        model, 100, 0.05, running=[Control()], constraints=[upright], bounds=(-20, 20)
    )
    for seed in range(4):
        ctrls = min(seed, 1) * 2 * np.random.default_rng(seed).normal(size=(100, 1))
        s = solve(problem, model.keyframe("down"), method=method, ctrl=ctrls, iterations=1000)
        assert s.success and s.violation <= 1e-6
        end = StateError(model.keyframe("up"))(model, 0.0, s.state(-1), jnp.zeros(1))
        assert np.abs(end).max() <= 2e-6


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ddp", "sqp"])
def test_most_searches_for_the_acrobot_converge_in_single_precision(method):
    """The others end as stuck, a few roundings from the end state, at the same costs."""
    with jax.enable_x64(False):
        model = rb.load("acrobot")
        upright = Constraint(StateError(model.keyframe("up")), where="end", name="upright")
        problem = Problem(
            model, 100, 0.05, running=[Control()], constraints=[upright], bounds=(-20, 20)
        )
        random = [2 * np.random.default_rng(k).normal(size=(100, 1)) for k in range(1, 10)]

        @jax.jit
        @jax.vmap
        def run(ctrl):
            s = solve(problem, model.keyframe("down"), method=method, ctrl=ctrl, iterations=1000)
            return s.status, s.violation

        guesses = jnp.asarray(np.stack([np.zeros((100, 1)), *random]), jnp.float32)
        status, violation = (np.asarray(x) for x in run(guesses))
    assert set(status.tolist()) <= {CONVERGED, STUCK}
    assert (status == CONVERGED).sum() >= 6  # 8 and 9
    assert violation.max() < 1e-4 and violation[status == CONVERGED].max() < 1.2e-6


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_tolerance_of_no_violation_is_that_of_the_precision(dtype):
    with jax.enable_x64(dtype == "float64"):
        s = solve(rest_to_rest(10), jnp.zeros(2), violation=0.0)
        assert s.cost.dtype == dtype and s.success
        assert s.violation <= 10 * jnp.finfo(dtype).eps


def test_spheres_move_with_their_bodies():
    model = rb.load("arm7")
    state = model.default_state()
    tip = model.body_names[-1]
    floor, ball = HalfSpace([0, 0, 1.0]), Sphere([0.0, 0.0, 5.0], 1.0)
    term = Clearance([floor, ball], [tip, tip], [[0, 0, 0.0], [0.1, 0, 0]], [0.0, 0.05], 0.01)
    poses = rb.forward_kinematics(model, state.q)
    k = model.body(tip)
    c = np.asarray([poses.p[k], poses.p[k] + poses.R[k] @ np.asarray([0.1, 0, 0])])
    less = np.asarray([0.01, 0.06])
    due = [*(c[:, 2] - less), *(np.linalg.norm(c - [0, 0, 5.0], axis=1) - 1.0 - less)]
    np.testing.assert_allclose(term(model, 0.0, state, None), due, atol=3e-6)


def test_residuals_of_a_pose_have_their_angular_part_first():
    """About its reference, the rate of `Pose` is the twist of the frame in its own axes."""
    model = rb.load("arm7")
    state = model.random_state(jax.random.key(3))
    R, p = rb.frame_pose(model, state.q, site="tool")
    term, u = rb.control.Pose(R, p, site="tool"), jnp.zeros(model.nu)

    def error(h):
        q = rb.integrate(model, state.q, h * state.v)
        return term(model, 0.0, rb.State(q, state.v), u)

    zero = jnp.zeros(())
    rate = jax.jvp(error, (zero,), (zero + 1,))[1]
    twist = rb.control.FrameVelocity(site="tool")(model, 0.0, state, u)
    due = jnp.concatenate([R.T @ twist[:3], R.T @ twist[3:]])
    np.testing.assert_allclose(rate, due, atol=1e-12)


def test_terms_count_at_their_knots():
    """A gate at x = 2 after three of six steps: u = 2/3 three times, then 0."""
    line = Equations(lambda t, x, u: x + u, 1, 1, discrete=True)
    gate = Constraint(lambda t, x, u: x, 2.0, 2.0, name="gate", knots=[3])
    near = Cost(lambda t, x, u: x - 2.0, 1e8, knots=[3])
    for terms in ({"constraints": [gate]}, {"running": [near]}):
        running = [Control(), *terms.pop("running", [])]
        found = solve(Problem(line, 6, 1.0, running=running, **terms), jnp.zeros(1))
        due = [0, 2 / 3, 4 / 3, 2, 2, 2, 2]
        np.testing.assert_allclose(found.states[:, 0], due, atol=1e-6)
        np.testing.assert_allclose(found.cost, 2 / 3, rtol=1e-6)


def test_knots_of_terms_are_checked():
    line = Equations(lambda t, x, u: x + u, 1, 1, discrete=True)
    for knots in (3, [-1], [0.5], "12"):
        with pytest.raises(InputError, match="knots"):
            Cost(Control(), knots=knots)
    with pytest.raises(InputError, match="below the horizon 6"):
        Problem(line, 6, 1.0, running=[Cost(Control(), knots=[6])])
