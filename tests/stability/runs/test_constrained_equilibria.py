"""Equilibria and linearised motions of models with constraints: against a model in coordinates
that need none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc

#: a pendulum on a hinge, and the same as a free body on a revolute joint
INERTIA = '<inertial pos="0 0 -0.5" mass="2" diaginertia="0.1 0.2 0.3"/>'
HINGED = rb.load(
    f'<mujoco><worldbody><body name="b"><joint axis="0 1 0" damping="0.4"/>{INERTIA}</body>'
    "</worldbody></mujoco>"
)


def free(dtype: type = jnp.float64) -> tuple[rb.Model, rb.State]:
    model = rb.load(
        f'<mujoco><worldbody><body name="b"><freejoint/>{INERTIA}</body></worldbody></mujoco>'
    )
    joint = rc.Revolute.between(model, None, "b", axis=[0, 1, 0])
    state = jax.tree.map(lambda x: x.astype(dtype), model.default_state())
    return model.with_constraints(joint), state


@pytest.mark.parametrize("dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.slow)])
def test_an_equilibrium_is_on_the_constraints(dtype: type) -> None:
    model = rb.load("four_bar")
    guess = jax.tree.map(lambda x: x.astype(dtype), model.default_state())
    guess = guess.replace(q=guess.q + jnp.array([0.4, -0.3, 0.2], dtype))
    found = rb.stability.equilibrium(model, guess)
    near = 1e-12 if dtype == jnp.float64 else 1e-4
    assert np.abs(rc.residual(model, found).value).max() < near
    tau = rb.applied_forces(model, found)
    a = rc.constrained_dynamics(model, found.q, found.v, tau).acceleration
    assert np.abs(a).max() < 100 * near


@pytest.mark.slow
def test_reduced_matrices_are_those_of_minimal_coordinates() -> None:
    """A free body on a revolute joint has the matrices of a hinge, in some basis."""
    model, state = free()
    damper = rb.load(
        f'<mujoco><worldbody><body name="b"><joint axis="0 1 0"/>{INERTIA}</body></worldbody>'
        "</mujoco>"
    )
    want = np.asarray(rb.linearise(damper, damper.default_state()).A)
    full = rb.linearise(model, state)
    assert full.A.shape == (12, 12)
    found = rb.stability.reduced_linearisation(model, state)
    assert found.A.shape == (2, 2) and found.basis.shape == (12, 2) and found.B.shape == (2, 0)
    np.testing.assert_allclose(np.poly(found.A), np.poly(want), rtol=0, atol=1e-9)
    stepped = rb.stability.reduced_linearisation(model, state, dt=0.01)
    due = np.linalg.eigvals(np.asarray(rb.linearise(damper, damper.default_state(), dt=0.01).A))
    order = lambda x: np.sort_complex(np.asarray(x))  # noqa: E731
    np.testing.assert_allclose(order(np.linalg.eigvals(stepped.A)), order(due), atol=1e-8)


def test_state_matrix_has_the_constraints() -> None:
    model, state = free()
    found = rb.stability.state_matrix(model, state)
    np.testing.assert_allclose(found, rb.linearise(model, state).A, rtol=0, atol=1e-12)
    frequencies = np.abs(np.linalg.eigvals(np.asarray(found)))
    want = np.sqrt(2 * 9.81 * 0.5 / (0.2 + 2 * 0.25))
    np.testing.assert_allclose(np.sort(frequencies)[-2:], want, rtol=1e-9)


def test_without_constraints_nothing_is_reduced() -> None:
    found = rb.stability.reduced_linearisation(HINGED, HINGED.default_state())
    np.testing.assert_array_equal(found.basis, np.eye(2))
    np.testing.assert_array_equal(found.A, rb.linearise(HINGED, HINGED.default_state()).A)


def test_what_has_no_equilibrium_is_reported() -> None:
    model, state = free()
    off = state.replace(q=state.q.at[0].add(0.1))
    with pytest.raises(rb.InputError, match="off the constraints by 1"):
        rb.stability.reduced_linearisation(model, off)
    with pytest.raises(rb.InputError, match="steps is 0"):
        rb.stability.equilibrium(model, state, steps=0)
    with pytest.raises(rb.InputError, match="is left after 1 steps"):
        rb.stability.equilibrium(HINGED, rb.State(jnp.array([1.0]), jnp.zeros(1)), steps=1)

    class Speed(rc.Constraint):
        size = 1

        def rows(self, context: rb.forces.Context) -> list[rc.Row]:
            return [rc.coordinate(context, 0).time_derivative - 0.3]

    with pytest.raises(rb.InputError, match="demand rates of 3"):
        moving = HINGED.with_constraints(Speed())
        rb.stability.equilibrium(moving, HINGED.default_state())
