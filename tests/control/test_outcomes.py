"""Every outcome of the methods of `solve` is reached, in single and in double precision."""

import jax
import jax.numpy as jnp
import pytest

from rbjax.control import Constraint, Control, Equations, Problem, solve
from rbjax.control.outcome import BUDGET, CONVERGED, INFEASIBLE, NOT_FINITE, SENTENCES, STUCK

LINE = Equations(lambda t, x, u: u, 1, 1)
BENT = Equations(lambda t, x, u: jnp.sin(3 * x) + u, 1, 1)


def plain(**more):
    return Problem(LINE, 3, 1.0, running=[Control()], terminal=[lambda t, x, u: x], **more)


def kinked():
    def cost(t, x, u):
        return jnp.sqrt(jnp.abs(x[0] - 0.37) + 0.3 * jnp.abs(u[0]) + 1e-30)

    return Problem(LINE, 6, 0.1, running=[cost])


def contradictory():
    above = Constraint(lambda t, x, u: x, 2.0, 3.0, "end", "above")
    return plain(constraints=[above, Constraint(lambda t, x, u: x, -3.0, -2.0, "end", "below")])


def bent():
    return Problem(BENT, 8, 0.3, running=[Control()], terminal=[lambda t, x, u: 30 * (x - 2.0)])


#: problem, iterations, first controls
CASES = {
    CONVERGED: (plain, 200, None),
    BUDGET: (bent, 1, None),
    INFEASIBLE: (contradictory, 500, None),
    NOT_FINITE: (lambda: Problem(LINE, 3, 1.0, running=[Control()],
                                 terminal=[lambda t, x, u: jnp.log(x - 5.0)]), 20, None),
    STUCK: (kinked, 200, 0.0),
}  # fmt: skip
STEPPING = {"ddp", "exact_ddp", "sqp", "exact_sqp"}
#: outcomes that a method does not reach by these problems: why
NEVER = {
    (STUCK, "hermite_simpson"): "regularisation makes steps within rounding, until the budget ends",
    (STUCK, "bfgs"): "its line search ends at the kink",
    (STUCK, "ddp", "float32"): "test_verdict reaches it, from another guess",
    (STUCK, "exact_ddp", "float32"): "steps within rounding, until the budget ends",
    (STUCK, "sqp", "float32"): "steps within rounding, until the budget ends",
    (STUCK, "exact_sqp", "float32"): "steps within rounding, until the budget ends",
}
METHODS = [*sorted(STEPPING), "hermite_simpson", "bfgs"]
TABLE = [
    pytest.param(outcome, method, dtype, marks=() if method == "ddp" and dtype == "float64" else
                 pytest.mark.slow, id=f"{SENTENCES[outcome].split(':')[0]}-{method}-{dtype}")
    for outcome in CASES for method in METHODS for dtype in ("float32", "float64")
    if (outcome, method) not in NEVER and (outcome, method, dtype) not in NEVER
]  # fmt: skip


@pytest.mark.parametrize(("outcome", "method", "dtype"), TABLE)
def test_an_outcome_is_reached_and_said(outcome, method, dtype):
    make, iterations, first = CASES[outcome]
    with jax.enable_x64(dtype == "float64"):
        problem = make()
        ctrls = None if first is None else jnp.full((problem.horizon, 1), first)
        found = solve(problem, jnp.ones(1) * (first is None), method=method, ctrls=ctrls,
                      iterations=iterations, violation=1e-4)  # fmt: skip
        assert found.cost.dtype == dtype
        assert int(found.outcome) == outcome, found.status
        assert found.status.startswith(SENTENCES[outcome].split(":")[0])
