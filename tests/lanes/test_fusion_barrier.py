"""`fusion_barrier` changes no values or derivatives."""

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import fusion_barrier
from tests.tolerances import F64_ROUNDING

TREE = {"a": np.array([1.0, -2.0, 3.0]), "b": (np.array(0.5), np.array([[1.0, 2.0], [3.0, 4.0]]))}


def scrambled(tree):
    """A function whose derivatives pass through `fusion_barrier`, and the same without."""
    x = jax.tree.map(jnp.sin, tree)
    return jax.tree.map(lambda a: a * a, fusion_barrier(x)), jax.tree.map(lambda a: a * a, x)


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
    a, b = jax.jit(jax.vmap(lambda x, y: fusion_barrier((x, y)), (0, None), (0, None)))(x, y)
    np.testing.assert_array_equal(a, x)
    np.testing.assert_array_equal(b, y)
    (a,) = jax.jit(jax.vmap(lambda x: fusion_barrier((x,)), 1, 1))(x)
    np.testing.assert_array_equal(a, x)


def test_literals_and_integers_pass() -> None:
    tree = (0.0, 1, None, jnp.arange(3), jnp.array(2.5, jnp.float32))
    for out in (
        fusion_barrier(tree),
        jax.jit(lambda *x: fusion_barrier((0.0, 1, None, *x)))(*tree[3:]),
    ):
        assert out[2] is None and float(out[0]) == 0.0
        assert out[3].dtype == tree[3].dtype and out[4].dtype == jnp.float32
        np.testing.assert_array_equal(out[3], tree[3])
    assert fusion_barrier((0.0, 1))[0] == 0.0 and isinstance(fusion_barrier((0.0, 1))[0], float)
    assert fusion_barrier({}) == {}


def test_complex_values_are_held_too() -> None:
    x = jnp.asarray([1.0 + 2.0j, -3.0j])
    held = jax.jit(lambda x: fusion_barrier((x * x,))[0])
    np.testing.assert_allclose(held(x), x * x, rtol=F64_ROUNDING)
    assert "stablehlo.reduce" in held.lower(x).as_text()


def test_half_of_the_arguments_constant_under_differentiation() -> None:
    def f(x):
        a, b = fusion_barrier((x * x, jnp.ones(())))
        return a * b

    assert jax.jit(jax.grad(f))(3.0) == 6.0
    assert jax.jit(jax.grad(jax.grad(f)))(3.0) == 2.0
