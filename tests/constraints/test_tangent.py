"""Steps in the coordinates of the tangent space, beside the same written out for a pendulum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.mechanisms import four_bars, pendulum, spatial_slider_crank
from rbjax import constraints as rc
from rbjax.constraints.equations.projection import project_to_tangent_space

DOWN = np.array([0.0, -9.81])
START = np.array([0.6, -0.8, 1.04, 0.78])


class Wind(rb.forces.Element):
    """A force that is zero on the circle, and strong beside it."""

    strength: jax.Array
    size = 0

    def loads(self, context):
        x, z = context.q[0], context.q[1]
        off = self.strength * (x * x + z * z - 1.0)
        return context.generalized(jnp.stack([off, 2.0 * off]))


def windy() -> rb.Model:
    return pendulum().with_forces(Wind(jnp.array(1e3)))


def step_of_one_coordinate(y: np.ndarray, dt: float) -> np.ndarray:
    """Kutta's step of z and s, along the tangent at the start."""
    p0, t0 = y[:2], np.array([-y[1], y[0]])

    def whole(x):
        z, s = x
        p = z * t0 + np.sqrt(1 - z * z) * p0
        tangent = np.array([-p[1], p[0]])
        return p, s / (t0 @ tangent) * tangent

    def rate(x):
        p, v = whole(x)
        return np.array([x[1], t0 @ (DOWN - (DOWN @ p + v @ v) * p)])

    x = np.array([0.0, t0 @ y[2:]])
    k1 = rate(x)
    k2 = rate(x + dt / 2 * k1)
    k3 = rate(x + dt / 2 * k2)
    k4 = rate(x + dt * k3)
    return np.concatenate(whole(x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)))


def test_a_state_found_across_the_tangent() -> None:
    """The circle's point above z, and the velocity there with the part s along the tangent."""
    start, z, s = rb.State(*jnp.split(jnp.array(START), 2)), 0.1, 1.2
    p0, t0 = START[:2], np.array([0.8, 0.6])

    @jax.jit
    def found(q, v):
        return project_to_tangent_space(pendulum(), 0.0, rb.State(q, v), 0.0, start)

    end = found(p0 * 1.01 + z * t0, 0.3 * p0 + s * t0)
    p = z * t0 + np.sqrt(1 - z * z) * p0
    np.testing.assert_allclose(end.q, p, rtol=0, atol=1e-15)
    tangent = np.array([-p[1], p[0]])
    np.testing.assert_allclose(end.v, s / (t0 @ tangent) * tangent, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_a_step_is_that_of_minimal_coordinates() -> None:
    """And forces are those of states on the constraints."""

    @jax.jit
    def found(start):
        one = "tangent_space"
        return rb.step(windy(), start, dt=0.1, integrator="rk4", constraints=one)

    end = found(rb.State(*jnp.split(jnp.array(START), 2)))
    want = step_of_one_coordinate(START, 0.1)
    np.testing.assert_allclose([*end.q, *end.v], want, rtol=0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["rollout", "simulate"])
def test_so_is_a_motion(way: str) -> None:
    y, steps, dt = START, 8, 0.05
    for _ in range(steps):
        y = step_of_one_coordinate(y, dt)
    start = rb.State(*jnp.split(jnp.array(START), 2))
    if way == "rollout":
        path = rb.rollout(
            windy(), start, None, dt, steps=steps, integrator="rk4", constraints="tangent_space"
        )
    else:
        ts = jnp.array([0.0, steps * dt])
        path = rb.simulate(
            windy(), start, ts, dt=dt, solver=rb.solvers.RK4(), constraints="tangent_space"
        )
    np.testing.assert_allclose([*path.q[-1], *path.v[-1]], y, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_adaptive_steps_find_the_motion_of_the_default() -> None:
    model, start = pendulum(), rb.State(*jnp.split(jnp.array(START), 2))
    paths = [
        rb.simulate(model, start, jnp.linspace(0.0, 1.0, 5), constraints=one)
        for one in ("tangent_space", "projected")
    ]
    np.testing.assert_allclose(paths[0].q, paths[1].q, rtol=0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    "mechanism, far",
    [(lambda: four_bars(1, rc.Revolute), 0.03), (spatial_slider_crank, 0.003)],
    ids=["redundant_rows", "attitudes"],
)
def test_states_keep_their_tangent_coordinates(mechanism, far: float) -> None:
    model, start = mechanism()
    k1, k2 = jax.random.split(jax.random.key(1))
    u, dv = (far * jax.random.normal(k, (model.nv,)) for k in (k1, k2))

    @jax.jit
    def found(u, dv):
        there = rb.State(rb.integrate(model, start.q, u), start.v + dv)
        end = project_to_tangent_space(model, 0.0, there, 0.0, start)
        return end, rb.difference(model, start.q, end.q), rc.residual(model, end)

    end, moved, off = found(u, dv)
    assert np.abs(off.value).max() < 1e-13 and np.abs(off.rate).max() < 1e-13
    M, G = rb.mass_matrix(model, start.q), np.asarray(rc.jacobian(model, start.q))
    _, s, Vt = np.linalg.svd(G)
    Z = Vt[(s > 1e-9).sum() :].T
    np.testing.assert_allclose(Z.T @ M @ (moved - u), 0.0, atol=1e-14)
    np.testing.assert_allclose(Z.T @ M @ (end.v - start.v - dv), 0.0, atol=1e-14)
    assert np.abs(moved - u).max() > far**2 / 10


@pytest.mark.slow
def test_derivative_of_a_step() -> None:
    def end(x):
        held = rc.Distance(rc.Place.on(), rc.Place.on(body="bob"), 1.0 + x)
        model = pendulum().replace(constraints=(held,))
        start = rb.State(jnp.array([0.6, -0.8]) + x, jnp.array([1.04, 0.78]) * (1 + x))
        after = rb.step(model, start, dt=0.1, integrator="rk4", constraints="tangent_space")
        return jnp.concatenate([after.q, after.v])

    slope = jax.jit(lambda x: jax.jvp(end, (x,), (1.0,)))
    h = 1e-5
    quotient = (slope(h)[0] - slope(-h)[0]) / (2 * h)
    np.testing.assert_allclose(slope(0.0)[1], quotient, rtol=0, atol=1e-8)
