"""The smallest and the largest entry: values as NumPy's, derivatives of one entry also at ties."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.lanes.arrays import largest, smallest

BOTH = [(smallest, np.min), (largest, np.max)]


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("f, theirs", BOTH)
@pytest.mark.parametrize("axis", [0, 1, -1])
def test_values_and_derivatives(f, theirs, axis, dtype):
    x = jax.random.normal(jax.random.key(0), (3, 4)).astype(dtype)
    value, slope = jax.jvp(lambda x: f(x, axis), (x,), (2 * x,))
    assert value.dtype == slope.dtype == dtype
    np.testing.assert_array_equal(value, theirs(np.asarray(x), axis))
    np.testing.assert_array_equal(slope, 2 * value)  # along 2 x the extreme moves by twice itself
    back = jax.grad(lambda x: f(x, axis).sum())(x)
    np.testing.assert_array_equal(back, np.asarray(x) == np.expand_dims(value, axis))


@pytest.mark.parametrize("f, theirs", BOTH)
def test_ties_take_one_entry(f, theirs):
    for x in (jnp.zeros(3), jnp.array([2.0, 2.0, 2.0]), jnp.full(2, jnp.inf)):
        slope = jax.grad(f)(x)
        assert slope.sum() == 1 and set(np.asarray(slope)) <= {0.0, 1.0}
        assert jax.jit(jax.vmap(jax.grad(f)))(x[None]).sum() == 1


@pytest.mark.parametrize("f, theirs", BOTH)
def test_an_entry_computed_twice_does_not_matter(f, theirs):
    """If no entry of a second computation equals the extreme, `jnp.min` gives nan."""

    @jax.custom_jvp
    def rounded(x):
        return x

    @rounded.defjvp
    def _(primals, tangents):  # other digits for the derivative
        return primals[0] * (1 + 1e-15), tangents[0]

    x = jnp.array([1.0, 3.0, 2.0])
    slope = jax.grad(lambda x: f(rounded(x)))(x)
    np.testing.assert_array_equal(slope, np.asarray(x) == theirs(np.asarray(x)))
