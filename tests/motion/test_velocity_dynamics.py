"""Dynamics with the step and a memory of their own: a floor that a sliding mass hits
inelastically."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.motion.field import free_motion

BALL = '<geom size="0.1" mass="{}" contype="0" conaffinity="0"/>'
XML = f"""<mujoco><worldbody><body><joint type="slide" axis="0 0 1"/>{BALL.format(2)}
<body><joint type="slide" axis="0 0 1"/>{BALL.format(1)}</body></body></worldbody></mujoco>"""
DT = 0.01


@dataclass(frozen=True)
class Floor:
    """Each body stays above the one below it, by impulses l of projected Gauss-Seidel sweeps that
    begin at the impulses of the last step: 0 <= l, 0 <= z + dt z'."""

    sweeps: int

    def initial_memory(self, model):
        return jnp.zeros(2)

    def advance_velocity(self, model, t, state, tau, f_ext, dt):
        v = state.v + dt * free_motion(model, t, state, tau, f_ext)
        inverse = rb.inverse_mass_matrix(model, state.q)
        b, l = v + state.q / dt, state.memory
        for _ in range(self.sweeps):
            for i in range(2):
                l = l.at[i].set(jnp.maximum(l[i] - (inverse[i] @ l + b[i]) / inverse[i, i], 0.0))
        return v + inverse @ l, l


def dropped(z=0.05):
    return rb.State(jnp.array([z, 0.02]), jnp.zeros(2))


@pytest.mark.parametrize("kernel", [None, False])
def test_a_mass_comes_to_rest_on_the_floor(kernel):
    model = rb.load(XML)
    path = rb.rollout(model, dropped(), None, DT, steps=60, dynamics=Floor(20), kernel=kernel)
    assert path.q.min() > -1e-9 and path.memory.shape == (61, 2)
    np.testing.assert_allclose(path.q[-1], 0.0, atol=1e-9)
    np.testing.assert_allclose(path.memory[-1], [3 * 9.81 * DT, 9.81 * DT], rtol=1e-7)


class Free:
    """Free motion as a velocity dynamics without memory."""

    def initial_memory(self, model):
        return jnp.zeros(0)

    def advance_velocity(self, model, t, state, tau, f_ext, dt):
        return state.v + dt * free_motion(model, t, state, tau, f_ext), state.memory


def test_a_memory_may_be_empty():
    model = rb.load(XML)
    path = rb.rollout(model, dropped(), None, DT, steps=5, dynamics=Free())
    expected = rb.rollout(model, dropped(), None, DT, steps=5)
    np.testing.assert_allclose(path.q, expected.q, atol=1e-12)  # rounding


def test_the_memory_starts_the_next_step():
    """At rest one sweep from the impulses of the last step suffices; from zero it does not."""
    model = rb.load(XML)
    rest = rb.rollout(model, dropped(), None, DT, steps=60, dynamics=Floor(20)).state(-1)
    warm = rb.step(model, rest, dt=DT, dynamics=Floor(1))
    cold = rb.step(model, rb.State(rest.q, rest.v), dt=DT, dynamics=Floor(1))
    assert abs(warm.v).max() < 1e-9 and warm.memory.shape == (2,)
    assert abs(cold.v).max() > 1e-3


def test_batches_and_gradients():
    model = rb.load(XML)
    states = jax.vmap(dropped)(jnp.array([0.05, 0.2]))
    batch = rb.rollout(model, states, None, DT, steps=30, dynamics=Floor(5))
    one = rb.rollout(model, dropped(0.2), None, DT, steps=30, dynamics=Floor(5))
    np.testing.assert_allclose(batch.memory[1], one.memory, atol=1e-12)

    def height(z):
        return rb.rollout(model, dropped(z), None, DT, steps=5, dynamics=Floor(5)).q[-1, 0]

    assert abs(jax.grad(height)(0.5) - 1.0) < 1e-9  # still in the air


def test_where_no_step_is_fixed_it_is_rejected():
    model, state = rb.load(XML), dropped()
    with pytest.raises(rb.InputError, match="Floor maps forces to the velocity after a step"):
        rb.simulate(model, state, jnp.array([0.0, 0.1]), dynamics=Floor(5))
    with pytest.raises(rb.InputError, match="'rk4' evaluates accelerations"):
        rb.rollout(model, state, None, DT, steps=2, dynamics=Floor(5), integrator="rk4")
