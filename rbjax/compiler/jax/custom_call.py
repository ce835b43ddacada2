"""A call of a typed FFI handler, by StableHLO's own attribute (`api_version = 4`).

JAX writes an untyped call with an attribute by which XLA later recognises a typed handler. The XLA
of jax 0.11 loses that attribute when it rewrites a call, for example one with an empty operand.
"""

from __future__ import annotations

from typing import Any

import jax
from jax.interpreters import mlir

from rbjax._jax_compat import typed


def typed_call(target: str, ctx: Any, *operands: Any, **attributes: Any) -> Any:
    """The results of the call. attributes: numbers and strings that the handler reads."""
    results: Any = jax.ffi.ffi_lowering(target)(ctx, *operands, **attributes)
    typed(results[0].owner.attributes, mlir.i32_attr(4))
    return results
