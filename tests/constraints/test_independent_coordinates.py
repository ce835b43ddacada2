"""Coordinate partitioning: only the independent coordinates are integrated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.equations.projection import eliminate, project_state, solve_dependent

MODEL = rb.load("four_bar")


def start() -> rb.State:
    """A consistent state in motion."""
    state = MODEL.default_state()
    return rc.assemble(MODEL, rb.State(state.q + 0.1, state.v + 1.0)).state


def perturbed() -> tuple[rb.State, rb.State]:
    first = start()
    return first, rb.State(first.q + jnp.linspace(0.02, 0.04, MODEL.nq), first.v + 0.1)


def test_independent_coordinates_do_not_change() -> None:
    first, state = perturbed()
    end = solve_dependent(MODEL, 0.0, state, 0.0, first)
    _, chosen = eliminate(rc.jacobian(MODEL, first.q))
    independent = ~np.asarray(chosen.any(0))
    assert independent.sum() == rc.mobility(MODEL, first.q).freedoms
    np.testing.assert_allclose(end.q[independent], state.q[independent], rtol=0, atol=1e-14)
    np.testing.assert_allclose(end.v[independent], state.v[independent], rtol=0, atol=1e-14)
    value, rate = rc.residual(MODEL, end)
    assert abs(value).max() < 1e-13 and abs(rate).max() < 1e-12
    assert abs(end.q - state.q).max() > 1e-3


def test_the_derivative_is_that_of_the_constraints() -> None:
    first, state = perturbed()

    def end(q, v):
        found = solve_dependent(MODEL, 0.0, rb.State(q, v), 0.0, first, iterations=8)
        return jnp.concatenate([found.q, found.v])

    dq, dv = jnp.linspace(1.0, -0.5, MODEL.nq), jnp.linspace(0.3, 0.9, MODEL.nv)
    _, slope = jax.jvp(end, (state.q, state.v), (dq, dv))
    h = 1e-6
    forward, back = (end(state.q + s * dq, state.v + s * dv) for s in (h, -h))
    np.testing.assert_allclose(slope, (forward - back) / (2 * h), rtol=0, atol=2e-8)


@pytest.mark.slow
def test_a_motion_stays_on_the_constraints_and_is_that_of_others() -> None:
    runs = {
        name: rb.rollout(MODEL, start(), None, 1e-3, steps=200, integrator="rk4", constraints=name)
        for name in ("partitioning", "tangent_space")
    }
    last = jax.tree.map(lambda x: x[-1], rb.State(runs["partitioning"].q, runs["partitioning"].v))
    value, rate = rc.residual(MODEL, last)
    assert abs(value).max() < 1e-12 and abs(rate).max() < 1e-11
    np.testing.assert_allclose(runs["partitioning"].q, runs["tangent_space"].q, rtol=0, atol=1e-9)


def test_project_state_with_and_without_positions() -> None:
    _, state = perturbed()
    before = abs(rc.residual(MODEL, state).value).max()
    after = abs(rc.residual(MODEL, project_state(MODEL, 0.0, state)).value).max()
    same = project_state(MODEL, 0.0, state, positions=False)
    assert after < 1e-3 * before
    np.testing.assert_array_equal(same.q, state.q)
    assert abs(rc.residual(MODEL, same).rate).max() < 1e-5
