"""What counts as converged, and what as stuck."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.control import Control, Cost, Equations, Problem, solve
from rbjax.control.optimal.objective import ConstraintMultipliers
from rbjax.control.optimal.shooting.search import (
    LEAST,
    LENGTHS,
    MOST,
    IterationValues,
    cost_noise,
    count_stalled,
    decide,
    initial_search_state,
)
from rbjax.control.optimal.solution import StoppingRule
from rbjax.control.status import CONVERGED, GOING, STUCK

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
        starts = [solve(kinked(), jnp.zeros(1), ctrl=jnp.full((6, 1), g), method=method)
                  for g in (0.0, 1.0, -2.0)]  # fmt: skip
        least = min(float(s.cost) for s in starts)
        for s in starts:
            assert int(s.status) != CONVERGED or float(s.cost) < 1.01 * least
        # SQP in single precision lowers the cost by a few roundings an iteration, without an end
        assert (method, dtype) == ("sqp", "float32") or STUCK in [int(s.status) for s in starts]
        assert all("kink" in s.summary() for s in starts if int(s.status) == STUCK)
        assert all(np.isfinite(s.expected_decrease) for s in starts if int(s.iterations) > 1)


@pytest.mark.parametrize("method", STEPPING)
def test_the_unit_of_the_cost_does_not_decide(method):
    """The tolerance is relative: of a cost a billion times smaller the optimum is the same."""
    whole, small, large = (solve(smooth(c), jnp.zeros(2), method=method) for c in (1, 1e-9, 1e9))
    for s in (whole, small, large):
        assert s.success
        np.testing.assert_allclose(s.ctrl, whole.ctrl, atol=1e-4)


@pytest.mark.parametrize("method", STEPPING)
def test_single_precision_converges_by_its_own_floor(method):
    double = solve(smooth(), jnp.zeros(2), method=method)
    with jax.enable_x64(False):
        single = solve(smooth(), jnp.zeros(2, jnp.float32), method=method)
        assert single.success and single.cost.dtype == jnp.float32
        np.testing.assert_allclose(single.cost, double.cost, rtol=1e-5)


@pytest.mark.parametrize("method", STEPPING)
def test_bounds_that_never_bind_change_nothing(method):
    never_bind(method)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["exact_ddp", "exact_sqp", "hermite_simpson", "bfgs"])
def test_bounds_that_never_bind_change_nothing_by_other_methods(method):
    never_bind(method, 1e-6)


def never_bind(method, rtol=1e-9):
    free = solve(smooth(), jnp.zeros(2), method=method)
    most = 1.5 * float(np.abs(free.ctrl).max())
    held = solve(smooth(bounds=(-most, most)), jnp.zeros(2), method=method)
    assert free.success and held.success
    np.testing.assert_allclose(held.cost, free.cost, rtol=rtol)


@pytest.mark.parametrize(("constrained", "a", "rises"), [
    (True, 0.25, True), (True, 0.5, False), (False, 0.25, False), (False, 2.0**-8, True),
])  # fmt: skip
def test_short_steps_raise_the_regularisation(constrained, a, rises):
    """With constraints sooner: short steps say that the model lacks their curvature."""
    number = jnp.asarray
    rule = StoppingRule(number(1e-9), number(1e-6), number(100), number(1.0))
    now = initial_search_state(rule, constrained, number(10.0))._replace(feasible=number(True))
    lengths = jnp.asarray(LENGTHS)
    values = IterationValues(
        number(9.0), number(0.0), number(1.0), number(-1.0), number(1.0), number(1.0),
        number(True), 9.0 - lengths, 0 * lengths, None,
    )  # fmt: skip

    def accept(values, lengths):
        return lengths <= a, number(0.5)

    found = decide(accept, True, constrained, now, rule, values)
    assert found.accepted and found.length == a
    assert found.search.reg == LEAST * (10 if rises else 1)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_decrease_within_the_rounding_of_the_constraints_is_none(dtype):
    """A multiplier of 400 turns a rounding error of a constraint into 400 times of it."""
    number = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    eps, n = float(jnp.finfo(dtype).eps), len(LENGTHS)

    @jax.jit
    def status(share, reg):
        multipliers = ConstraintMultipliers(
            jnp.zeros((3, 2), dtype), number([240, 320]), number(10)
        )
        noise = cost_noise(multipliers)
        rule = StoppingRule(number(0), number(1e-6), number(100), number(1))
        now = initial_search_state(rule, True, number(10))._replace(
            feasible=jnp.asarray(True), inner_tolerance=number(10 * eps), reg=number(reg)
        )
        values = IterationValues(
            number(9), number(0), number(0), number(-1), number(1), number(1), jnp.asarray(True),
            jnp.full(n, 9, dtype), jnp.zeros(n, dtype), None, noise,
        )  # fmt: skip
        accept = lambda values, lengths: (lengths > 1, share * noise)  # noqa: E731
        return decide(accept, True, True, now, rule, values).search.status, noise

    np.testing.assert_allclose(status(0.5, LEAST)[1], 10 * eps * 400, rtol=10 * eps)
    assert status(0.5, LEAST)[0] == CONVERGED
    assert status(2.0, LEAST)[0] == GOING
    assert status(0.5, 1.0)[0] == GOING  # with regularisation the gradient has to be small too


def at_rest(violation, before, penalty, **changes):
    """Return the decision on a search that no step improves."""
    number = jnp.asarray
    rule = StoppingRule(number(1e-9), number(1e-6), number(100), number(1.0))
    now = initial_search_state(rule, True, number(penalty))._replace(
        feasible=number(True), reg=number(MOST), violation_before=number(before), **changes
    )
    n = len(LENGTHS)
    values = IterationValues(
        number(9.0), number(0.0), number(violation), number(-1.0), number(1.0), number(1.0),
        number(True), jnp.full(n, 9.0), jnp.full(n, violation), None,
    )  # fmt: skip
    none = lambda values, lengths: (lengths > 1, number(0.5))  # noqa: E731
    return decide(none, True, True, now, rule, values)


@pytest.mark.parametrize(("violation", "before", "penalty", "status", "after"), [
    (0.2, 1.0, 1e7, GOING, 1e7), (0.5, 1.0, 1e7, GOING, 1e8), (2.0, 1.0, 1e5, GOING, 1e6),
    (2.0, 1.0, 1e6, STUCK, 1e6), (1e-7, 1.0, 1e5, GOING, 1e4), (1e-7, 1.0, 1e3, STUCK, 1e3),
])  # fmt: skip
def test_with_constraints_a_search_at_rest_gets_new_multipliers(
    violation, before, penalty, status, after
):
    """They may reduce the violation; if there is none, a smaller penalty has less rounding."""
    found = at_rest(violation, before, penalty, stalled=jnp.asarray(7))
    assert (int(found.search.status), float(found.search.penalty)) == (status, after)
    renewed = status == GOING
    assert bool(found.new_multipliers) == renewed
    if renewed:
        assert found.search.reg == LEAST and found.search.stalled == 0
        # a softer penalty has a violation of its own
        assert found.search.violation_before == (jnp.inf if after < penalty else violation)


@pytest.mark.parametrize(("dtype", "violation", "status", "after"), [
    ("float32", 3e-6, GOING, 1e7), ("float32", 3e-5, STUCK, 1e6), ("float64", 3e-6, STUCK, 1e6),
])  # fmt: skip
def test_a_violation_below_rounding_gets_a_harder_penalty(dtype, violation, status, after):
    """penalty c^2 / 2 is less than the rounding error of the cost, so the merit function cannot
    reduce the violation c."""
    with jax.enable_x64(dtype == "float64"):
        found = at_rest(violation, violation, 1e6)
        assert (int(found.search.status), float(found.search.penalty)) == (status, after)


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_cost_that_falls_by_rounding_only_ends_as_stuck(dtype):
    """The first cost is the reference; one that falls by more than rounding is the next."""
    with jax.enable_x64(dtype == "float64"):
        reference, stalled, one = jnp.asarray(jnp.inf), jnp.asarray(0), jnp.asarray(True)
        eps = float(jnp.finfo(reference.dtype).eps)
        for k in range(3):
            reference, stalled = count_stalled(reference, stalled, jnp.asarray(1.0 - k * eps), one)
        assert (float(reference), int(stalled)) == (1.0, 2)
        low = jnp.asarray(1.0 - 100 * eps)
        reference, stalled = count_stalled(reference, stalled, low, one)
        assert (reference, int(stalled)) == (low, 0)
        # gaps are being closed
        reference, stalled = count_stalled(reference, stalled, jnp.asarray(5.0), ~one)
        assert (float(reference), int(stalled)) == (5.0, 0)


@pytest.mark.parametrize("method", STEPPING)
def test_a_cost_of_zero_at_the_guess_is_an_optimum(method):
    s = solve(Problem(LINE, 4, 0.1, running=[Control(), lambda t, x, u: x]), jnp.zeros(1),
              method=method)  # fmt: skip
    assert s.success and float(s.cost) == 0.0 and int(s.iterations) <= 2
