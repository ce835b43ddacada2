"""SE(3) against matrix power series in a hundred digits, and the laws of the group.

What other libraries do at the same points: `python -m benchmarks.accuracy.rotation_libraries`.
"""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from rbjax import InputError
from rbjax.rotations import screws, se3, so3
from tests.rotations import exact
from tests.rotations.exact import ANGLES, assert_jets, jets, our_jets, series
from tests.tolerances import F64_ROUNDING, relative_error

XI = np.hstack(
    [
        np.array(ANGLES)[:, None] * np.array([1.0, -2.0, 2.0]) / 3,
        np.tile([0.4, -1.0, 0.7], (len(ANGLES), 1)),
    ]
)
ALONG = np.tile([0.3, -0.7, 0.5, 0.2, 0.9, -0.4], (len(ANGLES), 1))


def hat(xi):
    A = mpmath.zeros(4)
    A[0:3, 0:3] = exact.hat(xi[:3])
    for i in range(3):
        A[i, 3] = xi[3 + i]
    return A


def ad(xi):
    A = mpmath.zeros(6)
    A[0:3, 0:3] = A[3:6, 3:6] = exact.hat(xi[:3])
    A[3:6, 0:3] = exact.hat(xi[3:])
    return A


@pytest.mark.parametrize(
    ("ours", "theirs", "every"),
    [
        (se3.exp, lambda x: series(hat(x)), 1),
        (se3.left_jacobian, lambda x: series(ad(x), 1), 2),
        (se3.right_jacobian, lambda x: series(-ad(x), 1), 4),
        (se3.inverse_left_jacobian, lambda x: series(ad(x), 1) ** -1, 2),
        (se3.inverse_right_jacobian, lambda x: series(-ad(x), 1) ** -1, 4),
    ],
    ids=["exp", "J_l", "J_r", "J_l^-1", "J_r^-1"],
)
def test_against_power_series(ours, theirs, every: int) -> None:
    xi, d = XI[::every], ALONG[::every]
    assert_jets(our_jets(ours, xi, d), jets(theirs, xi, d))


def test_log_undoes_exp() -> None:
    """With derivatives: d log(exp(x)) = dx, d2 = 0, at, near and far from no rotation."""

    def round_trip(x):
        return se3.log(se3.exp(x))

    value, first, second, reverse = our_jets(round_trip, XI, ALONG)
    assert relative_error(value, XI, batch_dims=1).max() <= F64_ROUNDING
    assert relative_error(first, ALONG, batch_dims=1).max() <= F64_ROUNDING
    assert np.abs(second).max() <= 10 * F64_ROUNDING and np.abs(reverse).max() <= F64_ROUNDING


def test_translation_at_no_rotation() -> None:
    """d p / d phi = -[rho]/2 at phi = 0, and log has a derivative at the identity."""
    rho = np.array([1.0, 2.0, 3.0])

    @jax.jit
    def slopes(xi):
        return jax.jacfwd(se3.exp)(xi)[:3, 3], jax.jacrev(se3.exp)(xi)[:3, 3]

    for slope in slopes(np.concatenate([np.zeros(3), rho])):
        np.testing.assert_allclose(slope, np.hstack([-so3.hat(rho) / 2, np.eye(3)]), atol=1e-15)
    at_identity = jax.jit(jax.jacrev(lambda x: se3.log(se3.exp(x))))(np.zeros(6))
    np.testing.assert_allclose(at_identity, np.eye(6), atol=1e-15)


def test_laws_of_the_group() -> None:
    rng = np.random.default_rng(0)
    x, y, z = rng.normal(size=(3, 50, 6))
    A, B = se3.exp(x), se3.exp(y)
    AB = se3.compose(A, B)
    assert relative_error(AB, np.asarray(A) @ np.asarray(B)) <= F64_ROUNDING
    one = np.tile(se3.identity(), (50, 1, 1))
    assert relative_error(se3.compose(A, se3.inverse(A)), one) <= F64_ROUNDING
    assert relative_error(se3.vee(se3.hat(x)), x) == 0
    Ad = np.asarray(se3.adjoint(A))
    assert relative_error(se3.adjoint(AB), Ad @ se3.adjoint(B)) <= F64_ROUNDING
    moved = np.einsum("nij,nj->ni", Ad, z)  # [Ad z] = T [z] T^-1
    conjugate = np.asarray(A) @ se3.hat(z) @ se3.inverse(A)
    assert relative_error(se3.hat(moved), conjugate) <= F64_ROUNDING
    bracket = np.einsum("nij,nj->ni", se3.ad(x), y)
    X, Y = np.asarray(se3.hat(x)), np.asarray(se3.hat(y))
    assert relative_error(se3.hat(bracket), X @ Y - Y @ X) <= F64_ROUNDING
    J = se3.left_jacobian(x)
    assert relative_error(Ad @ se3.right_jacobian(x), J) <= F64_ROUNDING
    one = np.asarray(J) @ se3.inverse_left_jacobian(x)
    assert relative_error(one, np.tile(np.eye(6), (50, 1, 1))) < 1e-13
    assert relative_error(se3.pose(A[:, :3, :3], A[:, :3, 3]), A) == 0


def test_pose_kinematics() -> None:
    """T(t) = exp(xi + t d): T' = [V_s] T = T [V_b], V = J xi'."""
    rng = np.random.default_rng(1)
    xi, d = rng.normal(size=(2, 20, 6))
    T, dT = jax.jit(lambda x, d: jax.jvp(se3.exp, (x,), (d,)))(xi, d)
    body = np.einsum("nij,nj->ni", se3.right_jacobian(xi), d)
    space = np.einsum("nij,nj->ni", se3.left_jacobian(xi), d)
    assert relative_error(se3.body_twist(T, dT), body) <= F64_ROUNDING
    assert relative_error(se3.space_twist(T, dT), space) <= F64_ROUNDING
    assert relative_error(se3.rate_from_body_twist(T, body), dT) <= F64_ROUNDING
    assert relative_error(se3.rate_from_space_twist(T, space), dT) <= F64_ROUNDING


def test_interpolation_is_a_screw_motion() -> None:
    rng = np.random.default_rng(2)
    A, B = se3.exp(rng.normal(size=(20, 6))), se3.exp(rng.normal(size=(20, 6)))
    turn, _ = se3.distance(A, B)
    for s in (0.0, 0.4, 1.0):
        C = se3.interpolate(A, B, s)
        np.testing.assert_allclose(se3.distance(A, C)[0], s * turn, atol=1e-14)
    assert relative_error(se3.interpolate(A, B, 0.0), A) <= F64_ROUNDING
    assert relative_error(se3.interpolate(A, B, 1.0), B) <= F64_ROUNDING
    V = se3.log(se3.compose(se3.inverse(A), B))  # constant twist
    half = se3.compose(A, se3.exp(V / 2))
    assert relative_error(se3.interpolate(A, B, 0.5), half) <= F64_ROUNDING
    _, length = se3.distance(A, B)
    np.testing.assert_allclose(length, np.linalg.norm((A - B)[:, :3, 3], axis=1), rtol=1e-14)


def test_screws() -> None:
    """Points of the line move along it by pitch times the turn; and there and back."""
    rng = np.random.default_rng(3)
    V = rng.normal(size=(30, 6))
    axis, point, pitch, magnitude = screws.from_twist(V)
    np.testing.assert_allclose(np.linalg.norm(axis, axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(np.einsum("ni,ni->n", axis, point), 0.0, atol=1e-13)
    on_line = point + 0.7 * axis
    velocity = V[:, 3:] + np.cross(V[:, :3], on_line)
    np.testing.assert_allclose(velocity, (magnitude * pitch)[:, None] * axis, atol=1e-13)
    assert relative_error(screws.to_twist(axis, on_line, pitch, magnitude), V) < 1e-13


@pytest.mark.parametrize("V", [[0.0, 0, 0, 0, 3, 4], [0.0] * 6, [0, 0, 2.0, 0, 0, 0]])
def test_degenerate_screws(V) -> None:
    screw = screws.from_twist(np.array(V))
    assert float(jnp.linalg.norm(screw.axis)) == 1.0
    assert np.isinf(screw.pitch) == (V[2] == 0)
    np.testing.assert_allclose(screws.to_twist(*screw), V, rtol=1e-15)
    slopes = jax.jit(jax.jacrev(lambda V: screws.to_twist(*screws.from_twist(V))))(np.array(V))
    assert np.isfinite(slopes).all()
    if V[2]:
        np.testing.assert_allclose(slopes, np.eye(6), atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-20, 1e-6, 1e-3, 0.1, 1.0, 3.0])
def test_single_precision(size: float) -> None:
    xi = np.float32([size, -2 * size / 3, size / 3, 1.0, -2.0, 0.5]) * np.float32(0.8)
    T = se3.exp(xi)
    assert T.dtype == jnp.float32
    np.testing.assert_allclose(T, np.asarray(se3.exp(xi.astype(float))), atol=1e-6)
    np.testing.assert_allclose(se3.log(T), xi, rtol=1e-5, atol=3e-6)
    J = se3.left_jacobian(xi)
    np.testing.assert_allclose(J, np.asarray(se3.left_jacobian(xi.astype(float))), atol=1e-6)


def test_no_pose_is_refused() -> None:
    with pytest.raises(InputError, match="last row of T"):
        se3.log(np.diag([1.0, 1.0, 1.0, 2.0]))
    with pytest.raises(InputError, match="T is not a rotation"):
        se3.inverse(np.diag([1.0, 2.0, 1.0, 1.0]))
