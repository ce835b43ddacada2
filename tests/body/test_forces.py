"""Forces: each with a potential is minus its gradient; gravity and drag in closed form."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from rbjax import body, spatial
from rbjax.rotations import se3
from tests.tolerances import F64_ROUNDING, relative_error

RNG = np.random.default_rng(4)
BODY = body.Body(
    *spatial.transform_properties(
        se3.exp(RNG.normal(size=6)), *spatial.shapes.box([1, 2, 3.0], mass=4.0)
    )
)
T, V = np.asarray(se3.exp(RNG.normal(size=6))), RNG.normal(size=6)
R = T[:3, :3]


@pytest.mark.parametrize(
    "force",
    [
        body.UniformGravity([1.0, 2.0, 3.0]),
        body.CentralGravity(7.0, [4.0, -5.0, 3.0]),
        body.Buoyancy(2.0, 3.0, [0.1, 0.2, 0.3]),
        body.Spring(3.0, [1.0, 0.5, 0.0], [0.1, 0.2, 0.3], 0.5),
    ],
    ids=lambda f: type(f).__name__,
)
def test_wrench_is_minus_the_gradient_of_the_potential(force) -> None:
    """F . W = -dV/dt when the body moves with the twist W."""

    @jax.jit
    def both(force, T):
        def along(xi):
            return force.potential(BODY, se3.compose(T, se3.exp(xi)))

        return force(0.0, BODY, T, V), -jax.grad(along)(jnp.zeros(6))

    got, want = both(force, T)
    assert relative_error(got, want) <= 1e-13


def test_uniform_gravity_at_the_centre_of_mass() -> None:
    c = T[:3, 3] + R @ np.asarray(BODY.com)
    f = 4.0 * np.array([0, 0, -9.81])
    want = np.r_[R.T @ np.cross(c - T[:3, 3], f), R.T @ f]
    assert relative_error(body.UniformGravity()(0.0, BODY, T, V), want) <= F64_ROUNDING


def test_central_gravity_is_that_of_the_particles() -> None:
    """A cloud of eight particles, attracted one by one; the remainder is of third order in size."""
    x, m, mu, centre = (
        RNG.normal(size=(8, 3)),
        RNG.uniform(1, 2, 8),
        7.0,
        np.array([30.0, 20.0, 10.0]),
    )
    errors = []
    for size in (1.0, 0.5):
        cloud = body.Body(*spatial.shapes.points(size * x, m))
        at = T[:3, 3] + size * x @ R.T - centre
        f = -mu * m[:, None] * at / np.linalg.norm(at, axis=1)[:, None] ** 3 @ R
        want = np.r_[np.cross(size * x, f).sum(0), f.sum(0)]
        got = body.CentralGravity(mu, centre)(0.0, cloud, T, V)
        com = np.asarray(cloud.com)
        at_com = [spatial.wrench_at(w, com) for w in (got, want)]
        couple, force = np.split(np.abs(at_com[0] - at_com[1]), 2)
        errors.append([couple.max(), force.max()])
        assert errors[-1][0] < 0.3 * np.abs(at_com[1][:3]).max()
    ratio = np.divide(*errors)
    assert np.all((ratio > 6) & (ratio < 10))  # 2^3


def test_drag_takes_power_and_rests_in_the_stream() -> None:
    D, d, stream = np.diag(RNG.uniform(1, 2, 6)), RNG.uniform(1, 2, 6), np.array([1.0, 2, 3])
    linear, quadratic = body.LinearDrag(D, stream), body.QuadraticDrag(d, stream)
    adrift = np.r_[0, 0, 0, R.T @ stream]
    for force in (linear, quadratic):
        assert np.abs(force(0.0, BODY, T, adrift)).max() < 1e-14
        assert spatial.power(force(0.0, BODY, T, V + adrift), V) < 0
    assert relative_error(linear(0.0, BODY, T, V + adrift), -D @ V) < 1e-14
    assert relative_error(quadratic(0.0, BODY, T, V + adrift), -d * np.abs(V) * V) < 1e-14


def test_a_damper_takes_the_rate_of_its_length() -> None:
    anchor, point = np.array([1.0, 1, 1]), np.array([0.1, 0.2, 0.3])
    force = body.Damper(2.0, anchor, point)

    def length(xi):
        d = (se3.compose(T, se3.exp(xi)) @ jnp.append(point, 1.0))[:3] - anchor
        return jnp.sqrt(d @ d)

    rate = jax.jit(lambda: jax.jvp(length, (jnp.zeros(6),), (V,))[1])()
    assert relative_error(spatial.power(force(0.0, BODY, T, V), V), -2.0 * rate**2) < 1e-13
    here = np.eye(4)  # of no length, exactly: no direction, no force, no nan
    assert not np.any(body.Damper(2.0, point, point)(0.0, BODY, here, V))
    assert np.isfinite(body.Spring(2.0, point, point, 0.5)(0.0, BODY, here, V)).all()


@functools.cache
def lamb(a: float, b: float, c: float) -> float:
    """alpha_0 = abc int_0^inf dl / ((a^2 + l) D) by adaptive quadrature."""

    def integrand(l):
        return 1 / ((a * a + l) * np.sqrt((a * a + l) * (b * b + l) * (c * c + l)))

    return a * b * c * quad(integrand, 0, np.inf, epsabs=1e-12, epsrel=1e-12)[0]


def test_added_mass_of_ellipsoids() -> None:
    rho, axes = 1000.0, np.array([0.5, 0.7, 1.1])
    m = 4 / 3 * np.pi * rho * axes.prod()
    got = np.asarray(body.ellipsoid_added_mass(axes, rho))
    a, b, c = axes
    alpha = np.array([lamb(a, b, c), lamb(b, c, a), lamb(c, a, b)])
    assert abs(alpha.sum() - 2) < 1e-9  # Lamb's check
    turning = (b * b - c * c) ** 2 * (alpha[2] - alpha[1]) / 5
    turning *= m / (2 * (b * b - c * c) + (b * b + c * c) * (alpha[1] - alpha[2]))
    assert relative_error(np.diag(got)[3:], m * alpha / (2 - alpha)) < 1e-8
    assert relative_error(got[0, 0], turning) < 1e-7
    # a prolate spheroid has a closed form
    a, b = 2.0, 1.0
    e = np.sqrt(1 - (b / a) ** 2)
    alpha0 = 2 * (1 - e * e) / e**3 * (np.arctanh(e) - e)
    spheroid = body.ellipsoid_added_mass([a, b, b], rho)
    want = 4 / 3 * np.pi * rho * a * b * b * alpha0 / (2 - alpha0)
    assert relative_error(spheroid[3, 3], want) < 1e-8
    assert spheroid[0, 0] == 0
    ball = body.ellipsoid_added_mass([0.5, 0.5, 0.5], rho)
    half = 2 / 3 * np.pi * rho * 0.5**3
    assert relative_error(ball, np.diag([0, 0, 0, half, half, half])) < 1e-8
    gradient = jax.jit(jax.jacfwd(lambda a: body.ellipsoid_added_mass(a, rho)))(np.full(3, 0.5))
    assert np.isfinite(gradient).all()
