"""Inverses of small real and complex matrices, complex ones as pairs of real ones.

Iterations that solve with one matrix often and correct their own rounding take the inverse: a
product is faster than two triangular solves. GPU threads know no complex numbers and have little
memory; there the inverse takes the place of the matrix (`rbjax.compiler.lower.inversion`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_inverse = Primitive("inverse")
_inverse.multiple_results = True


def inverse(*parts: jax.Array) -> list[jax.Array]:
    """The inverse of a matrix (n, n), or of one given by its real and imaginary parts.

    Its derivative is dX = -X dA X.
    """
    return _inverse.bind(*parts)


def _native(*parts):
    if len(parts) == 1:
        return [jnp.linalg.inv(parts[0])]
    found = jnp.linalg.inv(jax.lax.complex(*parts))
    return [found.real, found.imag]


def _jvp(parts, changes):
    found = _inverse.bind(*parts)
    changes = [ad.instantiate_zeros(x) for x in changes]
    moved = _product(_product(found, changes), found)
    return found, [-x for x in moved]


def _product(a, b):
    """Of matrices, by their parts."""
    precision = jax.lax.Precision.HIGHEST
    of = [[jnp.matmul(x, y, precision=precision) for y in b] for x in a]
    return of[0] if len(a) == 1 else [of[0][0] - of[1][1], of[0][1] + of[1][0]]


def _batched(parts, dims):
    size = next(x.shape[d] for x, d in zip(parts, dims, strict=True) if d is not None)
    front = [batching.bdim_at_front(x, d, size) for x, d in zip(parts, dims, strict=True)]
    return _inverse.bind(*front), [0] * len(parts)


_inverse.def_impl(lambda *parts: jax.jit(_native)(*parts))
_inverse.def_abstract_eval(lambda *parts: list(parts))
mlir.register_lowering(_inverse, mlir.lower_fun(_native, multiple_results=True))
ad.primitive_jvps[_inverse] = _jvp
batching.primitive_batchers[_inverse] = _batched
