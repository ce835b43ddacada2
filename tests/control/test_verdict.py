"""What counts as converged, and what as stuck."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.control import Control, Cost, Equations, Problem, solve
from rbjax.control.outcome import CONVERGED, STUCK

LINE = Equations(lambda t, x, u: u, 1, 1)
STEPPING = ("ddp", "sqp")
DTYPES = ("float32", "float64")


def kinked():
    """Least where x = 0.37, with a kink there: no quadratic model of it is right."""
    def cost(t, x, u):
        return jnp.sqrt(jnp.abs(x[0] - 0.37) + 0.3 * jnp.abs(u[0]) + 1e-30)

    return Problem(LINE, 6, 0.1, running=[cost])


def smooth(size=1.0, bounds=None):
    """A pendulum pushed up, its cost in units of 1 / size."""
    swing = Equations(lambda t, x, u: jnp.stack([x[1], jnp.sin(x[0]) + u[0]]), 2, 1)
    goal = lambda t, x, u: jnp.stack([jnp.sin(x[0] - 0.3), x[1]])  # noqa: E731
    return Problem(swing, 20, 0.1, running=[Cost(goal, size), Cost(Control(), 0.1 * size)],
                   terminal=[Cost(goal, 10 * size)], bounds=bounds)  # fmt: skip


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("method", STEPPING)
def test_a_kink_is_not_called_an_optimum(method, dtype):
    with jax.enable_x64(dtype == "float64"):
        starts = [solve(kinked(), jnp.zeros(1), ctrls=jnp.full((6, 1), g), method=method)
                  for g in (0.0, 1.0, -2.0)]  # fmt: skip
        least = min(float(s.cost) for s in starts)
        for s in starts:
            assert int(s.outcome) != CONVERGED or float(s.cost) < 1.01 * least
        # SQP in single precision lowers the cost by a few roundings an iteration, without an end
        assert (method, dtype) == ("sqp", "float32") or STUCK in [int(s.outcome) for s in starts]
        assert all("kink" in s.status for s in starts if int(s.outcome) == STUCK)
        assert all(np.isfinite(s.stop) for s in starts if int(s.iterations) > 1)


@pytest.mark.parametrize("method", STEPPING)
def test_the_unit_of_the_cost_does_not_decide(method):
    """The tolerance is relative: of a cost a billion times smaller the optimum is the same."""
    whole, small, large = (solve(smooth(c), jnp.zeros(2), method=method) for c in (1, 1e-9, 1e9))
    for s in (whole, small, large):
        assert s.status == "converged"
        np.testing.assert_allclose(s.ctrls, whole.ctrls, atol=1e-4)


@pytest.mark.parametrize("method", STEPPING)
def test_single_precision_converges_by_its_own_floor(method):
    double = solve(smooth(), jnp.zeros(2), method=method)
    with jax.enable_x64(False):
        single = solve(smooth(), jnp.zeros(2, jnp.float32), method=method)
        assert single.status == "converged" and single.cost.dtype == jnp.float32
        np.testing.assert_allclose(single.cost, double.cost, rtol=1e-5)


@pytest.mark.parametrize("method", STEPPING)
def test_bounds_that_never_bind_change_nothing(method):
    free = solve(smooth(), jnp.zeros(2), method=method)
    most = 1.5 * float(np.abs(free.ctrls).max())
    held = solve(smooth(bounds=(-most, most)), jnp.zeros(2), method=method)
    np.testing.assert_allclose(held.cost, free.cost, rtol=1e-9)


@pytest.mark.parametrize("method", STEPPING)
def test_a_cost_of_zero_at_the_guess_is_an_optimum(method):
    s = solve(Problem(LINE, 4, 0.1, running=[Control(), lambda t, x, u: x]), jnp.zeros(1),
              method=method)  # fmt: skip
    assert s.status == "converged" and float(s.cost) == 0.0 and int(s.iterations) <= 2
