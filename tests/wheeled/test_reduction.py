"""The terms of the book's two robots, by both approaches, against its closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import wheeled
from rbjax.errors import InputError
from rbjax.wheeled import Body, Drive, Robot, Wheel

m, I, d, b, r, J, L = 10.0, 0.4, 0.15, 0.2, 0.08, 0.01, 0.18
close = {"rtol": 1e-12, "atol": 1e-12}


def differential() -> wheeled.RobotModel:
    """Olguín Díaz 8.2.2, 8.3.4; the centre of mass is d ahead of the axle."""
    robot = Robot.of(
        Body(m, I, com=[d, 0.0]),
        [Wheel([0.0, -b], radius=r, inertia=J), Wheel([0.0, b], radius=r, inertia=J)],
        [Drive((0,)), Drive((1,))],
    )
    return wheeled.at(robot, "reduced")


def omnidirectional() -> wheeled.RobotModel:
    """Olguín Díaz 8.2.1, 8.3.3."""
    angles = 2 * np.pi / 3 * np.arange(3)
    wheels = [
        Wheel([L * np.cos(a), L * np.sin(a)], heading=a + np.pi / 2, radius=r, inertia=J,
              kind="rollers")
        for a in angles
    ]  # fmt: skip
    return wheeled.at(Robot.of(Body(m, I), wheels, [Drive((i,)) for i in range(3)]), "reduced")


def test_reduced_equations_of_the_differential_robot() -> None:
    v, w, tau = 0.7, 1.3, jnp.array([0.3, -0.1])
    vehicle = differential()
    state = wheeled.start(vehicle).replace(v=jnp.array([v, w]))
    got = wheeled.reduced(vehicle, state, tau)
    S = [[1, 0], [0, 0], [0, 1], [1 / r, b / r], [1 / r, -b / r]]
    np.testing.assert_allclose(got.S, S, **close)
    M = np.diag([m + 2 * J / r**2, I + m * d**2 + 2 * J * b**2 / r**2])
    np.testing.assert_allclose(got.M, M, **close)
    np.testing.assert_allclose(got.C, [[0, -m * d * w], [m * d * w, 0]], **close)
    np.testing.assert_allclose(got.B, np.array([[1, 1], [b, -b]]) / r, **close)
    np.testing.assert_allclose(got.f, np.zeros(2), **close)
    np.testing.assert_allclose(got.tau, tau, **close)
    nu = np.linalg.solve(got.M, got.B @ got.tau + got.f - got.C @ state.v)
    np.testing.assert_allclose(nu, wheeled.rates(vehicle, state, tau).v, **close)


def test_differential_robot_by_the_dynamical_approach() -> None:
    """The lateral force carries the centre of mass sideways: m (v w + d w')."""
    v, w, tau = 0.7, 1.3, jnp.array([0.3, -0.1])
    vehicle = differential()
    state = wheeled.start(vehicle).replace(v=jnp.array([v, w]))
    got, reduced = (f(vehicle, state, tau) for f in (wheeled.undetermined, wheeled.reduced))
    A = [[0, 1, 0, 0, 0], [1, 0, b, -r, 0], [1, 0, -b, 0, -r]]
    np.testing.assert_allclose(got.A, A, **close)
    np.testing.assert_allclose(got.A @ reduced.S, np.zeros((3, 2)), **close)
    M = np.diag([m, m, I + m * d**2, J, J])
    M[1, 2] = M[2, 1] = m * d
    np.testing.assert_allclose(got.M, M, **close)
    for terms in (got.M, got.C):  # wrench separation
        kind = "M" if terms is got.M else "C"
        np.testing.assert_allclose(reduced.S.T @ terms @ reduced.S, getattr(reduced, kind), **close)
    nu = np.asarray(wheeled.rates(vehicle, state, tau).v)
    np.testing.assert_allclose(got.multipliers[0], m * (v * w + d * nu[1]), **close)
    forces = got.B @ got.tau + got.f + got.A.T @ got.multipliers
    left = got.M @ reduced.S @ nu + got.C @ reduced.S @ state.v
    np.testing.assert_allclose(left, forces, **close)


def test_omnidirectional_robot() -> None:
    V, tau = np.array([0.5, -0.2, 1.1]), jnp.array([0.2, 0.1, 0.3])
    vehicle = omnidirectional()
    state = wheeled.start(vehicle).replace(v=jnp.asarray(V))
    got = wheeled.reduced(vehicle, state, tau)
    a = 2 * np.pi / 3 * np.arange(3)
    A = np.stack([-np.sin(a), np.cos(a), np.full(3, L)], -1)
    np.testing.assert_allclose(got.S, np.vstack([np.eye(3), A / r]), **close)
    np.testing.assert_allclose(got.M, np.diag([m, m, I]) + J * A.T @ A / r**2, **close)
    coriolis = [-m * V[2] * V[1], m * V[2] * V[0], 0.0]
    np.testing.assert_allclose(got.C @ V, coriolis, **close)
    np.testing.assert_allclose(got.C + got.C.T, np.zeros((3, 3)), **close)  # M' = 0
    np.testing.assert_allclose(got.B, A.T / r, **close)
    rows = wheeled.undetermined(vehicle, state, tau)
    np.testing.assert_allclose(rows.A, np.hstack([A, -r * np.eye(3)]), **close)
    np.testing.assert_allclose(rows.multipliers * r, tau - J * (A @ rates_of(got, V)) / r, **close)


def rates_of(x: wheeled.Reduced, v: np.ndarray) -> np.ndarray:
    return np.linalg.solve(x.M, x.B @ x.tau + x.f - x.C @ v)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["car_trailer", "tricycle"])
def test_a_robot_that_steers_on_a_slope(name: str) -> None:
    """Of a robot with a trailer or a caster: the accelerations, and M' - 2 C skew."""
    robot = rb.wheeled.kinds()[name].make()
    vehicle = wheeled.at(robot, "reduced")
    q = 0.3 * jnp.cos(jnp.arange(vehicle.nq, dtype=float))
    state = rb.State(q, 0.4 + 0.3 * jnp.arange(vehicle.nv, dtype=float))
    u = 0.2 * jnp.sin(jnp.arange(vehicle.nu, dtype=float) + 1)
    got, rate = wheeled.reduced(vehicle, state, u), wheeled.rates(vehicle, state, u)
    np.testing.assert_allclose(rates_of(got, state.v), rate.v, rtol=1e-9)
    change = jax.jvp(
        lambda q: wheeled.reduced(vehicle, rb.State(q, state.v), u).M, (q,), (rate.q,)
    )[1]
    skew = change - 2 * got.C
    np.testing.assert_allclose(skew + skew.T, np.zeros_like(skew), atol=1e-9)


def test_a_robot_that_slips_is_refused() -> None:
    robot = wheeled.kinds()["differential_drive"].make(caster=None)
    vehicle = wheeled.at(robot, "slipping")
    with pytest.raises(InputError, match="expected a robot that rolls"):
        wheeled.reduced(vehicle, wheeled.start(vehicle))
