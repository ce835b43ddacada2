"""Every outcome of every method of `solve`, and every result of the linear solvers, is reached, in
single and in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.control import (
    Constraint,
    Control,
    Equations,
    LinearStatus,
    Problem,
    Sampling,
    lqr,
    solve,
)
from rbjax.control.linear import lyapunov
from rbjax.control.status import (
    BUDGET,
    CONVERGED,
    FINISHED,
    INFEASIBLE,
    NOT_FINITE,
    STUCK,
)
from rbjax.status import Status

TEXT = {int(x): x.text.split(":")[0] for x in Status}
LINE = Equations(lambda t, x, u: u, 1, 1)
BENT = Equations(lambda t, x, u: jnp.sin(3 * x) + u, 1, 1)


def plain(**more):
    return Problem(LINE, 3, 1.0, running=[Control()], terminal=[lambda t, x, u: x], **more)


def kinked():
    def cost(t, x, u):
        return jnp.sqrt(jnp.abs(x[0] - 0.37) + 0.3 * jnp.abs(u[0]) + 1e-30)

    return Problem(LINE, 6, 0.1, running=[cost])


def misled():
    """A residual whose derivative has the wrong sign: no step along it lowers the cost."""

    @jax.custom_jvp
    def wrong(x):
        return x

    wrong.defjvp(lambda x, dx: (wrong(*x), -dx[0]))
    return Problem(LINE, 3, 1.0, running=[Control()], terminal=[lambda t, x, u: 1 + wrong(x)])


def contradictory():
    above = Constraint(lambda t, x, u: x, 2.0, 3.0, "end", "above")
    return plain(constraints=[above, Constraint(lambda t, x, u: x, -3.0, -2.0, "end", "below")])


def bent():
    return Problem(BENT, 8, 0.3, running=[Control()], terminal=[lambda t, x, u: 30 * (x - 2.0)])


def log_of_a_negative_number():
    cost = lambda t, x, u: jnp.log(x - 5.0)  # noqa: E731
    return Problem(LINE, 3, 1.0, running=[Control()], terminal=[cost])


#: problem, iterations
CASES = {
    CONVERGED: (plain, 200),
    BUDGET: (bent, 1),
    INFEASIBLE: (contradictory, 500),
    NOT_FINITE: (log_of_a_negative_number, 20),
    STUCK: (misled, 1000),
    FINISHED: (plain, 300),
}
FEW = {"samples": 64, "points": 3, "cooling": 0.8}
SAMPLING = {name: Sampling(name, **FEW) for name in ("predictive", "mppi", "cross_entropy")}
METHODS = {name: name for name in (
    "ddp", "exact_ddp", "sqp", "exact_sqp", "hermite_simpson", "gauss_legendre", "radau", "adam",
    "bfgs", "levenberg_marquardt",
)} | SAMPLING | {"sampled_ddp": Sampling(**FEW, ddp_after=2)}  # fmt: skip
#: outcomes that a method cannot have
NEVER = {(CONVERGED, name) for name in SAMPLING} | {(STUCK, name) for name in SAMPLING}
NEVER |= {(FINISHED, name) for name in METHODS if name not in SAMPLING}
TABLE = [
    pytest.param(outcome, method, dtype, id=f"{TEXT[outcome]}-{method}-{dtype}")
    for outcome in CASES for method in METHODS for dtype in ("float32", "float64")
    if (outcome, method) not in NEVER
]  # fmt: skip


@pytest.mark.parametrize("method", ["sqp", "exact_sqp"])
def test_a_stuck_search_ends_with_a_motion(method):
    """At the knots of the guess the cost is zero, but the motion from the start goes elsewhere."""
    step = lambda t, x, u: jnp.where(jnp.abs(x - 1) < 1e-3, x + u, 9.0)  # noqa: E731
    system = Equations(step, 1, 1, discrete=True)
    problem = Problem(system, 4, 0.1, running=[Control()], terminal=[lambda t, x, u: x - 1])
    found = solve(problem, jnp.zeros(1), method=method, states=jnp.ones((5, 1)))
    assert found.status == STUCK and found.gap == 0
    np.testing.assert_array_equal(found.states[:, 0], [0, 9, 9, 9, 9])
    cost = 0.5 * (0.1 * (found.ctrl**2).sum() + 8.0**2)
    np.testing.assert_allclose(found.cost, cost, rtol=1e-12)


#: A, B, Q, R of a regulator in continuous time
LINEAR = {
    "success": (0.0, 1.0, 1.0, 1.0),
    "not_finite": (jnp.nan, 1.0, 1.0, 1.0),
    "indefinite_control_cost": (0.0, 1.0, 1.0, -1.0),
    "not_stabilisable": (1.0, 0.0, 1.0, 1.0),
    "no_stabilising_solution": (0.0, 1.0, 0.0, 1.0),
}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_every_result_of_a_linear_solver_is_reached(dtype):
    """Traced, where a failure is a value."""
    reached = {"not_stable"}
    with jax.enable_x64(dtype == "float64"):
        program = jax.jit(lambda *x: lqr(*x).status)
        for name, numbers in LINEAR.items():
            found = program(*(jnp.full((1, 1), x) for x in numbers))
            assert bool(found == getattr(LinearStatus, name)), name
            reached.add(name)
        found = jax.jit(lambda A: lyapunov(A, jnp.eye(1)).status)(jnp.ones((1, 1)))
        assert bool(found == LinearStatus.not_stable)
    assert len(reached) == len(LinearStatus)


@pytest.mark.slow
@pytest.mark.parametrize(("outcome", "method", "dtype"), TABLE)
def test_an_outcome_is_reached_and_said(outcome, method, dtype):
    check(outcome, method, dtype)


def check(outcome, method, dtype):
    make, iterations = CASES[outcome]
    with jax.enable_x64(dtype == "float64"):
        found = solve(make(), jnp.ones(1), method=METHODS[method], iterations=iterations,
                      violation=1e-4)  # fmt: skip
        assert found.cost.dtype == dtype
        assert int(found.status) == outcome, found.summary()
        assert bool(found.success) == (outcome == CONVERGED)
        assert found.summary().startswith(TEXT[outcome])
