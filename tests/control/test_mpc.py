"""Model predictive control: the loop closed, delays, failures, the clock."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import Control, Cost, Equations, Problem, RealTime, mpc, solve
from rbjax.control.optimal.ticks import FALLBACK, KEPT, PLANNED
from rbjax.errors import InputError


def cart(bound=0.4, cost=lambda t, x, u: x):
    system = Equations(lambda t, x, u: jnp.stack([x[1], u[0]]), 2, 1)
    return Problem(
        system, 8, 0.2, running=[cost, Control()], terminal=[Cost(cost, 5.0)],
        bounds=(-bound, bound),
    )  # fmt: skip


START = jnp.asarray([1.0, 0.0])


@pytest.mark.slow
def test_without_errors_of_the_model_the_delay_costs_nothing():
    """A plan from the state that will be is the plan from the state that is."""
    runs = [jax.jit(mpc(cart(), delay=d).closed_loop, static_argnums=1)(START, 25) for d in (0, 1)]
    np.testing.assert_allclose(runs[0].states, runs[1].states, atol=1e-8)
    for run in runs:
        assert (run.statuses == PLANNED).all() and (abs(run.ctrl) <= 0.4).all()
        assert np.abs(run.states[-1]).max() < 0.1


@pytest.mark.slow
def test_the_first_control_is_that_of_the_optimum_and_the_tail_is_optimal_again():
    problem = cart()
    s = solve(problem, START)
    controller = mpc(problem, delay=0, iterations=20)
    u, _, _ = jax.jit(controller.tick)(controller.begin(START), 0.0, START)
    np.testing.assert_allclose(u, s.ctrl[0], atol=1e-6)


@pytest.mark.parametrize("delay", [1, 0, 2])
def test_failing_plans_keep_the_last_and_then_fall_back(delay):
    """The cost is nan in plans that begin at 0.6 s or later. The plan that begins at a tick decides
    its control, whatever the delay, so tick 3 is the first whose plan failed."""

    def at(t):
        return cart(cost=lambda _, x, u: jnp.where(t > 0.5, jnp.nan, 1.0) * x)

    fallback = lambda t, x: jnp.asarray([0.123])  # noqa: E731
    controller = mpc(at, delay=delay, patience=2, fallback=fallback)
    run = jax.jit(lambda x: controller.closed_loop(x, 10))(START)
    assert run.statuses.tolist() == [PLANNED] * 3 + [KEPT] * 2 + [FALLBACK] * 5
    assert np.isfinite(run.states).all()
    np.testing.assert_allclose(run.ctrl[-5:], 0.123)


@pytest.mark.slow
def test_a_state_that_is_not_finite_is_survived():
    controller = mpc(cart())
    tick = jax.jit(controller.tick)
    u, memory, result = tick(controller.begin(START), 0.0, jnp.full(2, jnp.nan))
    assert np.isfinite(u).all() and result == PLANNED
    u, memory, result = tick(memory, 0.2, START)
    assert np.isfinite(u).all() and result == KEPT
    assert tick(memory, 0.4, START)[2] == PLANNED


@pytest.mark.slow
def test_as_a_policy_of_rollout_and_with_a_clock():
    model = rb.load("pendulum")
    rest = model.default_state()
    goal = rb.State(rest.q + 0.3, rest.v)
    problem = Problem(
        model, 10, 0.05, running=[Cost(Control(), 1e-3)], bounds=(-20.0, 20.0),
        terminal=[Cost(rb.control.StateError(goal), 100.0)],
    )  # fmt: skip
    controller = mpc(problem, delay=0, iterations=3)
    memory = controller.begin(rest)
    there = rb.rollout(model, rest, controller.policy(memory), 0.05, steps=30)
    assert abs(float(there.q[-1, 0] - goal.q[0])) < 0.05

    act, x = RealTime(mpc(problem), rest), rest
    for k in range(30):
        u = act(0.05 * k, x)
        x = rb.step(model, x, jnp.asarray(u), 0.05)
    assert abs(float(x.q[0] - goal.q[0])) < 0.05
    timing = act.timing()
    assert timing.calls == 30 and 0 < timing.median <= timing.p99 <= timing.worst


def test_a_closed_loop_has_ticks_and_a_state_of_the_system():
    with pytest.raises(InputError, match="steps is 0"):
        mpc(cart()).closed_loop(START, 0)
    with pytest.raises(InputError, match="shape"):
        mpc(cart()).closed_loop(jnp.zeros(3), 5)
