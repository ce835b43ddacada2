"""`materialize` changes nothing but when things are computed; `sincos` is as good as libm's."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from rbjax.materialize import materialize, sincos
from tests.tolerances import F64_ROUNDING

TREE = {"a": np.array([1.0, -2.0, 3.0]), "b": (np.array(0.5), np.array([[1.0, 2.0], [3.0, 4.0]]))}


def scrambled(tree):
    """A function whose derivatives pass through `materialize`, and the same without."""
    x = jax.tree.map(jnp.sin, tree)
    return jax.tree.map(lambda a: a * a, materialize(x)), jax.tree.map(lambda a: a * a, x)


def test_is_the_identity_with_its_derivatives() -> None:
    tangent = jax.tree.map(lambda x: np.cos(3 * x), TREE)

    @jax.jit
    def everything(tree, tangent):
        with_it, without = ((lambda t, i=i: scrambled(t)[i]) for i in (0, 1))
        return [
            (f(tree), jax.jvp(f, (tree,), (tangent,)), jax.vjp(f, tree)[1](tangent))
            for f in (with_it, without)
        ]

    got, want = everything(TREE, tangent)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=F64_ROUNDING)


def test_vmap_over_some_of_its_arguments() -> None:
    x, y = np.arange(6.0).reshape(2, 3), np.arange(3.0)
    a, b = jax.jit(jax.vmap(lambda x, y: materialize((x, y)), (0, None), (0, None)))(x, y)
    np.testing.assert_array_equal(a, x)
    np.testing.assert_array_equal(b, y)
    (a,) = jax.jit(jax.vmap(lambda x: materialize((x,)), 1, 1))(x)
    np.testing.assert_array_equal(a, x)


def test_literals_and_integers_pass() -> None:
    tree = (0.0, 1, None, jnp.arange(3), jnp.array(2.5, jnp.float32))
    for out in (materialize(tree), jax.jit(lambda *x: materialize((0.0, 1, None, *x)))(*tree[3:])):
        assert out[2] is None and float(out[0]) == 0.0
        assert out[3].dtype == tree[3].dtype and out[4].dtype == jnp.float32
        np.testing.assert_array_equal(out[3], tree[3])
    assert materialize((0.0, 1))[0] == 0.0 and isinstance(materialize((0.0, 1))[0], float)
    assert materialize({}) == {}


def test_half_of_the_arguments_constant_under_differentiation() -> None:
    def f(x):
        a, b = materialize((x * x, jnp.ones(())))
        return a * b

    assert jax.jit(jax.grad(f))(3.0) == 6.0
    assert jax.jit(jax.grad(jax.grad(f)))(3.0) == 2.0


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


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sincos_of_what_no_angle_is(dtype: type) -> None:
    """Where the spacing of numbers exceeds a turn: some point of the circle; not a number: none."""
    c, s = jax.jit(sincos)(np.array([1e9, -1e20, 3e38], dtype))
    np.testing.assert_allclose(c * c + s * s, 1.0, atol=1e-6)
    assert np.isnan(jax.jit(sincos)(np.array([np.nan, np.inf], dtype))).all()
