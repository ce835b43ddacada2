"""`rb.recommend.control_method`: the fastest of the methods that converge, with its numbers."""

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import Constraint, Control, Cost, Equations, Problem
from rbjax.errors import InputError, UnknownName
from rbjax.recommend.control_methods import MethodTrial, _best, _reason

SYSTEM = Equations(lambda t, x, u: x + u, 1, 1, discrete=True)
PROBLEM = Problem(SYSTEM, 3, 1.0, running=[Control()], terminal=[lambda t, x, u: x])


@pytest.mark.slow
def test_a_method_is_tried_and_named():
    r = rb.recommend.control_method(
        PROBLEM, jnp.ones(1), candidates=["ddp", "exact_ddp"], guesses=3, progress=False
    )
    assert r.name in ("ddp", "exact_ddp") and r.name in r.reason and "3 of 3" in r.reason
    assert [t.solved for t in r.candidates] == [1.0, 1.0] and r.guesses.shape == (3, 3, 1)
    s = rb.control.solve(PROBLEM, jnp.ones(1), method=r.name)
    np.testing.assert_allclose(r.objective, s.cost)
    assert r.cost == next(t.cost for t in r.candidates if t.name == r.name)
    assert r.name in r.summary() and r.table().splitlines()[0].startswith("name")


@pytest.mark.slow
def test_where_nothing_converges_it_says_so():
    up = Problem(SYSTEM, 2, 1.0, running=[lambda t, x, u: -(u * u + u).sum()])
    r = rb.recommend.control_method(
        up, jnp.ones(1), candidates=["ddp"], guesses=2, iterations=5, progress=False
    )
    assert "none converges" in r.reason and r.candidates[0].failed == (0, 1)


def test_the_fastest_of_those_with_the_least_cost_is_taken():
    def trial(name, status, cost, ms):
        return MethodTrial(name, status, cost, 7, ms, 1.0, ())

    trials = [trial("a", "converged", 2.0, 1.0), trial("b", "converged", 1.0, 9.0),
              trial("c", "converged", 1.0 + 1e-9, 5.0), trial("d", "stuck", 0.5, 0.1)]  # fmt: skip
    assert _best(trials).name == "c"
    said = _reason(_best(trials), trials, 4)
    assert said.startswith("'c': converged in 7 iterations and 5 ms") and "'d' stuck" in said


@pytest.mark.parametrize(("how", "kind"), [
    ({"candidates": ["magic"]}, UnknownName), ({"candidates": []}, InputError),
    ({"guesses": 0}, InputError),
])  # fmt: skip
def test_bad_requests_are_refused(how, kind):
    with pytest.raises(kind):
        rb.recommend.control_method(PROBLEM, jnp.ones(1), progress=False, **how)
    with pytest.raises(InputError):
        rb.recommend.control_method(SYSTEM, jnp.ones(1), progress=False)


def test_a_constraint_leaves_those_that_hold_it():
    held = Problem(SYSTEM, 3, 1.0, running=[Cost(Control())],
                   constraints=[Constraint(lambda t, x, u: x)])  # fmt: skip
    unable = [k for k, m in rb.control.methods().items() if not m.constraints]
    for name in unable:
        with pytest.raises(InputError, match="holds no constraints"):
            rb.recommend.control_method(held, jnp.ones(1), candidates=[name], progress=False)
