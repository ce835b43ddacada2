"""Hunt-Crossley contact, against closed forms, with the derivatives of a bounce."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import rbjax as rb
from tests.contact.scenes import ball, load

K, D = 1e5, 0.4


def restitution(v, d=D):
    """The root e of d v - log(1 + d v) = -d e v - log(1 - d e v)."""
    given = d * v - np.log1p(d * v)
    return brentq(
        lambda e: -d * e * v - np.log1p(-d * e * v) - given, 1e-9, min(1, 0.9999 / (d * v))
    )


def bouncing(exponent=1.5, **options):
    model = load(ball(), gravity=0.0)
    contact = rb.contact.CompliantContact.of(
        model, stiffness=K, dissipation=D, exponent=exponent, **options
    )
    return model.with_forces(contact)


def after(model, h, w, time=0.4, **options):
    """The state at a time, of a ball at height h that falls at the speed w without gravity."""
    state = rb.State(jnp.stack([h]), jnp.stack([-w]))
    path = rb.simulate(model, state, jnp.array([0.0, time]), max_steps=400, **options)
    return path.state(-1)


@pytest.mark.parametrize("exponent", [1.0, 1.5])
def test_restitution_by_speed(exponent):
    model = bouncing(exponent)
    for w in (0.2, 1.0, 3.0):
        v = after(model, jnp.asarray(0.05), jnp.asarray(w)).v[0]
        np.testing.assert_allclose(v / w, restitution(w), rtol=1e-5)


def test_the_derivative_of_a_bounce_is_not_biased():
    """dz/dh = -e without gravity, by an adaptive solver and by fixed steps of 2 ms."""
    model, e = bouncing(), restitution(1.0)

    def height(h):
        fine = diffrax.PIDController(rtol=1e-11, atol=1e-11)
        return after(model, h, jnp.asarray(1.0), stepsize_controller=fine).q[0]

    np.testing.assert_allclose(jax.grad(height)(0.05), -e, rtol=1e-3)
    soft = model.replace(
        forces=(model.forces[0].replace(stiffness=jnp.full(1, 3e3), exponent=jnp.asarray(2.0)),)
    )

    def stepped(h):
        state = rb.State(jnp.stack([h]), -jnp.ones(1))
        return rb.rollout(soft, state, None, 2e-3, steps=250, integrator="rk4").q[-1, 0]

    slopes = [jax.grad(stepped)(0.05 + x) for x in np.linspace(0, 2e-3, 7)[:-1]]
    assert np.abs(np.array(slopes) + e).max() < 0.02 * e


def test_the_energy_never_grows():
    """A box thrown onto its corner with spin and friction: the energy with the stored part."""
    geom = '<geom type="box" size="0.1 0.07 0.05" mass="1" friction="0.4"/>'
    model = load(f'<body pos="0 0 0.2"><freejoint/>{geom}</body>')
    contact = rb.contact.CompliantContact.of(model, stiffness=2e4, dissipation=0.3)
    model = model.with_forces(contact)
    state = model.default_state().replace(v=jnp.array([1.0, 0.5, -1.0, 3.0, -2.0, 1.0]))
    path = rb.rollout(model, state, None, 2e-4, steps=2500, integrator="rk4", save_every=10)

    def energy(q, v):
        stored = rb.forces.elastic_energy(model, q)
        return rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q) + stored

    E = np.asarray(jax.vmap(energy)(path.q, path.v))
    assert path.success and E[-1] < 0.9 * E[0] and np.diff(E).max() < 1e-5 * abs(E[0])


def test_rest_and_creep_on_a_slope():
    """A ball that cannot turn rests at f_n = m g cos(a) and creeps as the module says."""
    angle, mu, s = 0.2, 0.5, 1e-2
    slope = f'<geom name="floor" type="plane" size="0 0 1" euler="0 {np.rad2deg(angle)} 0"/>'
    joints = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    model = load(ball(joint=joints), floor=slope)
    contact = rb.contact.CompliantContact.of(
        model, stiffness=1e4, dissipation=5.0, friction=mu, slip_speed=s, exponent=1
    )
    model = model.with_forces(contact)
    path = rb.rollout(model, model.default_state(), None, 1e-4, steps=8000, save_every=8000)
    speed = np.linalg.norm(path.v[-1])
    np.testing.assert_allclose(
        speed, s * np.tan(angle) / np.sqrt(mu**2 - np.tan(angle) ** 2), rtol=1e-3
    )
    distance = rb.contact.detect(model, path.q[-1], reach=1.0).distance[0]
    np.testing.assert_allclose(distance, -9.81 * np.cos(angle) / 1e4, rtol=1e-3)


def test_single_precision_and_batches():
    model = bouncing()
    h = jnp.array([0.05, 0.06], jnp.float32)
    states = rb.State(h[:, None], -jnp.ones((2, 1), jnp.float32))
    path = rb.rollout(model, states, None, 1e-3, steps=200)
    assert path.success.all() and path.q.dtype == jnp.float32
    np.testing.assert_allclose(path.v[:, -1, 0], restitution(1.0), rtol=0.05)


def test_bad_arguments():
    model = load(ball())
    for options, message in [
        ({"stiffness": -1.0}, "stiffness"),
        ({"stiffness": 1.0, "exponent": 0.5}, "exponent"),
        ({"stiffness": 1.0, "friction": -0.5}, "friction"),
        ({"stiffness": 1.0, "dissipation": np.nan}, "dissipation"),
        ({"stiffness": [1.0, 2.0]}, "stiffness has shape"),
        ({"stiffness": 1.0, "pairs": []}, "no two geoms"),
    ]:
        with pytest.raises(rb.InputError, match=message):
            rb.contact.CompliantContact.of(model, **options)
