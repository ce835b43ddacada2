"""A call of a typed FFI handler, in StableHLO's own words (`api_version = 4`).

JAX writes an untyped call with an attribute from which XLA tells later that the handler is typed.
XLA of jax 0.11 loses that attribute where it writes a call again, for example one with an operand
without entries.
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
