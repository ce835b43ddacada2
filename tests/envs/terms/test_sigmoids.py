"""`tolerance` against the formulas of dm_control's module `rewards` (2018), in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.envs.terms.sigmoids import SIGMOIDS, tolerance
from rbjax.errors import InputError, UnknownName

X = np.concatenate([np.linspace(-6, 6, 41), [0.3, 0.7, 1.0, 2.0]])


def published(x, value_at_1, sigmoid):
    """The sigmoids as dm_control writes them, for x >= 0."""
    v = value_at_1
    inside = lambda s, y: np.where(abs(s) < 1, y, 0.0)  # noqa: E731
    if sigmoid == "gaussian":
        return np.exp(-0.5 * (x * np.sqrt(-2 * np.log(v))) ** 2)
    if sigmoid == "hyperbolic":
        return 1 / np.cosh(x * np.arccosh(1 / v))
    if sigmoid == "long_tail":
        return 1 / ((x * np.sqrt(1 / v - 1)) ** 2 + 1)
    if sigmoid == "reciprocal":
        return 1 / (abs(x) * (1 / v - 1) + 1)
    if sigmoid == "cosine":
        s = x * np.arccos(2 * v - 1) / np.pi
        return inside(s, (1 + np.cos(np.pi * s)) / 2)
    if sigmoid == "linear":
        return inside(x * (1 - v), 1 - x * (1 - v))
    if sigmoid == "quadratic":
        return inside(x * np.sqrt(1 - v), 1 - (1 - v) * x**2)
    return 1 - np.tanh(x * np.arctanh(np.sqrt(1 - v))) ** 2


def oracle(x, bounds, margin, sigmoid, value):
    low, high = bounds
    inside = (low <= x) & (x <= high)
    if margin == 0:
        return np.where(inside, 1.0, 0.0)
    d = np.where(x < low, low - x, x - high) / margin
    return np.where(inside, 1.0, published(np.where(inside, 0.0, d), value, sigmoid))


@pytest.mark.parametrize("sigmoid", SIGMOIDS)
@pytest.mark.parametrize("bounds", [(0.0, 0.0), (-1.0, 2.0), (1.2, np.inf), (-np.inf, 0.5)])
@pytest.mark.parametrize("margin, value", [(0.0, 0.1), (0.6, 0.1), (5.0, 0.5)])
def test_values(sigmoid, bounds, margin, value):
    found = tolerance(X, bounds, margin, sigmoid, value)
    # rounding of one exponential, and of 1 in 1 - tanh^2
    np.testing.assert_allclose(
        found, oracle(X, bounds, margin, sigmoid, value), rtol=1e-14, atol=4e-15
    )


@pytest.mark.parametrize("sigmoid", ["cosine", "linear", "quadratic"])
def test_zero_at_the_margin(sigmoid):
    found = tolerance(X, (0, 0), 1, sigmoid, 0.0)
    np.testing.assert_allclose(found, oracle(X, (0, 0), 1, sigmoid, 0.0), atol=1e-15)


@pytest.mark.parametrize("sigmoid", SIGMOIDS)
def test_value_at_the_margin(sigmoid):
    """By definition; f32 to its rounding, and the dtype stays."""
    found = tolerance(jnp.float32(1.7), (0.2, 1.2), 0.5, sigmoid, 0.3)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, 0.3, rtol=1e-6)


@pytest.mark.parametrize("sigmoid", SIGMOIDS)
def test_derivatives_are_finite_everywhere(sigmoid):
    def of(x):
        return tolerance(x, (1.0, np.inf), 0.5, sigmoid, 0.5)

    x = np.array([-1e3, 0.4, 0.8, 1.0, 1.5, 1e3])
    grads = jax.vmap(jax.grad(of))(x)
    assert np.isfinite(grads).all()
    assert (grads[3:] == 0)[1:].all()
    numeric = (of(0.8 + 1e-6) - of(0.8 - 1e-6)) / 2e-6
    np.testing.assert_allclose(grads[2], numeric, rtol=1e-8)


def test_bounds_and_margin_can_be_traced():
    found = jax.jit(lambda x, low, m: tolerance(x, (low, jnp.inf), m))(0.5, 1.0, 0.25)
    np.testing.assert_allclose(found, oracle(0.5, (1.0, np.inf), 0.25, "gaussian", 0.1), rtol=1e-14)


def test_a_traced_margin_of_zero():
    x = jnp.array([-0.1, 0.0, 0.3])
    found = jax.jit(lambda m: tolerance(x, (0.0, 0.2), m, "linear"))(0.0)
    np.testing.assert_array_equal(found, [0, 1, 0])
    slope = jax.grad(lambda x, m: tolerance(x, (0.0, 0.2), m))
    assert jax.jit(slope)(0.3, 0.0) == 0


def test_bad_arguments():
    with pytest.raises(InputError, match=r"lower <= upper; exchange"):
        tolerance(0.0, (2, 1))
    with pytest.raises(InputError, match=r"margin is -1"):
        tolerance(0.0, margin=-1)
    with pytest.raises(InputError, match=r"value_at_margin is 0 .* above 0"):
        tolerance(0.0, margin=1, value_at_margin=0)
    with pytest.raises(InputError, match=r"value_at_margin is 1 .* at least 0"):
        tolerance(0.0, margin=1, sigmoid="linear", value_at_margin=1)
    with pytest.raises(InputError, match=r"a pair"):
        tolerance(0.0, (1, 2, 3))
    with pytest.raises(UnknownName, match=r"did you mean 'linear'"):
        tolerance(0.0, margin=1, sigmoid="liner")
