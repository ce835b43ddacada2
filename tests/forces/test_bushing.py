"""Bushings: forces by hand, the gradient of their energy, and that they only dissipate."""

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from tests.forces.against_mujoco import applied, costs_nothing, energy_slope, slopes
from tests.robots import robot
from tests.tolerances import F64_IDENTITY, GRADIENT

A = rb.forces.Place
STIFF = [3.0, 1.0, 2.0, 30.0, 50.0, 20.0]


def held(damping: float = 0.0) -> rb.Model:
    """A robot of every kind of joint, a site of its hand held to its slider, and to the world."""
    model = robot("small", "unrolled").model
    slider, hand = A.on(body="slider", point=[0.1, 0.2, 0.0]), A.on(site="tip")
    return model.with_forces(
        rb.forces.Bushing.of(slider, hand, stiffness=STIFF, damping=damping),
        rb.forces.Bushing.of(A.on(point=[0.1, 0.0, 0.3]), A.on(body="swinger"), stiffness=STIFF),
    )


def test_the_spring_is_the_gradient_of_its_energy() -> None:
    model = held()
    force, slope = energy_slope(model, robot("small").states(1)[0][0])
    np.testing.assert_allclose(force, slope, rtol=1e-9, atol=1e-9)


def test_dampers_take_the_power_of_the_relative_motion() -> None:
    """-c |w|^2 - c |v|^2 of the hand as the slider sees it, here from differences of its pose."""
    still, model = held(), held(damping=2.0)
    q, v = (jnp.asarray(x) for x in robot("small").states(4))
    zero = jnp.zeros((4, model.nu))
    power = ((applied(model)(q, v, zero) - applied(still)(q, v, zero)) * v).sum(-1)

    def seen(q):
        (R, p), (E, o) = rb.frame_pose(model, q, site="tip"), _slider(model, q)
        return E.T @ R, E.T @ (p - o)

    @jax.jit
    @jax.vmap
    def expected(q, v):
        at, rates = jax.jvp(lambda t: seen(rb.integrate(model, q, t * v)), (0.0,), (1.0,))
        (S, _), (dS, rate) = at, rates
        return -2 * ((rate**2).sum() + ((dS @ S.T) ** 2).sum() / 2)

    np.testing.assert_allclose(power, expected(q, v), rtol=F64_IDENTITY)


def _slider(model: rb.Model, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    R, p = rb.forward_kinematics(model, q)
    b = model.body("slider")
    return R[b], p[b] + R[b] @ jnp.array([0.1, 0.2, 0.0])


def test_slopes() -> None:
    """Also where it rests."""
    model = rb.load("free_body")
    mount = rb.forces.Bushing.of(A.on(), A.on(body=0), stiffness=STIFF, damping=0.3)

    def f(at):
        element, q, v = at
        return rb.applied_forces(model.replace(forces=(element,)), rb.State(q, v))

    state = model.random_state(jax.random.key(0))
    rest = jnp.array([0.0, 0, 0, 1, 0, 0, 0])
    for q, v in ((state.q, state.v), (rest, 0 * state.v)):
        assert slopes(f, (mount, q, v)) < GRADIENT


def test_zeros_cost_nothing() -> None:
    model = rb.load("double_pendulum")
    assert costs_nothing(rb.forces.Bushing.of(A.on(), A.on(body=1)), model)
