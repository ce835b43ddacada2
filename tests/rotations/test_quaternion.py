"""Quaternions: values and first and second derivatives, near and at every singular point.

exp and log are compared with forty digits of mpmath, whose derivatives are Taylor coefficients of
the same closed forms along a line: d^k/dt^k f(x + t d) at t = 0.
"""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from rbjax.rotations import quaternion
from tests.tolerances import F64_ROUNDING, relative_error

DIRECTION = np.array([0.3, -0.7, 0.5])
SIZES = [0.0, 1e-300, 1e-12, 1e-9, 1e-6, 1e-4, 1e-3, 1e-2, 0.1, 0.44, 0.45, 1.0, 3.0, 3.14, 6.0]


def exp_exact(phi):
    angle = mpmath.sqrt(sum(p * p for p in phi))
    scale = mpmath.sin(angle / 2) / angle if angle else mpmath.mpf(1) / 2
    return [mpmath.cos(angle / 2), *(p * scale for p in phi)]


def log_exact(q):
    """Of a quaternion of any length, by the shorter way round."""
    w, *u = q if q[0] >= 0 else [-x for x in q]
    n = mpmath.sqrt(sum(x * x for x in u))
    scale = 2 * mpmath.atan2(n, w) / n if n else 2 / w
    return [x * scale for x in u]


def taylor(f, x, d, count):
    """f and its derivatives at x along d, from differences of 1e-15 in a hundred digits."""
    with mpmath.workdps(100):
        x, d, h = [mpmath.mpf(float(a)) for a in x], [mpmath.mpf(float(a)) for a in d], 1e-15
        h = mpmath.mpf(10) ** -25
        left, here, right = (
            f([a + k * h * b for a, b in zip(x, d, strict=True)]) for k in (-1, 0, 1)
        )
        rows = list(zip(left, here, right, strict=True))
        out = [here, [(r - l) / (2 * h) for l, _, r in rows], [(r - 2 * c + l) / h**2
               for l, c, r in rows]]  # fmt: skip
        return [np.array([float(a) for a in row]) for row in out[: count + 1]]


def along(f, x, d):
    """The same of a function of ours."""

    def line(t):
        return f(x + t * d)

    first = jax.jacfwd(line)
    return line(0.0), first(0.0), jax.jacfwd(first)(0.0), jax.jacrev(line)(0.0)


exp_along = jax.jit(lambda x, d: along(quaternion.exp, x, d))
log_along = jax.jit(lambda x, d: along(quaternion.log, x, d))


@pytest.mark.parametrize("size", SIZES)
def test_exp(size: float) -> None:
    phi = size * np.array([1.0, -2.0, 2.0]) / 3
    value, first, second, reverse = exp_along(phi, DIRECTION)
    for got, want in zip((value, first, second), taylor(exp_exact, phi, DIRECTION, 2), strict=True):
        assert relative_error(got, want) <= F64_ROUNDING
    assert relative_error(reverse, first) <= F64_ROUNDING


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("size", SIZES[:-1])
def test_log(size: float, sign: int) -> None:
    """Near the identity (both of its quaternions) and near half a turn, where it jumps."""
    q = sign * np.asarray(quaternion.exp(size * np.array([1.0, -2.0, 2.0]) / 3))
    d = np.array([0.2, 0.4, -0.3, 0.6])
    d -= q * (q @ d)  # it is a function of unit quaternions
    value, first, _, reverse = log_along(q, d)
    want = taylor(log_exact, q, d, 1)
    # close to half a turn w is small, and what is known of it is relative to one
    slack = 10 / max(abs(q[0]), 0.1)
    assert relative_error(value, want[0]) <= slack * F64_ROUNDING
    assert relative_error(first, want[1]) <= slack * F64_ROUNDING
    assert relative_error(reverse, first) <= slack * F64_ROUNDING


@pytest.mark.parametrize("size", SIZES[:-1])
def test_log_undoes_exp(size: float) -> None:
    """With all derivatives: the second of an identity is zero, which no wrong series gives."""
    phi = size * np.array([1.0, -2.0, 2.0]) / 3
    value, first, second, _ = round_trip(phi, DIRECTION)
    slack = 10 / max(np.cos(size / 2), 0.1)
    assert relative_error(value, phi) <= slack * F64_ROUNDING
    assert relative_error(first, DIRECTION) <= slack * F64_ROUNDING
    assert np.abs(second).max() <= 100 * slack * F64_ROUNDING


round_trip = jax.jit(lambda x, d: along(lambda p: quaternion.log(quaternion.exp(p)), x, d))


def test_log_is_relatively_exact_near_the_identity() -> None:
    for size in (1e-300, 1e-12, 1e-6, 1e-3):
        phi = size * DIRECTION
        np.testing.assert_allclose(quaternion.log(quaternion.exp(phi)), phi, rtol=1e-14)


def test_half_a_turn_has_a_logarithm_of_length_pi() -> None:
    for q in ([0.0, 1.0, 0, 0], [-0.0, 1.0, 0, 0], [1e-17, 0, -1.0, 0], [-1e-17, 0, 0, 1.0]):
        value, *rates = log_along(np.array(q), np.array([0.0, 0.0, 0.3, 0.1]))
        assert np.isclose(np.linalg.norm(value), np.pi) and np.isfinite(rates).all()


def test_one_argument_singular_and_the_other_generic() -> None:
    """log(a b) where b is the identity and moves: the derivative is the inverse right Jacobian."""
    a = np.array([0.4, -1.1, 0.7])
    angle = np.linalg.norm(a)
    x, y, z = a
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    cot = (1 - angle / (2 * np.tan(angle / 2))) / angle**2

    @jax.jit
    def jacobian(a, b):
        def f(b):
            return quaternion.log(quaternion.multiply(quaternion.exp(a), quaternion.exp(b)))

        return jax.jacfwd(f)(b), jax.jacrev(f)(b)

    for got in jacobian(a, np.zeros(3)):  # Sola, eq. 144
        assert relative_error(got, np.eye(3) + K / 2 + cot * K @ K) <= F64_ROUNDING


def test_algebra() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 50, 4))
    a, b = quaternion.normalize(a), quaternion.normalize(b)
    A, B = quaternion.to_matrix(a), quaternion.to_matrix(b)
    product = quaternion.to_matrix(quaternion.multiply(a, b))
    assert relative_error(product, jnp.einsum("nij,njk->nik", A, B)) <= F64_ROUNDING
    assert relative_error(quaternion.to_matrix(quaternion.conjugate(a)), A.swapaxes(1, 2)) == 0
    assert relative_error(quaternion.to_matrix(3.7 * a), A) <= F64_ROUNDING
    one = quaternion.multiply(a, quaternion.conjugate(a))
    assert relative_error(one, np.tile(quaternion.identity(), (50, 1))) <= F64_ROUNDING
    assert quaternion.identity(jnp.float32).dtype == jnp.float32


def test_turned_is_the_product_with_exp() -> None:
    rng = np.random.default_rng(1)
    q = np.asarray(quaternion.normalize(rng.normal(size=4)))
    for size in (0.0, 1e-8, 0.3, 2.0):
        phi = size * DIRECTION
        got = jnp.stack(quaternion.turned(list(q), list(phi)))
        want = quaternion.multiply(q, quaternion.exp(phi))
        assert relative_error(got, want) <= F64_ROUNDING


@pytest.mark.parametrize("size", [0.0, 1e-20, 1e-6, 1e-3, 0.1, 0.3, 1.0, 3.0])
def test_f32(size: float) -> None:
    phi = (size * np.array([1.0, -2.0, 2.0]) / 3).astype(np.float32)
    q = quaternion.exp(phi)
    assert q.dtype == jnp.float32
    np.testing.assert_allclose(q, np.asarray(quaternion.exp(phi.astype(float))), atol=2e-7)
    back = quaternion.log(q)
    assert back.dtype == jnp.float32
    np.testing.assert_allclose(back, phi, rtol=3e-6, atol=1e-30)
