"""Derivatives of optima, against closed forms and differences of problems that are solved again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import Constraint, Control, Cost, Design, Equations, Problem, StateError, solve

TIGHT = {"tolerance": 1e-18, "violation": 1e-12}


def differences(f, p, h=1e-5):
    columns = [(f(p.at[i].add(h)) - f(p.at[i].add(-h))) / (2 * h) for i in range(len(p))]
    return np.stack(columns, -1)


def one_step(weight, target, start):
    """min w u^2 / 2 + (x + u - b)^2 / 2: u = (b - x) / (1 + w), cost w (b - x)^2 / (2 (1 + w))."""
    system = Equations(lambda t, x, u: x + u, 1, 1, discrete=True)
    problem = Problem(
        system, 1, 1.0, running=[Cost(Control(), weight)], terminal=[lambda t, x, u: x - target]
    )
    return solve(problem, start[None], **TIGHT)


def test_the_closed_form_of_one_step():
    w, b, x = 0.5, 2.0, 0.3

    def parts(*p):
        s = one_step(*p)
        return jnp.stack([s.ctrl[0, 0], s.cost])

    found = np.stack(jax.jacrev(parts, (0, 1, 2))(*map(jnp.asarray, (w, b, x))), 1)
    slope = w * (b - x) / (1 + w)
    of_control = [-(b - x) / (1 + w) ** 2, 1 / (1 + w), -1 / (1 + w)]
    of_cost = [(b - x) ** 2 / (2 * (1 + w) ** 2), slope, -slope]
    np.testing.assert_allclose(found, [of_control, of_cost], 1e-12)


def bounded(p):
    """A pendulum whose torque and speed are at their bounds for a while; all is in closures."""
    weight, target, bound, fastest, g, start = p

    def motion(t, x, u):
        return jnp.stack([x[1], u[0] - g * jnp.sin(x[0])])

    problem = Problem(
        Equations(motion, 2, 1), 12, 0.1,
        running=[Cost(Control(), weight), lambda t, x, u: 0.3 * jnp.stack([x[0] - target])],
        terminal=[Cost(lambda t, x, u: x - jnp.stack([target, 0.0 * target]), 50.0)],
        bounds=(-bound, bound),
        constraints=[Constraint(lambda t, x, u: x[1], -jnp.inf, fastest, "all", "speed")],
    )  # fmt: skip
    return solve(problem, jnp.stack([start, 0.0 * start]), **TIGHT)


def parts(s):
    return jnp.concatenate([s.ctrl.ravel(), s.states.ravel(), s.cost[None]])


@pytest.mark.slow
def test_active_bounds_and_constraints_forward_reverse_and_within_programs():
    p = jnp.asarray([0.5, 1.0, 2.2, 1.1, 0.7, 0.05])
    s = bounded(p)
    assert bool(s.success)
    assert (jnp.abs(s.ctrl) == p[2]).sum() > 3
    assert (jnp.abs(s.states[:, 1] - p[3]) < 1e-9).sum() > 1
    run = lambda p: parts(bounded(p))  # noqa: E731
    forward = jax.jacfwd(run)(p)
    np.testing.assert_allclose(forward, differences(run, p), atol=1e-6)
    np.testing.assert_allclose(jax.jacrev(run)(p), forward, atol=1e-12)
    number = lambda p: (run(p) ** 2).sum()  # noqa: E731
    due = 2 * run(p) @ forward
    for found in (jax.jit(jax.grad(number))(p), jax.grad(jax.jit(number))(p),
                  jax.jit(jax.vmap(jax.grad(number)))(p[None])[0]):  # fmt: skip
        np.testing.assert_allclose(found, due, rtol=1e-10)


def damped(model, by):
    joints = model.joints
    return model.replace(joints=joints.replace(damping=joints.damping + by))


def reaching(p):
    """A pendulum whose damping, length of time and a number of its design are sought."""
    damping, goal, effort, start = p
    model = rb.load("pendulum")
    model = damped(model, damping)
    rest = model.default_state()
    design = Design(damped, [0.1], 0.0, 5.0)
    problem = Problem(
        model, 8, 0.05,
        running=[Cost(Control(), effort), lambda t, s, u: jnp.ones(1)],
        terminal=[Cost(StateError(rb.State(rest.q + goal, rest.v)), 30.0)],
        bounds=None, design=design, free_time=(0.1, 2.0),
    )  # fmt: skip
    return solve(problem, rb.State(rest.q + start, rest.v), **TIGHT)


@pytest.mark.slow
def test_leaves_of_a_model_a_design_at_its_bound_and_a_free_final_time():
    p = jnp.asarray([0.2, 0.6, 0.3, 0.1])
    assert bool(reaching(p).success)
    assert reaching(p).parameters[0] in (0.0, 5.0)

    def run(p):
        s = reaching(p)
        return jnp.concatenate([s.ctrl.ravel(), s.states.q.ravel(), s.parameters, s.ts[-1:],
                                s.cost[None]])  # fmt: skip

    # a search ends at ten roundings of the cost, so the controls are known to about 1e-10, and the
    # differences to 1e-6 beside their own error in the step
    np.testing.assert_allclose(jax.jacrev(run)(p), differences(run, p, 1e-4), atol=1e-5)


@pytest.mark.slow
def test_a_search_that_has_not_converged_has_finite_derivatives():
    system = Equations(lambda t, x, u: x + u - 0.3 * x**3, 1, 1, discrete=True)

    def cost(b):
        problem = Problem(system, 3, 1.0, running=[Control()], terminal=[lambda t, x, u: x - b])
        return solve(problem, jnp.ones(1), iterations=1, tolerance=1e-18).cost

    assert np.isfinite(jax.grad(cost)(2.0))


@pytest.mark.slow
def test_rows_that_say_the_same_twice_have_a_derivative():
    system = Equations(lambda t, x, u: x + u, 1, 1, discrete=True)

    def first(b):
        at = Constraint(lambda t, x, u: x - b, where="end")
        problem = Problem(system, 2, 1.0, running=[Control()], constraints=[at, at])
        return solve(problem, jnp.zeros(1), **TIGHT).ctrl[0, 0]

    np.testing.assert_allclose(jax.grad(first)(2.0), 0.5, atol=1e-9)
