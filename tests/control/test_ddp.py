"""DDP on problems whose answers others found (benchmarks/cases/optimal_control.json)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases import optimal_control as oracle
from rbjax.control import Constraint, Control, Cost, Equations, Problem, StateError, solve

DIGITS = 1e-6  # of a listed cost: six digits
MORE = 1.2  # times the iterations of the peer, at most

QUICK = [
    pytest.param(functools.partial(oracle.cart_pole, "near_upright"), "ddp", id="cart_pole"),
    pytest.param(functools.partial(oracle.cart_pole, "from_hanging"), "ddp", id="hanging"),
]
LONG = [
    pytest.param(oracle.double_pendulum, "exact_ddp", id="double_pendulum"),
    pytest.param(oracle.pendulum_with_limits, "ddp", id="pendulum_with_limits"),
    pytest.param(functools.partial(oracle.quadrotor, False), "exact_ddp", id="quadrotor"),
    pytest.param(functools.partial(oracle.quadrotor, True), "exact_ddp", id="quadrotor_bounded"),
    *[
        pytest.param(functools.partial(oracle.kinova_reach, v), "ddp", id=v)
        for v in ("as_in_crocoddyl", "plain_difference", "plain_with_terminal_velocity")
    ],
    *[
        pytest.param(functools.partial(oracle.indy7, N, 3), "ddp", id=f"indy7-{N}")
        for N in (16, 32)
    ],
]  # fmt: skip
SLOW = [pytest.param(*p.values, id=p.id, marks=pytest.mark.slow) for p in LONG]


@pytest.mark.parametrize(("make", "method"), [*QUICK, *SLOW])
def test_a_listed_cost_or_a_lower_one(make, method: str) -> None:
    case = make()
    found = solve(case.problem, case.start, method=method, iterations=300)
    assert found.success
    assert float(found.gap) < 1e-9
    due = min(case.costs, key=lambda c: abs(c - float(found.cost)))
    lower = float(found.cost) < min(case.costs)
    assert lower or float(found.cost) < due * (1 + DIGITS)
    print(f"{float(found.cost):.10g} in {int(found.iterations)}, {case.costs}, {case.iterations}")


def test_a_linear_problem_takes_one_step() -> None:
    case = oracle.given("lqr_discrete")
    A, B = jnp.asarray(case["A"]), jnp.asarray(case["B"])
    slider = Equations(lambda t, x, u: A @ x + B @ u, 2, 1, discrete=True)
    Q, R = np.diag(case["Q"]), np.diag(case["R"])
    problem = Problem(
        slider, case["N"], case["dt"], integral=False,
        running=[Cost(StateError(jnp.zeros(2)), Q), Cost(Control(), R)],
        terminal=[Cost(StateError(jnp.zeros(2)), np.diag(case["P_N"]))],
    )  # fmt: skip
    found = solve(problem, jnp.asarray(case["x0"], float))
    assert found.success
    assert int(found.iterations) <= 2
    assert abs(float(found.cost) - case["cost"]) < 1e-8 * case["cost"]
    assert np.abs(found.ctrl[:5, 0] - np.asarray(case["u_0_4"])).max() < 1e-8
    assert np.abs(found.K[0, 0] - np.asarray(case["K_0"])).max() < 1e-8


def test_a_batch_is_each_of_its_problems() -> None:
    case = oracle.cart_pole("near_upright")
    angles = jnp.linspace(-0.3, 0.4, 3)

    def swung(angle):
        start = rb.State(case.start.q.at[1].set(angle), case.start.v)
        found = solve(case.problem, start)
        return found.cost, found.ctrl

    costs, ctrls = jax.jit(jax.vmap(swung))(angles)
    cost, ctrl = swung(angles[1])
    assert abs(float(costs[1] - cost)) < 1e-10
    assert np.abs(ctrls[1] - ctrl).max() < 1e-9


def test_the_policy_of_a_solution_follows_it() -> None:
    case = oracle.cart_pole("near_upright")
    found = solve(case.problem, case.start)
    model = rb.load(oracle.given("cart_pole")["model_mjcf"])
    run = rb.rollout(model, case.start, found.policy(), 0.05, steps=50)
    assert np.abs(run.q - found.states.q).max() < 1e-9
    pushed = rb.State(case.start.q + 0.05, case.start.v)
    back = rb.rollout(model, pushed, found.policy(), 0.05, steps=50)
    blind = rb.rollout(model, pushed, found.ctrl, 0.05)
    off = [np.abs(x.q[-1] - found.states.q[-1]).max() for x in (back, blind)]
    assert off[0] < 0.2 * off[1]


def test_free_final_time_and_a_fixed_end() -> None:
    """x'' = u, |u| <= 1, from 1 to rest at 0: 2 s."""
    slider = Equations(lambda t, x, u: jnp.stack([x[1], u[0]]), 2, 1)
    problem = Problem(
        slider, 20, 0.15, running=[lambda t, x, u: 1.0 + 1e-4 * u[0] ** 2], bounds=(-1.0, 1.0),
        constraints=[Constraint(lambda t, x, u: x, where="end", name="rest")],
        free_time=(0.5, 6.0),
    )  # fmt: skip
    found = solve(problem, jnp.array([1.0, 0.0]), iterations=400)
    assert found.success, found.summary()
    assert float(found.violation) < 1e-6
    assert abs(float(found.duration) - 2.0) < 5e-3


def test_what_is_free_of_the_start() -> None:
    """A slider whose speed at the start is free needs no control to arrive."""
    slider = Equations(lambda t, x, u: jnp.stack([x[1], u[0]]), 2, 1)
    problem = Problem(
        slider, 10, 0.1, running=[Control()], free_start=(False, True),
        terminal=[Cost(lambda t, x, u: x[:1] - 1.0, 1e4)],
    )  # fmt: skip
    found = solve(problem, jnp.zeros(2))
    assert found.success
    assert abs(float(found.states[0, 1]) - 1.0) < 1e-6
    assert np.abs(found.ctrl).max() < 1e-6


def test_second_derivatives_make_the_end_quadratic() -> None:
    """Residuals that do not vanish, and dynamics that bend: Gauss and Newton leave out what is as
    large as what they keep. Errors e of an iteration become C e^2, those of the cost likewise."""
    system = Equations(lambda t, x, u: jnp.stack([x[1], 4 * jnp.sin(x[0]) + u[0]]), 2, 1)
    problem = Problem(
        system, 12, 0.1, running=[Cost(Control(), 0.1)],
        terminal=[Cost(lambda t, x, u: jnp.stack([jnp.cos(x[0]) + 1.5, x[1]]), 5.0)],
    )  # fmt: skip
    count, off = {}, {}
    for method in ("ddp", "exact_ddp", "exact_sqp"):
        found = solve(problem, jnp.array([0.5, 0.0]), method=method, tolerance=1e-13)
        assert found.success
        count[method] = int(found.iterations)
        off[method] = np.asarray(found.costs)[: count[method]] - float(found.cost)
    assert count["exact_ddp"] < 0.5 * count["ddp"]
    e = off["exact_ddp"]
    last = np.flatnonzero(e > 1e-12)[-1]
    assert e[last] < 10 * e[last - 1] ** 2
    slow = off["ddp"]
    last = np.flatnonzero(slow > 1e-12)[-1]
    assert slow[last] > 0.01 * slow[last - 1]
