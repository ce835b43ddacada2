"""SO(3) and unit quaternions against a hundred digits, and the laws of the group."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbjax import InputError
from rbjax.rotations import quaternion, so3
from tests.rotations import exact
from tests.rotations.exact import ANGLES, VALUE, assert_jets, jets, our_jets, series
from tests.tolerances import F64_ROUNDING, relative_error

AXES = np.array([[1.0, -2.0, 2.0], [2.0, 1.0, -2.0], [0.0, 0.0, 3.0]]) / 3
PHI = (np.array(ANGLES)[:, None, None] * AXES).reshape(-1, 3)
ALONG = np.tile([0.3, -0.7, 0.5], (len(PHI), 1))


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (so3.exp, lambda p: series(exact.hat(p))),
        (quaternion.exp, exact.quaternion_exp),
        (so3.left_jacobian, lambda p: series(exact.hat(p), 1)),
        (so3.right_jacobian, lambda p: series(-exact.hat(p), 1)),
        (so3.inverse_left_jacobian, lambda p: series(exact.hat(p), 1) ** -1),
        (so3.inverse_right_jacobian, lambda p: series(-exact.hat(p), 1) ** -1),
    ],
    ids=["exp", "quaternion exp", "J_l", "J_r", "J_l^-1", "J_r^-1"],
)
def test_against_power_series(ours, theirs) -> None:
    some = slice(None) if ours in (so3.exp, quaternion.exp) else slice(None, None, 3)
    phi, d = PHI[some], ALONG[some]
    assert_jets(our_jets(ours, phi, d), jets(theirs, phi, d))


def test_beyond_half_a_turn() -> None:
    """Both sides of where the series hand over to the closed forms, and up to a whole turn."""
    far = np.array([3.2, 3.4641, 3.4642, 4.5, 6.0])[:, None] * AXES[0]
    for ours, theirs in (
        (so3.exp, lambda p: series(exact.hat(p))),
        (so3.left_jacobian, lambda p: series(exact.hat(p), 1)),
    ):
        got = our_jets(ours, far, ALONG[:5])
        assert_jets([*got[:3], got[3]], jets(theirs, far, ALONG[:5]))


def test_quaternion_log() -> None:
    """Of quaternions of any length and either sign; relative to the smallest vector even."""
    q = np.asarray(quaternion.exp(PHI)) * np.where(np.arange(len(PHI)) % 2, 0.7, -1.3)[:, None]
    d = np.tile([0.2, 0.4, -0.3, 0.6], (len(q), 1))
    got = our_jets(quaternion.log, q, d)
    want = jets(exact.quaternion_log, q, d)
    assert_jets(got, want)
    tiny = np.abs(want[0]).max(1) > 1e-299
    assert relative_error(got[0][tiny], want[0][tiny], batch_dims=1, floor=0).max() <= VALUE


def test_matrix_log() -> None:
    """log(R exp([t d])) where R is exp(phi), rounded: its two derivatives, up to half a turn."""

    def ours(x):
        phi, t = x[:3], x[3]
        K = so3.hat(t * jnp.array(ALONG[0]))
        step = jnp.eye(3) + K + K @ K / 2  # as far as two derivatives see
        return so3.log(jnp.asarray(so3.exp(jax.lax.stop_gradient(phi))) @ step)

    def theirs(x):
        phi, t = x[:3], x[3]
        step = series(exact.hat([t * mpmath.mpf(float(a)) for a in ALONG[0]]))
        return exact.quaternion_log(_exact_quaternion(phi, step))

    x = np.hstack([PHI, np.zeros((len(PHI), 1))])
    d = np.tile([0.0, 0.0, 0.0, 1.0], (len(PHI), 1))
    got = our_jets(ours, x, d)
    assert_jets(got, jets(theirs, x, d))


def _exact_quaternion(phi, step):
    """That of exp(phi) exp([t d]), the second factor through its own logarithm."""
    a, b = exact.quaternion_exp(phi), exact.quaternion_exp(exact.matrix_log(step))
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]


def test_half_a_turn_has_a_logarithm_of_length_pi() -> None:
    axes = np.concatenate([np.eye(3), AXES, -AXES])
    R = 2 * axes[:, :, None] * axes[:, None] - np.eye(3)
    phi = np.asarray(so3.log(R))
    np.testing.assert_allclose(np.linalg.norm(phi, axis=1), np.pi, rtol=VALUE)
    assert relative_error(so3.exp(phi), R) <= F64_ROUNDING
    slopes = jax.jit(jax.vmap(jax.jacrev(so3.log)))(R)
    assert np.isfinite(slopes).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_log_undoes_exp_relatively(dtype) -> None:
    eps = np.finfo(dtype).eps
    for size in (1e-30, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 3.0, 3.14):
        phi = (size * AXES).astype(dtype)
        for group in (so3, quaternion):
            back = np.asarray(group.log(group.exp(phi)))
            assert back.dtype == dtype
            scale = np.abs(phi).max(1, keepdims=True)
            assert (np.abs(back - phi) / scale).max() <= 8 * eps, (group, size)


def test_laws_of_the_group(key) -> None:
    a, b, c = jax.random.split(key, 3)
    A, B = so3.random(a, (200,)), so3.random(b, (200,))
    phi = 2 * jax.random.normal(c, (200, 3))
    p, q = quaternion.from_matrix(A), quaternion.from_matrix(B)
    AB = so3.compose(A, B)
    assert relative_error(AB, np.asarray(A) @ np.asarray(B)) <= F64_ROUNDING
    assert relative_error(quaternion.to_matrix(quaternion.multiply(p, q)), AB) <= F64_ROUNDING
    assert relative_error(so3.compose(A, so3.inverse(A)), np.tile(np.eye(3), (200, 1, 1))) < 1e-14
    assert relative_error(so3.vee(so3.hat(phi)), phi) == 0
    np.testing.assert_allclose(so3.distance(A, B), quaternion.distance(p, -q), atol=1e-14)
    want = (Rotation.from_matrix(A).inv() * Rotation.from_matrix(B)).magnitude()
    np.testing.assert_allclose(so3.distance(A, B), want, atol=1e-13)
    np.testing.assert_allclose(
        quaternion.rotate(p, phi), np.einsum("nij,nj->ni", A, phi), atol=1e-14
    )
    J = so3.left_jacobian(phi)  # J_l = R J_r, J_r = J_l^T
    assert relative_error(np.asarray(so3.exp(phi)) @ so3.right_jacobian(phi), J) <= F64_ROUNDING
    assert relative_error(np.swapaxes(so3.right_jacobian(phi), 1, 2), J) <= F64_ROUNDING


def test_geodesics(key) -> None:
    a, b = jax.random.split(key)
    A, B = so3.random(a, (50,)), so3.random(b, (50,))
    p, q = quaternion.from_matrix(A), quaternion.from_matrix(B)
    whole = so3.distance(A, B)
    for s in (0.0, 0.3, 1.0):
        C = so3.interpolate(A, B, s)
        np.testing.assert_allclose(so3.distance(A, C), s * whole, atol=1e-14)
        np.testing.assert_allclose(so3.distance(C, B), (1 - s) * whole, atol=1e-14)
        r = quaternion.interpolate(p, -q, s)
        assert relative_error(quaternion.to_matrix(r), C) <= F64_ROUNDING
    same = jax.jit(jax.jacfwd(lambda s: quaternion.interpolate(p[0], p[0], s)))(0.5)
    assert np.abs(same).max() <= 1e-15


def test_random_rotations_are_uniform(key) -> None:
    """Haar: the angle has density (1 - cos t)/pi, mean pi/2 + 2/pi; E[R v . w]^2 = 1/3."""
    R = np.asarray(so3.random(key, (20_000,)))
    angles = np.asarray(so3.distance(R, np.eye(3)))
    assert abs(angles.mean() - (np.pi / 2 + 2 / np.pi)) < 0.02
    assert np.abs(R.mean(0)).max() < 0.02 and np.abs((R**2).mean(0) - 1 / 3).max() < 0.02


def test_projection(key) -> None:
    """Nearest in the Frobenius norm, by the polar decomposition in scipy; never a reflection."""
    from scipy.linalg import polar

    rng = np.random.default_rng(0)
    M = np.asarray(so3.random(key, (20,))) + 0.3 * rng.normal(size=(20, 3, 3))
    M = M[np.linalg.det(M) > 0]
    want = np.stack([polar(m)[0] for m in M])
    assert relative_error(so3.project(M), want) <= F64_ROUNDING
    R = so3.project(-M)  # of negative determinant: a rotation all the same, and no nearer one
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)
    others = so3.compose(R[:, None], so3.exp(0.1 * rng.normal(size=(len(M), 20, 3))))
    near = np.linalg.norm(-M - R, axis=(1, 2))
    assert (np.linalg.norm(-M[:, None] - others, axis=(2, 3)) >= near[:, None]).all()


def test_derivatives_of_the_projection() -> None:
    """At a rotation, where all singular values are equal, and off it: against differences."""
    rng = np.random.default_rng(1)
    R0 = np.asarray(so3.exp([0.3, -0.5, 0.9]))
    D, h = rng.normal(size=(3, 3)), 1e-4

    @jax.jit
    def line(M, D):
        def f(t):
            return so3.project(M + t * D)

        first = jax.jacfwd(f)
        return f(0.0), first(0.0), jax.jacfwd(first)(0.0), jax.jacrev(f)(0.0)

    for M in (R0, R0 + 0.2 * rng.normal(size=(3, 3))):
        _, first, second, reverse = line(M, D)
        left, right = (line(M + s * h * D, D) for s in (-1, 1))
        assert relative_error(first, (right[0] - left[0]) / (2 * h)) <= 1e-7
        assert relative_error(second, (right[1] - left[1]) / (2 * h)) <= 1e-6
        assert relative_error(reverse, first) <= F64_ROUNDING
    singular = line(np.diag([1.0, 1.0, -1.0]), D)
    assert all(np.isfinite(x).all() for x in singular)


@pytest.mark.parametrize("M", [np.zeros((3, 3)), np.diag([1.0, 0, 0]), np.diag([1.0, 1.0, -1.0])])
def test_no_nearest_rotation_is_refused(M) -> None:
    with pytest.raises(InputError, match="not unique"):
        so3.project(M)
    assert float(so3.projection_margin(M)) < 1e-15
    assert float(so3.projection_margin(np.eye(3))) == pytest.approx(2)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: so3.log(np.eye(3) * 2), ["log: R is not a rotation", "so3.project"]),
        (lambda: so3.log(np.diag([1.0, 1, -1])), ["det R < 0"]),
        (lambda: so3.exp([1.0, 2.0]), ["phi has shape (2,)", "(..., 3)"]),
        (lambda: so3.exp([1.0, 2.0, np.nan]), ["phi[2] is nan"]),
        (lambda: so3.exp("x"), ["phi is str"]),
        (lambda: so3.exp(np.zeros(3, complex)), ["complex", "float32 or float64"]),
        (lambda: quaternion.log([0.0, 0, 0, 0]), ["zero quaternion", "(1, 0, 0, 0)"]),
        (lambda: quaternion.log([[1.0, 0, 0, 0], [1.0, 0, 0, np.inf]]), ["a[1, 3] is inf"]),
    ],
    ids=range(8),
)
def test_wrong_arguments_are_refused_in_a_sentence(call, words) -> None:
    with pytest.raises(InputError) as caught:
        call()
    for word in words:
        assert word in str(caught.value)
