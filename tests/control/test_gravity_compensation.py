"""Gravity compensation: robots stay where they are."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
import rbjax.control as control
from rbjax.errors import InputError
from tests.control.arms import ARM, FLOATING
from tests.robots import load_quietly


def test_holds_a_random_posture():
    """In MuJoCo too: no acceleration at rest."""
    arm = load_quietly(ARM)
    law = control.gravity_compensation(arm)
    m = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(m)
    for k in range(3):
        q = arm.random_state(jax.random.key(k)).q
        state = rb.State(q, jnp.zeros(4))
        ctrl = law(0.0, state)
        tau = rb.applied_forces(arm, state, ctrl)
        assert np.abs(rb.forward_dynamics(arm, q, state.v, tau)).max() < 1e-11
        data.qpos, data.qvel, data.ctrl = q, 0.0, ctrl
        mujoco.mj_forward(m, data)
        assert np.abs(data.qacc).max() < 1e-10


def test_floating_base_on_a_known_wrench():
    """A wrench at the trunk that carries the weight at the centre of mass leaves nothing at the
    base; the leg and the arm are held by their motors. Without it the weight is left."""
    model = load_quietly(FLOATING)
    state = model.random_state(jax.random.key(0))
    state = state.replace(v=jnp.zeros(model.nv))
    mass = float(model.bodies.mass.sum())
    force = -mass * np.asarray(model.gravity)
    arm = np.asarray(rb.center_of_mass(model, state.q) - state.q[:3])
    wrench = jnp.zeros((model.nb, 6)).at[0].set(np.concatenate([np.cross(arm, force), force]))
    law = control.gravity_compensation(model, wrenches=wrench, undriven="least_squares")
    found = law.allocated(0.0, state)
    assert np.abs(found.residual).max() < 1e-10 * mass
    tau = rb.applied_forces(model, state, found.ctrl)
    a = rb.forward_dynamics(model, state.q, state.v, tau, wrench)
    assert np.abs(a).max() < 1e-9
    unheld = control.gravity_compensation(model, undriven="least_squares").allocated(0.0, state)
    np.testing.assert_allclose(unheld.residual[:3], force, rtol=1e-10, atol=1e-10)
    with pytest.raises(InputError, match="nothing drives 'base'"):
        control.gravity_compensation(model)


def test_hovering_quadrotor():
    """Four rotors share the weight; by function of time, too."""
    model = load_quietly("quadrotor")
    state = model.default_state()
    law = control.gravity_compensation(model, undriven="least_squares")
    weight = float(model.bodies.mass.sum()) * 9.81
    np.testing.assert_allclose(law(0.0, state), weight / 4, rtol=1e-9)
    half = jnp.zeros((model.nb, 6)).at[0, 5].set(weight / 2)
    helped = control.gravity_compensation(
        model, wrenches=lambda t, state: t * half, undriven="least_squares"
    )
    np.testing.assert_allclose(helped(1.0, state), weight / 8, rtol=1e-9)
