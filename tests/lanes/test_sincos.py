"""`sincos` is as good as libm's."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from rbjax.lanes import horner, polynomial_sincos, sincos
from tests.tolerances import F64_ROUNDING

ANGLES = np.concatenate(
    [
        np.random.default_rng(0).uniform(-r, r, 20_000) for r in (1e-3, np.pi, 100.0, 1e5)
    ]
    + [np.arange(-400, 401) * (np.pi / 4), np.array([0.0, 1e5, -1e5, 1e-300, 5e-324])]
)  # fmt: skip


def test_sincos_is_accurate() -> None:
    c, s = jax.jit(sincos)(ANGLES)
    # numpy's own are within an ulp
    assert np.abs(c - np.cos(ANGLES)).max() <= 2.3e-16
    assert np.abs(s - np.sin(ANGLES)).max() <= 2.3e-16


@pytest.mark.parametrize("x", [0.3, -1.9, 12345.678, -99999.5, np.pi, np.pi / 2, 3e4 * np.pi])
def test_sincos_against_many_digits(x: float) -> None:
    c, s = jax.jit(sincos)(x)
    with mpmath.workdps(40):
        assert abs(mpmath.mpf(float(c)) - mpmath.cos(x)) <= 1.2e-16
        assert abs(mpmath.mpf(float(s)) - mpmath.sin(x)) <= 1.2e-16


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_on_the_cpu_libm_is_not_called(dtype: type) -> None:
    """In f64 it costs ten times as much."""
    traced = jax.jit(sincos).trace(jax.ShapeDtypeStruct((3,), dtype))
    assert "sine" not in traced.lower(lowering_platforms=("cpu",)).as_text()


def test_sincos_derivatives() -> None:
    x = ANGLES[:5000]

    @jax.jit
    @jax.vmap
    def derivatives(x):
        first = jax.jacfwd(sincos)
        return first(x), jax.jacfwd(first)(x), jax.jacrev(sincos)(x)

    (dc, ds), (ddc, dds), (rc, rs) = derivatives(x)
    for got, want in ((dc, -np.sin(x)), (ds, np.cos(x)), (ddc, -np.cos(x)), (dds, -np.sin(x))):
        np.testing.assert_allclose(got, want, rtol=0, atol=F64_ROUNDING)
    np.testing.assert_array_equal(rc, dc)
    np.testing.assert_array_equal(rs, ds)


def test_sincos_in_f32_and_eager() -> None:
    x = ANGLES[np.abs(ANGLES) < 1e4].astype(np.float32)
    exact = x.astype(np.float64)
    for c, s in (sincos(jnp.asarray(x)), jax.jit(sincos)(x)):
        assert c.dtype == s.dtype == np.float32
        np.testing.assert_allclose(c, np.cos(exact), rtol=0, atol=8e-8)
        np.testing.assert_allclose(s, np.sin(exact), rtol=0, atol=8e-8)


def test_sincos_of_half_precision_is_xla_s() -> None:
    x = np.linspace(-3, 3, 50).astype(np.float16)
    np.testing.assert_allclose(jax.jit(sincos)(x), [np.cos(x), np.sin(x)], atol=1e-3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sincos_of_what_no_angle_is(dtype: type) -> None:
    """If the spacing of numbers exceeds a turn, some point of the circle; nan gives nan."""
    c, s = jax.jit(sincos)(np.array([1e9, -1e20, 3e38], dtype))
    np.testing.assert_allclose(c * c + s * s, 1.0, atol=1e-6)
    assert np.isnan(jax.jit(sincos)(np.array([np.nan, np.inf], dtype))).all()


def test_the_polynomials_without_the_primitive() -> None:
    x = np.linspace(-9.0, 9.0, 101)
    for dtype, limit in ((np.float64, 1e-15), (np.float32, 1e-6)):
        c, s = polynomial_sincos(jnp.asarray(x, dtype))
        assert c.dtype == s.dtype == dtype
        np.testing.assert_allclose(c, np.cos(x.astype(dtype)), atol=limit)
        np.testing.assert_allclose(s, np.sin(x.astype(dtype)), atol=limit)
    assert horner([1.0, 2.0, 3.0], 2.0) == 17.0
