"""The position of a result's batch under `vmap`: first or last."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_batch_first, _batch_last = Primitive("batch_first"), Primitive("batch_last")


def batch_first(tree: Any, like: Any = ()) -> Any:
    """The same pytree; under `vmap` its arrays have the batch first, and all have it if an array of
    `like` has.

    A function with a custom rule and the rule itself must return the batch at the same place. JAX
    confuses the two if `vmap` transforms the function inside a `jit`, and loses the batch of a
    constant result.
    """
    arrays = jax.tree.leaves(like)
    return jax.tree.map(lambda x: _batch_first.bind(x, *arrays), tree)


def batch_last(tree: Any) -> Any:
    """The same pytree; under `vmap` its arrays have the batch last. This is the layout in which a
    warp of GPU threads writes whole lines."""
    return jax.tree.map(_batch_last.bind, tree)


def _placed_by(primitive, last):
    def moved(xs, dims):
        x, dim = xs[0], dims[0]
        if dim is None:
            size = next(y.shape[d] for y, d in zip(xs, dims, strict=True) if d is not None)
            x, dim = jnp.broadcast_to(x, (size, *x.shape)), 0
        at = x.ndim - 1 if last else 0
        return primitive.bind(jnp.moveaxis(x, dim, at), *xs[1:]), at

    def jvp(primals, tangents):
        rate = tangents[0]
        if not isinstance(rate, ad.Zero):
            rate = primitive.bind(rate, *primals[1:])
        return primitive.bind(*primals), rate

    primitive.def_impl(lambda x, *like: x)
    primitive.def_abstract_eval(lambda x, *like: x)
    mlir.register_lowering(primitive, lambda ctx, x, *like: [x])
    ad.primitive_jvps[primitive] = jvp
    ad.primitive_transposes[primitive] = lambda t, x, *like: [t, *[None] * len(like)]
    batching.primitive_batchers[primitive] = moved


_placed_by(_batch_first, last=False)
_placed_by(_batch_last, last=True)
