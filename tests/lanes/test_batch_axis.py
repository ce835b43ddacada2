"""`batch_first` against plain `vmap`: the rule's result has the batch, the function's has not."""

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.tracing.custom_rules import with_jvp
from rbjax.lanes import batch_first, batch_last

X = jnp.arange(6.0).reshape(2, 3)


def test_places() -> None:
    assert jax.vmap(batch_first, in_axes=1, out_axes=0)(X).shape == (3, 2)
    assert jax.vmap(batch_last, in_axes=0, out_axes=1)(X).shape == (3, 2)
    np.testing.assert_array_equal(jax.vmap(batch_first, in_axes=1)(X), X.T)


def test_a_constant_has_the_batch_of_what_it_is_like() -> None:
    one = jnp.ones(4)

    def of(x, y):
        return batch_first((one, x * y), (x, y))

    for in_axes in ((0, None), (None, 0), (0, 0)):
        args = [X if axis == 0 else X[0] for axis in in_axes]
        ones, products = jax.vmap(of, in_axes)(*args)
        np.testing.assert_array_equal(ones, np.ones((2, 4)))
        np.testing.assert_array_equal(products, np.multiply(*args))
    nested = jax.vmap(jax.vmap(of, (None, 0)), (0, None))(X, X[0])
    assert nested[0].shape == (2, 3, 4)


def test_derivatives_do_not_see_what_a_result_is_like() -> None:
    def of(x, y):
        return batch_first(jnp.sin(x), y)

    def many(x, y):
        return jax.vmap(of)(x, y).sum()

    np.testing.assert_allclose(jax.grad(many)(X, X), np.cos(X))
    np.testing.assert_array_equal(jax.grad(many, 1)(X, X), 0 * X)
    np.testing.assert_allclose(jax.jvp(many, (X, X), (X, X))[1], (X * np.cos(X)).sum())


def test_a_constant_whose_rule_has_the_batch() -> None:
    """JAX loses the batch of such a result, if `vmap` transforms the function inside a `jit`."""

    def rule(at, to):
        (x,), (dx,) = at, to
        return 0 * x + 1, 0 * dx

    f = with_jvp(lambda x: jnp.ones(3), rule)
    for g in (jax.vmap(jax.jit(f)), jax.jit(jax.vmap(f)), jax.vmap(f)):
        value, rate = jax.jvp(g, (X,), (X,))
        np.testing.assert_array_equal(value, np.ones((2, 3)))
        np.testing.assert_array_equal(rate, np.zeros((2, 3)))
