"""The scalar functions under every formula: values and derivatives on both sides of each switch."""

import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from rbjax.rotations import coefficients
from tests.rotations import exact
from tests.rotations.exact import DERIVATIVE, VALUE

# zero, tiny, both sides of the switches at 3 and 10, half a turn, and far beyond
SQUARES = [
    0.0, 1e-300, 1e-24, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 2.9999999, 3.0, 3.1, 5.0, 9.8696,
    9.9999999, 10.0, 10.1, 20.0, 40.0,
]  # fmt: skip


def stumpff_exact(k, x):
    """The defining series, which converges for every x."""
    return mpmath.nsum(lambda j: (-x) ** int(j) / mpmath.factorial(2 * int(j) + k), [0, 60])


def derivatives(f, xs):
    """f, f' and f'' of ours at all xs, each in one call."""
    first = jax.grad(f)

    def all_of(x):
        return f(x), first(x), jax.grad(first)(x), jax.grad(jax.grad(first))(x)

    return [np.asarray(a) for a in jax.jit(jax.vmap(all_of))(jnp.asarray(xs))]


def exact_derivatives(f, xs):
    with mpmath.mp.workdps(exact.DIGITS):
        rows = [[mpmath.diff(f, mpmath.mpf(x), n) if n else f(mpmath.mpf(x)) for n in range(3)]
                for x in xs]  # fmt: skip
    return np.array(rows, float).T


@pytest.mark.parametrize("k", range(6))
def test_stumpff(k: int) -> None:
    """Relative to the largest of the derivatives' size, 1/k! at zero; c_0 and c_1 pass zero."""

    def closed(x):
        t = mpmath.sqrt(x)
        value = {0: mpmath.cos, 1: lambda t: mpmath.sin(t) / t}[k % 2](t)
        for n in range(k % 2, k, 2):
            value = (1 / mpmath.factorial(n) - value) / x
        return value

    got = derivatives(lambda x: coefficients.stumpff(x, k)[0], SQUARES)
    want = exact_derivatives(lambda x: stumpff_exact(k, x), SQUARES[:-2])
    far = exact_derivatives(closed, SQUARES[-2:])
    for g, w, limit in zip(got, np.hstack([want, far]), (VALUE, DERIVATIVE, DERIVATIVE),
                           strict=False):  # fmt: skip
        scale = np.maximum(np.abs(w), np.abs(w).max() * 0.1)
        assert (np.abs(g - w) / scale).max() <= limit
    assert np.isfinite(got[3]).all()


def test_inverse_jacobian_coefficient() -> None:
    def f(x):
        t = mpmath.sqrt(x)
        small = [mpmath.mpf(1) / 12, mpmath.mpf(1) / 720, mpmath.mpf(1) / 30240]
        if abs(x) < 1e-20:  # Bernoulli numbers
            return sum(c * x**n for n, c in enumerate(small))
        return (1 - t / 2 * mpmath.cot(t / 2)) / x

    xs = [x for x in SQUARES if x < 30]
    got = derivatives(coefficients.inverse_jacobian_coefficient, xs)
    far = [x for x in xs if x > 1e-7]
    want = exact_derivatives(f, far)
    for g, w, limit in zip(got, want, (VALUE, DERIVATIVE, DERIVATIVE), strict=False):
        assert (np.abs(g[-len(far) :] - w) / np.abs(w)).max() <= limit
    for g, c in zip(got, (1 / 12, 1 / 720, 1 / 15120), strict=False):
        np.testing.assert_allclose(g[: len(xs) - len(far)], c, rtol=1e-9)
        assert abs(g[0] / c - 1) <= VALUE


def test_arctan_over() -> None:
    """On the unit circle, from no angle to a quarter turn; and of any length."""
    h = np.array([0.0, 1e-150, 1e-12, 1e-6, 1e-3, 0.1, 0.5, 1.0, 1.5, 1.5707963, np.pi / 2])
    n, w = np.sin(h), np.cos(h)
    for size in (1.0, 1e-3, 1e100):
        got = np.asarray(coefficients.arctan_over(jnp.asarray(w * size), (n * size) ** 2))
        want = [mpmath.atan2(a, b) / (a * size) if a else 1 / b / size
                for a, b in zip(map(mpmath.mpf, n), map(mpmath.mpf, w), strict=True)]  # fmt: skip
        np.testing.assert_allclose(got, np.array(want, float), rtol=4 * VALUE)


def test_angle_is_the_arctangent_of_two() -> None:
    rng = np.random.default_rng(0)
    y, x = rng.normal(size=(2, 1000)) * 10.0 ** rng.uniform(-12, 12, (2, 1000))
    y, x = np.append(y, [0, 0, 1, -1, 0.0]), np.append(x, [1, -1, 0, 0, 0.0])
    got = np.asarray(jax.jit(coefficients.angle)(y, x))
    np.testing.assert_allclose(got, np.arctan2(y, x), rtol=4 * VALUE)
    slopes = jax.jit(jax.grad(coefficients.angle, (0, 1)))(0.0, 0.0)
    assert np.isfinite(slopes).all()


def test_single_precision() -> None:
    x = np.float32(SQUARES)
    x[1] = 1e-30
    for k in range(6):
        got, want = (coefficients.stumpff(a, k)[0] for a in (x, x.astype(float)))
        assert got.dtype == jnp.float32
        assert np.abs(got - want).max() <= 5e-7 / math.factorial(k)


def test_guards() -> None:
    x = jnp.array([0.0, -0.0, 1e-300, -1e-300, 2.0, -2.0])
    guarded = np.asarray(coefficients.away_from_zero(x))
    assert np.isfinite((1 / guarded) ** 2).all() and (guarded[4:] == [2, -2]).all()
    assert (np.sign(guarded)[[2, 3]] == [1, -1]).all()
