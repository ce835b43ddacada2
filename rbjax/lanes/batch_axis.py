"""The position of a result's batch under `vmap`: first or last."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_batch_first, _batch_last = Primitive("batch_first"), Primitive("batch_last")


def batch_first(tree: Any) -> Any:
    """The same pytree; under `vmap` its arrays have the batch first.

    A function with a custom rule and the rule itself must return the batch at the same place. JAX
    confuses the two if `vmap` transforms the function inside a `jit`.
    """
    return jax.tree.map(_batch_first.bind, tree)


def batch_last(tree: Any) -> Any:
    """The same pytree; under `vmap` its arrays have the batch last. This is the layout in which a
    warp of GPU threads writes whole lines."""
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
