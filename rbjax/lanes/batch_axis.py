"""Where `vmap` leaves the batch of a result: first, or last."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_batch_first, _batch_last = Primitive("batch_first"), Primitive("batch_last")


def batch_first(tree: Any) -> Any:
    """The same pytree; under `vmap` its arrays have the batch first.

    What a function with a custom rule returns, and what the rule returns, must have it in one
    place: JAX mixes the two up where `vmap` meets the function inside a `jit`.
    """
    return jax.tree.map(_batch_first.bind, tree)


def batch_last(tree: Any) -> Any:
    """The same pytree; under `vmap` its arrays have the batch last, as GPU threads then leave their
    results: a warp writes whole lines."""
    return jax.tree.map(_batch_last.bind, tree)


def _placed_by(primitive, last):
    def moved(xs, dims):
        at = xs[0].ndim - 1 if last else 0
        return primitive.bind(jnp.moveaxis(xs[0], dims[0], at)), at

    primitive.def_impl(lambda x: x)
    primitive.def_abstract_eval(lambda x: x)
    mlir.register_lowering(primitive, lambda ctx, x: [x])
    ad.deflinear2(primitive, lambda t, x: [t])
    batching.primitive_batchers[primitive] = moved


_placed_by(_batch_first, last=False)
_placed_by(_batch_last, last=True)
