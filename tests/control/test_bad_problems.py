"""Problems that have no answer, or say nonsense: each method names what is wrong, none returns nan
without saying so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import Constraint, Control, Cost, Equations, Problem, StateError, methods, solve
from rbjax.control.status import BUDGET, CONVERGED, FINISHED, INFEASIBLE, NOT_FINITE, STUCK
from rbjax.errors import InputError, UnknownName

METHODS = [m if m == "ddp" else pytest.param(m, marks=pytest.mark.slow) for m in methods()]
HOLDING = [m for m in methods() if methods()[m].constraints]
# these weigh constraints against costs, and cannot tell what is infeasible from what is not found
WEIGHING = ("predictive", "mppi", "cross_entropy", "adam")
START = jnp.ones(1)


def system(f=lambda t, x, u: u):
    """One unit of control moves the state by one in a step of 1 s."""
    return Equations(f, 1, 1)


def problem(**changes):
    given = {"running": [Control()], "terminal": [lambda t, x, u: x], "bounds": (-1.0, 1.0)}
    return Problem(system(), 3, 1.0, **{**given, **changes})


def whole(solution):
    return all(np.isfinite(x).all() for x in (solution.states, solution.ctrl))


# ------------------------------------------------------------ numbers


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("cost", [
    lambda t, x, u: jnp.nan * x, lambda t, x, u: jnp.log(x - 5.0),
], ids=["nan", "log of a negative number"])  # fmt: skip
def test_a_cost_that_is_nan_is_named(method, cost):
    s = solve(problem(terminal=[cost]), START, method=method, iterations=20)
    assert s.status == NOT_FINITE and "not finite" in s.summary()
    assert whole(s)


@pytest.mark.slow
@pytest.mark.parametrize("method", methods())
def test_dynamics_that_are_nan_are_named(method):
    bad = Problem(system(lambda t, x, u: jnp.sqrt(x - 2.0) + u), 3, 1.0, running=[Control()])
    s = solve(bad, START, method=method, iterations=20)
    assert s.status == NOT_FINITE and "not finite" in s.summary()


@pytest.mark.parametrize("method", METHODS)
def test_a_cost_without_a_derivative_by_controls_has_a_named_end(method):
    """The Hessian of the controls is singular: nothing says which is best."""
    s = solve(problem(running=[lambda t, x, u: 0.0 * u]), START, method=method, iterations=50)
    assert int(s.status) in (CONVERGED, BUDGET, STUCK, FINISHED) and whole(s)
    if s.status == CONVERGED:
        assert abs(float(s.states[-1, 0])) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("method", [m for m in methods() if m != "levenberg_marquardt"])
def test_a_cost_without_a_least_value_has_a_named_end(method):
    """-x^2 with any control: there is no optimum."""
    s = solve(problem(terminal=[lambda t, x, u: -10.0 * (x * x).sum()], bounds=None), START,
              method=method, iterations=20)  # fmt: skip
    assert s.status != CONVERGED and whole(s)


@pytest.mark.parametrize("method", METHODS)
def test_a_goal_out_of_reach_is_approached(method):
    """One unit a step: from 1 the state comes to -2 of a goal of -30."""
    s = solve(problem(running=[Cost(Control(), 1e-6)], terminal=[lambda t, x, u: x + 30.0]), START,
              method=method, iterations=500)  # fmt: skip
    assert whole(s) and int(s.status) in (CONVERGED, BUDGET, FINISHED)
    np.testing.assert_allclose(s.states[-1], -2.0, atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("method", HOLDING)
def test_constraints_that_contradict_each_other_are_named(method):
    both = [Constraint(lambda t, x, u: x, 2.0, 3.0, "end", "above"),
            Constraint(lambda t, x, u: x, -3.0, -2.0, "end", "below")]  # fmt: skip
    s = solve(problem(constraints=both), START, method=method, iterations=500)
    assert s.status == INFEASIBLE or (method in WEIGHING and s.status == BUDGET)
    assert "above" in s.summary() or "below" in s.summary()
    assert whole(s)


@pytest.mark.slow
@pytest.mark.parametrize("method", HOLDING)
def test_a_goal_held_as_a_constraint_out_of_reach_is_named(method):
    far = Constraint(lambda t, x, u: x - 30.0, where="end", name="far")
    s = solve(problem(constraints=[far]), START, method=method, iterations=500)
    assert s.status == INFEASIBLE or (method in WEIGHING and s.status == BUDGET)
    assert "'far'" in s.summary()


def test_a_start_that_is_nan_is_rejected_and_an_outcome_in_traced_code():
    nan = jnp.asarray([jnp.nan])
    with pytest.raises(InputError, match="start has numbers that are not finite"):
        solve(problem(), nan)
    assert jax.jit(lambda x: solve(problem(), x).status)(nan) == NOT_FINITE


# ------------------------------------------------------------ shapes and types


@pytest.mark.parametrize(("said", "make"), [
    ("horizon", lambda: Problem(system(), 0, 1.0, running=[Control()])),
    ("horizon", lambda: Problem(system(), 2.5, 1.0, running=[Control()])),
    ("dt", lambda: Problem(system(), 3, running=[Control()])),
    ("dt", lambda: Problem(system(), 3, -0.1, running=[Control()])),
    ("no cost", lambda: Problem(system(), 3, 1.0)),
    ("low", lambda: problem(bounds=(1.0, -1.0))),
    ("bounds", lambda: problem(bounds=3.0)),
    ("bounds", lambda: problem(bounds="robot")),
    ("constraints", lambda: problem(constraints=[lambda t, x, u: x])),
    ("above high", lambda: Constraint(lambda t, x, u: x, 1.0, -1.0)),
    ("where", lambda: Constraint(lambda t, x, u: x, where="start")),
    ("nan", lambda: Constraint(lambda t, x, u: x, jnp.nan, 1.0)),
    ("weight", lambda: Cost(Control(), -1.0)),
    ("weight", lambda: Cost(Control(), float("nan"))),
    ("arguments", lambda: Cost(lambda x: x)),
    ("free_time", lambda: problem(free_time=(2.0, 1.0))),
    ("free_start", lambda: problem(free_start=[True, False])),
    ("expected", lambda: Problem("robot", 3, 1.0, running=[Control()])),
    ("size", lambda: Equations(lambda t, x, u: x, 0, 1)),
    ("shape", lambda: solve(problem(), jnp.zeros(2))),
    ("states", lambda: solve(problem(), START, states=jnp.zeros((3, 1)))),
    ("ctrl", lambda: solve(problem(), START, ctrl=jnp.zeros((4, 1)))),
    ("parameters", lambda: solve(problem(), START, parameters=jnp.zeros(1))),
    ("iterations", lambda: solve(problem(), START, iterations=0)),
    ("problem", lambda: solve(system(), START)),
    ("shape", lambda: solve(problem(terminal=[lambda t, x, u: jnp.ones((2, 2))]), START)),
    ("shape", lambda: solve(Problem(system(lambda t, x, u: jnp.ones(2)), 3, 1.0,
                                    running=[Control()]), START)),
    ("state", lambda: solve(Problem(rb.load("pendulum"), 3, running=[Control()]), jnp.zeros(2))),
])  # fmt: skip
def test_nonsense_is_refused_by_name(said, make):
    with pytest.raises(InputError, match=said):
        make()


def test_a_method_that_is_not_there_is_named():
    with pytest.raises(UnknownName, match="magic"):
        solve(problem(), START, method="magic")


@pytest.mark.parametrize(("said", "terms"), [
    ("weight", {"running": [Cost(Control(), jnp.ones(3))]}),
    ("bounds", {"constraints": [Constraint(lambda t, x, u: x, jnp.zeros(2), jnp.ones(2))]}),
    ("reference", {"terminal": [StateError(jnp.zeros(2))]}),
])  # fmt: skip
def test_shapes_that_do_not_fit_each_other_are_named(said, terms):
    with pytest.raises(InputError, match=said):
        solve(problem(**terms), START)
