"""Problems that have no answer, or say nonsense: each method names what is wrong, none returns nan
without saying so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import Constraint, Control, Cost, Equations, Problem, StateError, methods, solve
from rbjax.control.optimal.system import system_of
from rbjax.control.status import BUDGET, CONVERGED, FINISHED, INFEASIBLE, NOT_FINITE, STUCK
from rbjax.errors import InputError

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


@pytest.mark.parametrize(("said", "terms"), [
    ("weight", {"running": [Cost(Control(), jnp.ones(3))]}),
    ("bounds", {"constraints": [Constraint(lambda t, x, u: x, jnp.zeros(2), jnp.ones(2))]}),
    ("reference", {"terminal": [StateError(jnp.zeros(2))]}),
    ("shape", {"terminal": [lambda t, x, u: jnp.ones((2, 2))]}),
])  # fmt: skip
def test_shapes_that_do_not_fit_each_other_are_named(said, terms):
    with pytest.raises(InputError, match=said):
        solve(problem(**terms), START)


def test_states_and_rates_that_do_not_fit_the_system_are_named():
    model = Problem(rb.load("pendulum"), 3, running=[Control()])
    with pytest.raises(InputError, match="the state is"):
        solve(model, jnp.zeros(2))
    two = system(lambda t, x, u: jnp.ones(2))
    with pytest.raises(InputError, match="shape"):
        solve(Problem(two, 3, 1.0, running=[Control()]), START)
    with pytest.raises(InputError, match="dt is None"):
        Problem(two, 3, running=[Control()])
    with pytest.raises(InputError, match="no cost"):
        Problem(two, 3, 1.0)


def test_an_integrator_is_for_a_model():
    for given in ({"integrator": "rk4"}, {"dynamics": 3}, {"constraints": "kkt"}):
        with pytest.raises(InputError, match="f: integrator, dynamics and constraints are for"):
            system_of("f", system(), **given)
