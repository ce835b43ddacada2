"""A part of a batch as a function of arrays, called without XLA."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rbjax.compiler.llvm import jit as llvm_jit
from rbjax.compiler.llvm.batch import BatchParts
from rbjax.compiler.llvm.jit import Module

#: a part as the function that `llvm_jit` looks for
RUN = """
define i32 @run(ptr %buffers, i64 %index) {
  %code = call i32 @part(ptr %buffers, i64 %index)
  ret i32 %code
}
"""


def part_function(parts: BatchParts) -> tuple[Callable[[Sequence[np.ndarray]], None], Any]:
    """All parts of a batch as a function of the arrays of operands and results; and its code."""
    code = llvm_jit.compile_module(Module(parts.text + RUN, parts.libm))
    part = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int64)(code.address)

    def run(arrays: Sequence[np.ndarray]) -> None:
        buffers = (ctypes.c_void_p * len(arrays))(*(x.ctypes.data for x in arrays))
        for k in range(parts.count):
            assert part(buffers, k) == 0

    return run, code
