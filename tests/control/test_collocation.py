"""Direct collocation against closed forms, its orders, and what bad problems return."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import Constraint, Control, Cost, Design, Equations, Problem, solve
from rbjax.errors import InputError
from tests.oracles.optimal_control import given

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
    assert found.status == "converged"
    assert abs(found.cost - given("minimum_energy")["cost"]) < 1e-10
    t = found.ts
    np.testing.assert_allclose(found.states[:, 0], 3 * t**2 - 2 * t**3, atol=1e-10)
    inside = t[:-1, None] + 0.25 * found.between.c
    np.testing.assert_allclose(found.between.ctrls[..., 0], 6 - 12 * inside, atol=1e-8)
    np.testing.assert_allclose(found.ctrls[:, 0], 6 - 12 * (t[:-1] + 0.125), atol=1e-8)


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
        assert found.converged and abs(found.duration - case["T"]) < 1e-8
        assert np.sign(found.ctrls[0, 0]) == case["u_first"]


def phases(rates, durations, each):
    """x' = f with a switch allowed at the ends of phases, whose durations are design numbers, in
    steps of a time that runs from 0 to the number of phases."""
    count = len(durations)

    def apply(model, p):
        def scaled(t, x, u):
            k = jnp.clip(jnp.floor(t), 0, count - 1).astype(int)
            one = (jnp.arange(count) == k).astype(p.dtype)
            return (one * p).sum() * rates(t, x, u)

        return Equations(Timed(scaled, p), model.size, model.controls)

    start = jnp.asarray(durations, float)
    design = Design(apply, start, 0.01, 20.0)
    first = Equations(Timed(rates, start), 2, 1)
    return first, design, each * count, 1 / each


class Timed(rb.model.record.Record):
    """Rates, and the durations of phases beside them."""

    rates: object
    durations: jax.Array

    def __call__(self, t, x, u):
        return self.rates(t, x, u)


def total_time(model, t, x, u):
    return model.function.durations.sum()


def test_minimum_time_with_free_switching_times():
    for start in ([1, 1], [1, -1], [-2, 3]):
        case = next(c for c in given("minimum_time_double_integrator")["cases"] if c["x0"] == start)
        system, design, N, dt = phases(DOUBLE.function, [1.5, 1.5], 2)
        problem = Problem(
            system, N, dt, terminal=[total_time], constraints=[goal([0, 0])], bounds=(-1, 1),
            design=design,
        )  # fmt: skip
        found = solve(problem, jnp.asarray(start, float), method="gauss_legendre_4")
        assert found.converged
        assert abs(found.numbers.sum() - case["T"]) < 1e-8
        assert abs(found.numbers[0] - case["t_switch"]) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("limit, count", [("5", 3), ("3", 4), ("2", 6)])
def test_a_pendulum_swings_up_in_the_least_time(limit, count):
    case, top = given("pendulum_minimum_time")["cases"][limit], float(limit)
    switches = np.array([0.0, *case["switch_times"], case["T"]])
    durations = np.diff(switches) * (1 + 0.1 * np.cos(np.arange(count)))  # a guess 10 % off

    def rates(t, x, u):
        return jnp.stack([x[1], -9.81 * jnp.sin(x[0]) + u[0]])

    signs = case["u_first"] * (-1.0) ** np.arange(count)
    each = 6
    system, design, N, dt = phases(rates, durations, each)
    problem = Problem(
        system, N, dt, terminal=[total_time], constraints=[goal([np.pi, 0])], bounds=(-top, top),
        design=design,
    )  # fmt: skip
    us = jnp.repeat(jnp.asarray(signs), each)[:, None]

    def march(x, u):
        k, v = u
        h = durations[k // each] / each
        for _ in range(10):
            x = x + h / 10 * rates(0.0, x + h / 20 * rates(0.0, x, v), v)
        return x

    xs = [jnp.zeros(2)]
    for k in range(N):
        xs.append(march(xs[-1], (k, us[k])))
    found = solve(
        problem, xs[0], states=jnp.stack(xs), ctrls=us, method="gauss_legendre_8", iterations=500
    )
    assert found.converged
    assert abs(found.numbers.sum() - case["T"]) < 1e-8


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
        problem, jnp.zeros(3), states=guess, ctrls=jnp.full((N, 1), 0.8), method="gauss_legendre"
    )
    assert found.converged and abs(found.duration - case["T"]) < 1e-9
    angles = found.between.ctrls[..., 0]
    t = found.ts[:-1, None] + found.duration / N * found.between.c
    exact = np.pi / 2 - 0.5 * t * np.sqrt(9.81 / case["radius"])
    np.testing.assert_allclose(angles, exact, atol=1e-4)


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
    assert all(x.converged for x in last)
    errors = np.array([np.abs(x.states[-1] - exact.states[-1]).max() for x in last])
    seen = np.log2(errors[:-1] / errors[1:])
    above = errors[1:] > 1e-12  # what is not rounding
    assert above.sum() >= 2
    assert seen[above][-1] > order - 0.3


def test_an_attitude_turns_on_its_manifold():
    model = rb.load(
        "<mujoco><worldbody><body><freejoint/><inertial pos='0 0 0' mass='1' "
        "diaginertia='.1 .2 .3'/></body></worldbody></mujoco>"
    )
    start = model.default_state()
    turned = rb.integrate(model, start.q, jnp.array([0.0, 0, 0, 0.3, -0.2, 0.4]))
    assert model.nu == 0
    error = rb.control.StateError(rb.State(turned, start.v))
    problem = Problem(model, 3, 0.2, running=[Cost(error, 0.1)], terminal=[error], free_start=True)
    guess = rb.State(start.q, start.v + 0.3)
    found = solve(problem, guess, method="gauss_legendre_4")
    assert found.converged and found.cost < 1e-8 and found.gap < 1e-9
    norms = (found.states.q[:, 3:7] ** 2).sum(-1)
    np.testing.assert_allclose(norms, 1, atol=1e-12)


def test_constraints_on_the_path():
    fast = Constraint(lambda t, x, u: x[1], -jnp.inf, 1.2, name="speed")
    problem = Problem(
        DOUBLE, 12, 1 / 12, running=[lambda t, x, u: u[0] ** 2],
        constraints=[goal([1, 0]), fast], bounds=(-8, 8),
    )  # fmt: skip
    found = solve(problem, jnp.zeros(2), method="radau")
    assert found.converged and found.violation <= 1e-6
    # ramps of length 3 T0 in which the speed rises as a parabola: x = 1 gives T0 = 1/4
    top = 1.2
    length = 1 - 1 / top  # of both ramps, each losing a third of top * its duration
    ramp = 1.5 * length
    exact = 2 * 4 * top**2 / (3 * ramp)
    assert abs(found.cost - exact) < 2e-3 * exact
    assert found.violations.shape == (2,)


def test_what_cannot_be_held_is_named():
    wall = Constraint(lambda t, x, u: x[0], -jnp.inf, 0.5, where="all", name="wall")
    problem = Problem(
        DOUBLE, 4, 0.25, running=[Control()], constraints=[goal([1, 0]), wall]
    )  # fmt: skip
    found = solve(problem, jnp.zeros(2), method="gauss_legendre_4")
    assert found.status.startswith("infeasible")
    assert np.isfinite(found.cost) and found.violation > 0.1


def test_a_goal_out_of_reach():
    problem = Problem(
        DOUBLE, 4, 0.25, running=[Control()], constraints=[goal([1, 0])], bounds=(-1, 1)
    )
    found = solve(problem, jnp.zeros(2), method="gauss_legendre_4")
    assert found.status.startswith("infeasible; ") or found.status.startswith("infeasible:")
    assert np.abs(found.between.ctrls).max() <= 1


def test_a_cost_that_is_nan():
    problem = Problem(DOUBLE, 4, 0.25, running=[lambda t, x, u: jnp.log(x[0] - 1) + u[0] ** 2])
    found = solve(problem, jnp.zeros(2), method="gauss_legendre_4")
    assert found.status.startswith("not finite")
    assert np.isfinite(found.ctrls).all()


def test_a_singular_hessian():
    flat = [lambda t, x, u: x[0] ** 2]  # nothing of u
    found = solve(Problem(DOUBLE, 4, 0.25, running=flat), jnp.ones(2), method="gauss_legendre_4")
    assert np.isfinite(found.cost) and np.isfinite(found.ctrls).all()
    assert int(found.outcome) in rb.control.outcome.SENTENCES


def test_discrete_systems_are_refused():
    system = Equations(lambda t, x, u: x + u, 1, 1, discrete=True)
    problem = Problem(system, 3, 1.0, running=[Control()])
    with pytest.raises(InputError, match="discrete=True"):
        solve(problem, jnp.zeros(1), method="hermite_simpson")
