"""Single shooting against DDP on problems with bounds and constraints."""

import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.control import Constraint, Control, Cost, Equations, Problem, solve
from rbjax.control.optimal.shooting.single_shooting import from_unbounded, to_unbounded
from rbjax.errors import InputError

DOUBLE = Equations(lambda t, x, u: jnp.stack([x[1], u[0]]), 2, 1)


def off(t, x, u):
    return x - jnp.array([1.0, 0.0])


def test_bounds_are_kept_by_coordinates():
    low, high = jnp.array([-1.0, -jnp.inf, 2.0, -jnp.inf]), jnp.array([3.0, 1.0, jnp.inf, jnp.inf])
    w = jnp.linspace(-5, 5, 11)[:, None] * jnp.ones(4)
    u = from_unbounded(w, low, high)
    assert (u >= low).all() and (u <= high).all()
    np.testing.assert_allclose(u[:, 3], w[:, 3])
    u = jnp.array([1.2, -4.0, 2.5, 7.0])
    np.testing.assert_allclose(from_unbounded(to_unbounded(u, low, high), low, high), u, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method, budget, near", [("levenberg_marquardt", 200, 1e-9), ("bfgs", 300, 1e-7),
                             ("adam", 3000, 1e-5)],
)  # fmt: skip
def test_bounded_controls(method, budget, near):
    problem = Problem(
        DOUBLE, 10, 0.1, running=[Control()], terminal=[Cost(off, 100.0)], bounds=(-3, 3)
    )
    best = solve(problem, jnp.zeros(2), tolerance=1e-12)
    found = solve(problem, jnp.zeros(2), method=method, iterations=budget, tolerance=1e-8)
    assert found.success and found.gap == 0
    assert abs(found.cost - best.cost) < near * best.cost
    assert np.abs(found.ctrl).max() <= 3


@pytest.mark.slow
def test_an_end_is_reached():
    goal = Constraint(off, where="end", name="goal")
    problem = Problem(DOUBLE, 10, 0.1, running=[Cost(Control(), 2.0)], constraints=[goal])
    # a violation changes the cost by the multiplier, about 12, times as much
    best = solve(problem, jnp.zeros(2), violation=1e-8)
    found = solve(problem, jnp.zeros(2), method="levenberg_marquardt", violation=1e-8)
    assert found.success and found.violation <= 1e-8
    assert abs(found.cost - best.cost) < 1e-6 * best.cost


def test_numbers_are_no_residuals():
    problem = Problem(DOUBLE, 3, 0.1, running=[lambda t, x, u: u[0] ** 2])
    with pytest.raises(InputError, match="needs residuals"):
        solve(problem, jnp.zeros(2), method="levenberg_marquardt")
