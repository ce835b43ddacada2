"""What every public function has to do: the same under jit, vmap, jvp and vjp."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tests.tolerances import F64_IDENTITY, F64_TRANSFORM, GRADIENT, relative_error

STEP = 6e-6  # of central differences: the cube root of the rounding unit


def flat(tree: Any) -> jax.Array:
    """All numbers of a result in a row."""
    return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(tree)])


def cast(tree: Any, like: Any) -> Any:
    """The floating arrays and NumPy scalars of a record in the dtype of another array."""
    dtype = jnp.result_type(like)

    def one(x: Any) -> Any:
        known = isinstance(x, (np.ndarray, np.floating, jax.Array))
        return jnp.asarray(x, dtype) if known and jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(one, tree)


def check_composes(function: Callable[..., Any], xs: list[np.ndarray]) -> None:
    """Compares three calls outside any transformation with the same function inside one compiled
    program, mapped over a batch, and with its derivatives.

    Args:
        function: of arrays.
        xs: three of each, one behind the other.
    """
    rng = np.random.default_rng(1)
    tangents = [rng.normal(size=x.shape[1:]) for x in xs]

    def f(*arrays):
        return flat(function(*arrays))

    def everything(tangents, weight, *batch):
        def one(*x):  # one linearisation gives the value and both modes: a third less to compile
            value, linear = jax.linearize(f, *x)
            return value, linear(*tangents), jax.linear_transpose(linear, *x)(weight)

        return jax.vmap(one)(*batch)

    door = [np.asarray(f(*(x[k] for x in xs))) for k in range(3)]  # a loop, and not compiled by us
    weight = rng.normal(size=door[0].shape)
    mapped, rates, gradients = jax.jit(everything)(tangents, weight, *xs)
    rate, gradient = rates[0], [g[0] for g in gradients]
    error = relative_error(mapped, np.stack(door), batch_dims=1)
    assert error.max(initial=0.0) <= F64_TRANSFORM, "vmap, jit"
    ends = [
        np.asarray(f(*(x[0] + side * STEP * t for x, t in zip(xs, tangents, strict=True))))
        for side in (-1, 1)
    ]
    assert relative_error(rate, (ends[1] - ends[0]) / (2 * STEP), floor=1.0) <= GRADIENT, "jvp"
    by_reverse = sum((g * t).sum() for g, t in zip(gradient, tangents, strict=True))
    scale = np.abs(weight * rate).max(initial=1.0)
    assert abs(by_reverse - weight @ rate) <= F64_IDENTITY * scale, "vjp"


def check_axes(function: Callable[..., Any], xs: list[np.ndarray]) -> None:
    """jvp of vmap of jit: results of a custom rule keep their axes (JAX trusts the rule)."""
    f = jax.jit(function)
    one = jax.eval_shape(f, *(x[0] for x in xs))
    value, rate = jax.eval_shape(lambda *x: jax.jvp(jax.vmap(f), x, x), *xs)
    want = jax.tree.map(lambda x: (3, *x.shape), one)
    assert jax.tree.map(jnp.shape, value) == jax.tree.map(jnp.shape, rate) == want
