"""Sequential quadratic programming: closed forms, dense programs by SciPy, and problems whose
answers others found (benchmarks/cases/optimal_control.json)."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from benchmarks.cases import optimal_control as oracle
from rbjax.control import Constraint, Control, Cost, Equations, Problem, StateError, solve
from rbjax.control.status import INFEASIBLE, NOT_FINITE

DIGITS = 1e-6  # of a listed cost: six digits
LISTED = [  # with the most iterations; DDP's are 3, 6, 65, 45, 79, 35, 35, 37, 10 and 10
    ("cart_pole", functools.partial(oracle.cart_pole, "near_upright"), 3),
    ("hanging", functools.partial(oracle.cart_pole, "from_hanging"), 6),
    ("pendulum_with_limits", oracle.pendulum_with_limits, 80),
    ("quadrotor", functools.partial(oracle.quadrotor, False), 40),
    ("double_pendulum", oracle.double_pendulum, 95),
    *[
        (v, functools.partial(oracle.kinova_reach, v), 37)
        for v in ("as_in_crocoddyl", "plain_difference", "plain_with_terminal_velocity")
    ],
    *[(f"indy7-{N}", functools.partial(oracle.indy7, N, 3), 12) for N in (16, 32)],
]
CASES = [
    pytest.param(make, most, id=name, marks=[] if name == "cart_pole" else pytest.mark.slow)
    for name, make, most in LISTED
]


@pytest.mark.parametrize(("make", "most"), CASES)
def test_a_listed_cost_or_a_lower_one(make, most: int) -> None:
    case = make()
    found = solve(case.problem, case.start, method="sqp", iterations=300)
    assert found.success
    assert float(found.gap) < 1e-9
    due = min(case.costs, key=lambda c: abs(c - float(found.cost)))
    lower = float(found.cost) < min(case.costs)
    assert lower or float(found.cost) < due * (1 + DIGITS)
    assert int(found.iterations) <= most


N, H = 10, 0.1
A, B = np.array([[1.0, H], [0.0, 1.0]]), np.array([0.0, H])
SLIDER = Equations(lambda t, x, u: jnp.asarray(A) @ x + jnp.asarray(B) * u[0], 2, 1, discrete=True)
START = np.array([1.0, 0.0])


def sliding(**changes) -> Problem:
    given = {
        "running": [StateError(jnp.zeros(2)), Cost(Control(), 0.1)],
        "terminal": [Cost(StateError(jnp.zeros(2)), 10.0)], "integral": False, "bounds": None,
    }  # fmt: skip
    return Problem(SLIDER, N, H, **{**given, **changes})


def dense(bound: float) -> tuple[np.ndarray, float]:
    """Controls and cost of `sliding` by SciPy: a linear least-squares problem in a box."""
    to = np.zeros((N + 1, 2, N))
    for k in range(N):
        to[k + 1] = A @ to[k]
        to[k + 1][:, k] += B
    free = np.stack([np.linalg.matrix_power(A, k) @ START for k in range(N + 1)])
    w = np.sqrt(np.where(np.arange(N + 1) == N, 10.0, 1.0))[:, None, None]
    M = np.concatenate([(w * to).reshape(-1, N), np.sqrt(0.1) * np.eye(N)])
    b = np.concatenate([-(w[..., 0] * free).reshape(-1), np.zeros(N)])
    u = lsq_linear(M, b, (-bound, bound), tol=1e-14, method="bvls").x
    return u, 0.5 * ((M @ u - b) ** 2).sum()


def test_a_linear_problem_takes_one_step() -> None:
    us, cost = dense(1e6)
    far = jnp.ones((N + 1, 2)) * 3.0  # a guess that obeys nothing
    found = solve(sliding(), START, states=far, method="sqp", iterations=1)
    assert abs(float(found.cost) - cost) < 1e-9 * cost
    assert np.abs(found.ctrl[:, 0] - us).max() < 1e-9
    assert float(found.gap) < 1e-12
    found = solve(sliding(), START, states=far, method="sqp")
    assert found.success and int(found.iterations) == 2


def test_bounds_are_those_of_a_dense_program() -> None:
    us, cost = dense(1.5)
    assert (np.abs(us) > 1.5 - 1e-9).sum() >= 2
    found = solve(sliding(bounds=(-1.5, 1.5)), START, method="sqp", tolerance=1e-14)
    assert found.success
    assert abs(float(found.cost) - cost) < 1e-9 * cost
    assert np.abs(found.ctrl[:, 0] - us).max() < 1e-6


@pytest.mark.parametrize("method", ["sqp", "exact_sqp", "ddp"])
@pytest.mark.parametrize("margin", [0.0, 0.02, 0.2, 1.0])
def test_bounds_that_do_not_bind_change_nothing(method: str, margin: float) -> None:
    """A linear unstable plant, so a full step of the free problem is its optimum. Far from it k
    exceeds the bounds at nearly all knots."""
    plant = Equations(
        lambda t, x, u: jnp.asarray([[1.2, 0.1], [0.0, 1.1]]) @ x + jnp.asarray([0.0, 0.1]) * u[0],
        2, 1, discrete=True,
    )  # fmt: skip
    given = {
        "running": [StateError(jnp.zeros(2)), Cost(Control(), 1e-3)], "integral": False,
        "terminal": [Cost(StateError(jnp.zeros(2)), 10.0)],
    }  # fmt: skip
    free = solve(Problem(plant, 40, H, **given), START)
    low, high = float(free.ctrl.min()), float(free.ctrl.max())
    more = margin * (high - low) + 1e-9 * high  # rounding, where nothing else is between
    bounds = low - more, high + more
    far = 3.0 * jnp.ones((41, 2)) + jnp.arange(41.0)[:, None]
    problem = Problem(plant, 40, H, bounds=bounds, **given)
    found = solve(problem, START, states=far, method=method)
    assert found.success and int(found.iterations) <= 3
    np.testing.assert_allclose(found.cost, free.cost, rtol=1e-9)
    np.testing.assert_allclose(found.ctrl, free.ctrl, atol=1e-6 * (high - low))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["sqp", "exact_sqp", "ddp"])
@pytest.mark.parametrize("margin", [0.02, 0.2])
def test_bounds_that_do_not_bind_change_nothing_of_an_arm(method: str, margin: float) -> None:
    case = oracle.kinova_reach("plain_difference")
    free = solve(case.problem, case.start, method="sqp")
    low, high = free.ctrl.min(0), free.ctrl.max(0)
    more = margin * (high - low)
    case = oracle.kinova_reach("plain_difference", (low - more, high + more))
    found = solve(case.problem, case.start, method=method, iterations=100)
    assert found.success
    np.testing.assert_allclose(found.cost, free.cost, rtol=1e-6)


def test_rest_to_rest_costs_what_the_closed_form_says() -> None:
    """x'' = u over a distance 1 in a time 1: h sum u^2 = 12 n^2 / (n^2 - 1)."""
    goal = jnp.asarray([1.0, 0.0])

    def step(t, x, u):
        v = x[1] + u[0] / N
        return jnp.stack([x[0] + v / N, v])

    problem = Problem(
        Equations(step, 2, 1, discrete=True), N, 1 / N, running=[Cost(Control(), 2.0)],
        constraints=[Constraint(lambda t, x, u: x - goal, where="end", name="there")],
    )  # fmt: skip
    found = solve(problem, jnp.zeros(2), method="sqp", violation=1e-11, tolerance=1e-14)
    assert found.success
    np.testing.assert_allclose(found.cost, 12 * N**2 / (N**2 - 1), rtol=1e-9)


def test_a_limit_along_the_path_is_held_as_ddp_holds_it() -> None:
    slow = Constraint(lambda t, x, u: x[1:], -0.4, jnp.inf, "all", "slow")
    found, due = (solve(sliding(constraints=[slow]), START, method=m) for m in ("sqp", "ddp"))
    assert found.success
    assert float(found.states[:, 1].min()) > -0.4 - 1e-6
    assert float(found.states[:, 1].min()) < -0.4 + 1e-4
    np.testing.assert_allclose(found.cost, due.cost, rtol=1e-6)
    np.testing.assert_allclose(found.multipliers[0], due.multipliers[0], atol=1e-3)


def test_what_is_free_of_the_start() -> None:
    """A slider whose speed at the start is free needs no control to arrive."""
    end = [Cost(lambda t, x, u: x[:1] - 2.0, 1e4)]
    problem = sliding(running=[Control()], terminal=end, free_start=(False, True))
    found = solve(problem, START, method="sqp")
    assert found.success
    assert abs(float(found.states[0, 1]) - 1.0) < 1e-6
    assert np.abs(found.ctrl).max() < 1e-6


def test_what_is_not_finite_and_what_cannot_be_held_are_named() -> None:
    bad = solve(sliding(terminal=[lambda t, x, u: jnp.log(x - 50.0)]), START, method="sqp")
    assert bad.status == NOT_FINITE and np.isfinite(bad.states).all()
    both = [
        Constraint(lambda t, x, u: x[:1], 2.0, 3.0, "end", "above"),
        Constraint(lambda t, x, u: x[:1], -3.0, -2.0, "end", "below"),
    ]
    found = solve(sliding(constraints=both), START, method="sqp", iterations=500)
    assert found.status == INFEASIBLE
    assert "above" in found.summary() or "below" in found.summary()
