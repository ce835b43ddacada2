"""`Environment.problem`: its cost is minus the return of the environment, and its optima."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control.optimal.objective import motion_cost
from rbjax.control.optimal.problem import Knot
from rbjax.envs import Increment, Observation, Reward, Task, Variable
from rbjax.envs.optimal_control import MinusReward, Pair
from tests.envs.suite.controllers import damp
from tests.envs.suite.shared import placed, quiet

MODEL = rb.load("cart_pole")


def everything():
    """A task whose rewards read all parts of a transition, with variables of each kind."""
    draw = lambda key, params: jax.random.uniform(key)  # noqa: E731
    zero = lambda key, params: jnp.zeros(())  # noqa: E731
    return Task(
        "everything",
        MODEL,
        start=lambda key, params: rb.State(jnp.array([0.1, 0.2]), jnp.array([0.3, -0.1])),
        observations={"policy": (Observation("q", lambda to: to.after.q),)},
        rewards=(
            Reward("upright", lambda to: jnp.cos(to.after.q[1]), 2.0),
            Reward("moved", lambda to: (to.after.q[0] - to.before.q[0]) ** 2, -50.0),
            Reward("goal", lambda to: (to.after.q[0] - to.variables["goal"]) ** 2, -1.0),
            Reward("phase", lambda to: jnp.sin(to.variables["phase"]) * to.after.v[0]),
            Reward("mean", lambda to: to.variables["mean"] ** 2, -1.0),
            Reward("smooth", lambda to: ((to.action - to.last_action) ** 2).sum(), -0.1),
            Reward("change", lambda to: ((to.ctrl - to.last_ctrl) ** 2).sum(), -0.05),
            Reward("effort", lambda to: (to.after.solution.acceleration**2).sum(), -1e-3),
        ),
        action=Increment(3.0),
        variables=(
            Variable("goal", draw, update=lambda key, to: jax.random.uniform(key)),
            Variable("phase", zero, update=lambda key, to: to.variables["phase"] + 0.3),
            Variable(
                "mean", zero, measure=lambda to: 0.8 * to.variables["mean"] + 0.2 * to.after.v[1]
            ),
        ),
        decimation=2,
    )


def cost_of(problem, state, actions):
    """Compute the cost of a motion, step by step."""
    pairs = [problem.system.checked("test", state)]
    for u in actions:
        pairs.append(problem.system.step(0.0, pairs[-1], u, problem.dt))
    states = jax.tree.map(lambda *x: jnp.stack(x), *pairs)
    none = jnp.zeros((len(pairs), 0))
    return motion_cost(problem, Knot(states, none), actions)


def return_of(env, state, actions, params=None, goal=None):
    total, step = 0.0, jax.jit(env.step_once)
    for u in actions:
        if goal is not None:
            state = state.replace(variables=state.variables | {"goal": goal})
        _, state, reward, _, _ = step(jax.random.key(7), state, u, params)
        total += float(reward)
    return total


def test_cost_is_minus_the_return():
    env = rb.envs.Environment(everything())
    _, state = env.reset(jax.random.key(0))
    _, state, *_ = env.step_once(jax.random.key(1), state, jnp.array([0.4]))  # not the first step
    goal = state.variables["goal"]  # drawn again in each step: the problem keeps it
    actions = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (6, 1)))
    params = env.default_params
    params = params.replace(weights=params.weights | {"upright": jnp.asarray(5.0)})
    for given in (None, params):
        cost = jax.jit(lambda a, g=given: cost_of(env.problem(6, g), state, a))(actions)
        due = return_of(env, state, actions, given, goal)
        np.testing.assert_allclose(cost, -due, rtol=1e-12)


def test_motion_goes_on_after_a_termination_and_must_be_finite():
    task = dataclasses.replace(
        everything(), rewards=(Reward("fell", rb.envs.terms.terminated, -7.0),), variables=(),
        terminations={"out": lambda to: to.after.q[0] > -1.0},
    )  # fmt: skip
    env = rb.envs.Environment(task)
    _, state = env.reset(jax.random.key(0))
    problem = env.problem(3)
    due = 7.0 * env.dt
    cost = jax.jit(lambda a: cost_of(problem, state, a))(jnp.zeros((3, 1)))
    np.testing.assert_allclose(cost, 3 * due)
    pair = problem.system.checked("test", state)
    pair = jax.jit(lambda u: problem.system.step(0.0, pair, u, env.dt))(jnp.zeros(1))
    motion = dataclasses.replace(pair.now.state, v=jnp.array([jnp.nan, 0.0]))
    broken = pair._replace(now=dataclasses.replace(pair.now, state=motion))
    term = MinusReward(problem.system)
    np.testing.assert_allclose(term(problem.system.model, 0.0, pair, jnp.zeros(1)), due)
    assert term(problem.system.model, 0.0, broken, jnp.zeros(1)) == jnp.inf


def test_coordinates_are_those_that_rewards_read():
    env = rb.envs.Environment(everything())
    parts = env.problem(3).system.parts
    assert set(parts) == {
        ("last", "action", ""), ("last", "ctrl", ""), ("last", "state", ""),
        ("last", "variables", "goal"), ("last", "variables", "mean"),
        ("last", "variables", "phase"), ("now", "action", ""), ("now", "ctrl", ""),
        ("now", "acceleration", ""), ("now", "variables", "goal"), ("now", "variables", "mean"),
        ("now", "variables", "phase"),
    }  # fmt: skip
    plain = rb.envs.make("cart_pole_balance").problem(3).system
    assert plain.n == 6 and ("last", "state", "") not in plain.parts


def test_linear_step_and_coordinates():
    system = rb.envs.Environment(everything()).problem(3).system
    env = rb.envs.Environment(everything())
    _, state = env.reset(jax.random.key(0))
    pair = system.checked("test", state)
    pair = system.step(0.0, pair, jnp.array([0.3]), 0.02)
    rng = np.random.default_rng(0)
    dx = jnp.asarray(rng.normal(size=system.n))
    np.testing.assert_allclose(system.minus(system.plus(pair, dx), pair), dx, atol=1e-14)
    u, du, h = jnp.array([-0.2]), jnp.array([0.7]), 1e-6
    found = jax.jit(lambda p, u: system.linear(0.0, p, u, 0.02))(pair, u)

    def moved(h):
        after = system.step(0.0, system.plus(pair, h * dx), u + h * du, 0.02)
        return np.asarray(system.minus(after, found.after))

    due = (moved(h) - moved(-h)) / (2 * h)
    # central differences with 1e-6: rounding 1e-10 relative to accelerations of order 100
    np.testing.assert_allclose(found.A @ dx + found.B @ du, due, rtol=1e-6, atol=1e-7)


def test_an_optimum_has_no_slope_and_obeys_the_range():
    env = rb.envs.make("cart_pole_swing_up")
    _, state = env.reset(jax.random.key(0))
    plan = rb.control.solve(env.problem(200), state, iterations=300)
    assert plan.success
    u = np.asarray(plan.ctrl)
    assert np.abs(u).max() == 1.0 and isinstance(plan.states, Pair)
    assert np.cos(np.asarray(plan.states.now.state.q[-50:, 1])).min() > 0.9  # upright
    np.testing.assert_allclose(return_of(env, state, plan.ctrl), -plan.cost, rtol=1e-10)


def test_derivative_by_a_weight_is_the_sum_of_its_term():
    # envelope theorem: at an optimum, d cost / d weight = -sum of the term
    rewards = (
        Reward("off", lambda to: (to.after.q**2).sum(), -1.0),
        Reward("effort", lambda to: (to.ctrl**2).sum(), -0.1),
    )
    env = rb.envs.Environment(
        dataclasses.replace(
            everything(), rewards=rewards, variables=(), decimation=1, action=rb.envs.Direct()
        )
    )
    _, state = env.reset(jax.random.key(0))

    def solved(weight):
        params = env.default_params
        params = params.replace(weights=params.weights | {"effort": weight})
        return rb.control.solve(env.problem(10, params), state, tolerance=1e-12)

    plan = solved(jnp.asarray(-0.1))
    slope = jax.grad(lambda w: solved(w).cost)(jnp.asarray(-0.1))
    assert plan.success
    np.testing.assert_allclose(slope, -env.dt * (np.asarray(plan.ctrl) ** 2).sum(), rtol=1e-6)


def test_model_predictive_control_beats_the_regulator():
    # the arm with the true model, one iteration a step: a greater return than the regulator's
    env = rb.envs.make("damp_flexible_arm", randomise=False)
    params = quiet(env, goal_time=1e12)
    start = placed(env, [0, 0, 0, 0], goal=1.0)
    controller = rb.control.mpc(env.problem(60, params), iterations=3)
    regulator, step = damp(env), jax.jit(env.step_once)

    def run(policy, memory):
        state, total = start, 0.0
        obs, *_ = step(jax.random.key(0), state, jnp.zeros(1), params)
        for k in range(150):
            action, memory = policy(memory, k, state, obs)
            obs, state, reward, done, _ = step(jax.random.key(0), state, action, params)
            total += float(reward)
            assert not done
        return total, np.asarray(state.state.q)

    tick = jax.jit(controller.tick)
    planned, q = run(lambda m, k, s, o: tick(m, k * env.dt, s)[:2], controller.begin(start))
    linear, _ = run(lambda m, k, s, o: (regulator(o, None), m), None)
    assert planned > linear + 0.05 and abs(q[0] - 1) < 0.01 and np.abs(q[1:]).max() < 0.01


def test_bad_input():
    problem = rb.envs.make("cart_pole_balance").problem(5)
    with pytest.raises(rb.InputError, match=r"the state of an episode, as env\.reset"):
        rb.control.solve(problem, rb.State(jnp.zeros(2), jnp.zeros(2)))
    with pytest.raises(rb.InputError, match="horizon"):
        rb.envs.make("cart_pole_balance").problem(0)
