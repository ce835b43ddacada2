"""Direct collocation against closed forms, its orders, and what bad problems return."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.optimal_control import given
from rbjax.control import Constraint, Control, Cost, Design, Equations, Problem, solve
from rbjax.errors import InputError
from rbjax.status import Status

DOUBLE = Equations(lambda t, x, u: jnp.stack([x[1], u[0]]), 2, 1)
ONE = [lambda t, x, u: 1.0]


def goal(x):
    """The end at x."""
    return Constraint(lambda t, y, u: y - jnp.asarray(x, float), where="end", name="goal")


def energy(N=4):
    """From rest to rest over 1 m in 1 s with the least energy."""
    running = [lambda t, x, u: u[0] ** 2]
    return Problem(DOUBLE, N, 1 / N, running=running, constraints=[goal([1, 0])])


@pytest.mark.parametrize("method", ["hermite_simpson", "gauss_legendre", "radau"])
def test_a_cubic_is_exact(method):
    found = solve(energy(), jnp.zeros(2), method=method)
    assert found.success
    assert abs(found.cost - given("minimum_energy")["cost"]) < 1e-10
    t = found.ts
    np.testing.assert_allclose(found.states[:, 0], 3 * t**2 - 2 * t**3, atol=1e-10)
    inside = t[:-1, None] + 0.25 * found.stages.c
    np.testing.assert_allclose(found.stages.ctrl[..., 0], 6 - 12 * inside, atol=1e-8)
    np.testing.assert_allclose(found.ctrl[:, 0], 6 - 12 * (t[:-1] + 0.125), atol=1e-8)


def fastest(start, N=8, guess=2.0):
    """To the origin at rest in the least time, |u| <= 1."""
    problem = Problem(
        DOUBLE, N, guess / N, running=ONE, constraints=[goal([0, 0])], bounds=(-1, 1),
        free_time=(0.1, 20.0),
    )  # fmt: skip
    return solve(problem, jnp.asarray(start, float), method="gauss_legendre_4")


def test_minimum_time_with_a_switch_at_a_knot():
    for start in ([1, 0], [-1, 0], [4, 0]):
        case = next(c for c in given("minimum_time_double_integrator")["cases"] if c["x0"] == start)
        found = fastest(start)
        assert found.success and abs(found.duration - case["T"]) < 1e-8
        assert np.sign(found.ctrl[0, 0]) == case["u_first"]


class Timed(rb.model.record.Record):
    """Rates, and the durations of phases beside them."""

    rates: object
    durations: jax.Array

    def __call__(self, t, x, u):
        return self.rates(t, x, u)


def phases(rates, start, end, signs, durations, each, method):
    """The least time with free switching times: design numbers are the durations of phases, in
    which time runs from k to k + 1. The controls of phase k have its sign, and sizes from half of
    the largest to the largest."""
    count, size = len(durations), np.abs(signs[0])

    def apply(model, p):
        def scaled(t, x, u):
            k = jnp.clip(jnp.floor(t), 0, count - 1).astype(int)
            at = (jnp.arange(count) == k).astype(p.dtype)
            return (at * p).sum() * rates(t, x, (at * jnp.asarray(signs)).sum() / size * u)

        return Equations(Timed(scaled, p), 2, 1)

    guess = jnp.asarray(durations, float)
    problem = Problem(
        Equations(Timed(rates, guess), 2, 1), count * each, 1 / each, terminal=[total_time],
        constraints=[goal(end)], bounds=(size / 2, size), design=Design(apply, guess, 0.01, 20.0),
    )  # fmt: skip
    xs = [jnp.asarray(start, float)]
    for k in range(count * each):
        h, u = durations[k // each] / each / 10, jnp.asarray(signs[k // each])[None]
        x = xs[-1]
        for _ in range(10):
            x = x + h * rates(0.0, x + h / 2 * rates(0.0, x, u), u)
        xs.append(x)
    us = jnp.full((count * each, 1), size)
    return solve(
        problem, xs[0], states=jnp.stack(xs), ctrl=us, method=method, parameters=guess,
        iterations=500,
    )  # fmt: skip


def total_time(model, t, x, u):
    return model.function.durations.sum()


def test_minimum_time_with_free_switching_times():
    for start in ([1, 1], [1, -1], [-2, 3]):
        case = next(c for c in given("minimum_time_double_integrator")["cases"] if c["x0"] == start)
        exact = np.array([case["t_switch"], case["T"] - case["t_switch"]])
        signs = case["u_first"] * np.array([1.0, -1.0])
        found = phases(
            DOUBLE.function, start, [0, 0], signs, exact * [1.1, 0.9], 2, "gauss_legendre_4"
        )
        assert found.success
        assert abs(found.parameters.sum() - case["T"]) < 1e-8
        np.testing.assert_allclose(found.parameters, exact, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("limit, count", [("5", 3), ("3", 4), ("2", 6)])
def test_a_pendulum_swings_up_in_the_least_time(limit, count):
    case = given("pendulum_minimum_time")["cases"][limit]
    exact = np.diff([0.0, *case["switch_times"], case["T"]])
    durations = exact * (1 + 0.03 * np.cos(np.arange(count)))  # a guess 3 % off

    def rates(t, x, u):
        return jnp.stack([x[1], -9.81 * jnp.sin(x[0]) + u[0]])

    signs = case["u_first"] * (-1.0) ** np.arange(count)
    # 12 steps a phase: four, of 0.3 s, are 1e-6 off by themselves
    found = phases(rates, [0, 0], [np.pi, 0], signs, durations, 12, "gauss_legendre_8")
    assert found.success
    assert abs(found.parameters.sum() - case["T"]) < 1e-8


def test_a_brachistochrone_is_a_cycloid():
    def rates(t, x, u):
        return jnp.stack([x[2] * jnp.cos(u[0]), -x[2] * jnp.sin(u[0]), 9.81 * jnp.sin(u[0])])

    case = given("brachistochrone")["cases"][0]
    end = jnp.array([case["x"], -case["drop"]])
    N = 8
    problem = Problem(
        Equations(rates, 3, 1), N, case["T_straight_line"] / N, running=ONE,
        constraints=[Constraint(lambda t, x, u: x[:2] - end, where="end")], free_time=(0.1, 5.0),
    )  # fmt: skip
    guess = jnp.linspace(0, 1, N + 1)[:, None] * jnp.array([*end, 4.0])
    found = solve(
        problem, jnp.zeros(3), states=guess, ctrl=jnp.full((N, 1), 0.8), method="gauss_legendre"
    )
    assert found.success and abs(found.duration - case["T"]) < 1e-9
    angles = found.stages.ctrl[..., 0]
    t = found.ts[:-1, None] + found.duration / N * found.stages.c
    exact = np.pi / 2 - 0.5 * t * np.sqrt(9.81 / case["radius"])
    off = jnp.arctan2(jnp.sin(angles - exact), jnp.cos(angles - exact))  # whole turns are alike
    np.testing.assert_allclose(off, 0, atol=1e-6)


def smooth(N, method):
    """The cost of a pendulum pushed to a place with a soft end."""
    system = Equations(lambda t, x, u: jnp.stack([x[1], -jnp.sin(x[0]) + u[0]]), 2, 1)
    end = Cost(lambda t, x, u: x - jnp.array([1.0, 0.0]), 10.0)
    problem = Problem(system, N, 2.0 / N, running=[Control()], terminal=[end])
    found = solve(problem, jnp.zeros(2), method=method, tolerance=1e-15)
    return found


@functools.cache
def reference():
    return smooth(24, "gauss_legendre_8")


@pytest.mark.slow
@pytest.mark.parametrize(
    "method, order, first",
    [("trapezoidal", 2, 4), ("hermite_simpson", 4, 2), ("gauss_legendre_4", 4, 2),
     ("radau", 5, 1), ("gauss_legendre", 6, 1)],
)  # fmt: skip
def test_orders_over_four_halvings(method, order, first):
    exact = reference()
    horizons = [first * 2**k for k in range(5)]
    last = [smooth(N, method) for N in horizons]
    assert all(x.success for x in last)
    errors = np.array([np.abs(x.states[-1] - exact.states[-1]).max() for x in last])
    seen = np.log2(errors[:-1] / errors[1:])
    above = errors[1:] > 1e-12  # what is not rounding
    assert above.sum() >= 2
    assert seen[above][-1] > order - 0.3


@pytest.mark.slow
def test_an_attitude_turns_on_its_manifold():
    motors = "".join(f"<motor joint='b' gear='{g}'/>" for g in ("1 0 0", "0 1 0", "0 0 1"))
    model = rb.load(
        "<mujoco><option gravity='0 0 0'/><worldbody><body><joint name='b' type='ball'/><inertial "
        f"pos='0 0 0' mass='1' diaginertia='.1 .1 .1'/></body></worldbody><actuator>{motors}"
        "</actuator></mujoco>"
    )
    start, turn = model.default_state(), jnp.array([0.3, -0.2, 0.4])
    end = rb.State(rb.integrate(model, start.q, turn), start.v)
    there = Constraint(rb.control.StateError(end), where="end", name="turned")
    problem = Problem(model, 4, 0.25, running=[Cost(Control(), 2.0)], constraints=[there])
    found = solve(problem, start, method="gauss_legendre_4")
    assert found.success and found.gap < 1e-9
    # a sphere turns about one axis: 12 (I angle)^2
    assert abs(found.cost - 12 * 0.1**2 * (turn**2).sum()) < 1e-8
    np.testing.assert_allclose((found.states.q**2).sum(-1), 1, atol=1e-12)


def test_constraints_on_the_path():
    top = 1.2
    fast = Constraint(lambda t, x, u: x[1], -jnp.inf, top, name="speed")
    problem = Problem(
        DOUBLE, 12, 1 / 12, running=[lambda t, x, u: u[0] ** 2],
        constraints=[goal([1, 0]), fast], bounds=(-20, 20),
    )  # fmt: skip
    found = solve(problem, jnp.zeros(2), method="radau")
    assert found.success and found.violation <= 1e-6
    # v rises as top (1 - (1 - t / r)^2) within r, and covers 2/3 top r: 1 = top (1 - 2 r / 3)
    ramp = 1.5 * (1 - 1 / top)
    exact = 2 * 4 * top**2 / (3 * ramp)
    assert abs(found.cost - exact) < 2e-3 * exact
    assert found.violations.shape == (2,)


def test_what_cannot_be_held_is_named():
    wall = Constraint(lambda t, x, u: x[0], -jnp.inf, 0.5, where="all", name="wall")
    problem = Problem(
        DOUBLE, 4, 0.25, running=[Control()], constraints=[goal([1, 0]), wall]
    )  # fmt: skip
    found = solve(problem, jnp.zeros(2), method="gauss_legendre_4")
    assert found.summary().startswith("infeasible")
    assert np.isfinite(found.cost) and found.violation > 0.1


def test_a_goal_out_of_reach():
    problem = Problem(
        DOUBLE, 4, 0.25, running=[Control()], constraints=[goal([1, 0])], bounds=(-1, 1)
    )
    found = solve(problem, jnp.zeros(2), method="gauss_legendre_4")
    assert found.summary().startswith("infeasible")
    assert np.abs(found.stages.ctrl).max() <= 1


def test_a_cost_that_is_nan():
    problem = Problem(DOUBLE, 4, 0.25, running=[lambda t, x, u: jnp.log(x[0] - 1) + u[0] ** 2])
    found = solve(problem, jnp.zeros(2), method="gauss_legendre_4")
    assert found.summary().startswith("not finite")
    assert np.isfinite(found.ctrl).all()


def test_a_singular_hessian():
    flat = [lambda t, x, u: x[0] ** 2]  # nothing of u
    found = solve(Problem(DOUBLE, 4, 0.25, running=flat), jnp.ones(2), method="gauss_legendre_4")
    assert np.isfinite(found.cost) and np.isfinite(found.ctrl).all()
    assert int(found.status) in set(Status) - {Status.GOING}


def test_discrete_systems_are_refused():
    system = Equations(lambda t, x, u: x + u, 1, 1, discrete=True)
    problem = Problem(system, 3, 1.0, running=[Control()])
    with pytest.raises(InputError, match="discrete=True"):
        solve(problem, jnp.zeros(1), method="hermite_simpson")
