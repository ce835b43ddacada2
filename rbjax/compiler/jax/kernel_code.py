"""Compiles the kernels of a program in parallel, while JAX lowers the rest of it.

NVRTC takes seconds for a long kernel, and a gradient has two. So a kernel is compiled in a thread,
and the call that launches it first has a placeholder in place of the code. When JAX has lowered the
whole program, the placeholders are replaced. If NVRTC rejects a kernel, the program is lowered once
more, and the function of this kernel runs under XLA.
"""

from __future__ import annotations

import contextvars
import functools
import hashlib
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from rbjax._jax_compat import replace_kernel_data, wrap_lowering
from rbjax.compiler.cuda.nvrtc import CompileError

#: the least and the largest number of kernels that are compiled at the same time
AT_ONCE = 2, 8
#: the message of NVRTC for each kernel that it rejects
_rejected: dict[str, str] = {}


class _Lowering(threading.local):
    """The program that JAX lowers in this thread."""

    #: placeholder -> code that is being compiled; None if no program is being lowered
    pending: dict[str, Future[str]] | None = None


_lowering = _Lowering()


@functools.cache
def _compilers() -> ThreadPoolExecutor:
    least, most = AT_ONCE
    return ThreadPoolExecutor(min(max(os.cpu_count() or 1, least), most), "rbjax-nvrtc")


def code_or_placeholder(source: str, compile: Callable[[], str]) -> str:
    """Return the code of a kernel, or a placeholder if the end of a lowering replaces it.

    compile: function that returns the code, or raises CompileError.

    Raises:
        CompileError: NVRTC rejects the kernel.
    """
    if _lowering.pending is None:
        return compile()
    key = f"rbjax kernel {hashlib.sha256(source.encode()).hexdigest()}"
    if key in _rejected:
        raise CompileError(_rejected[key])
    if key not in _lowering.pending:
        own = contextvars.copy_context()  # with the options of NVRTC
        _lowering.pending[key] = _compilers().submit(own.run, compile)
    return key


def _completing(lower: Callable) -> Callable:
    """Return the function that lowers a program and replaces the placeholders of its kernels."""

    @functools.wraps(lower)
    def run(*args: Any, **options: Any) -> Any:
        while True:
            outer, _lowering.pending = _lowering.pending, {}
            try:
                lowered, pending = lower(*args, **options), _lowering.pending
            finally:
                _lowering.pending = outer
            codes: dict[str, str] = {}
            for key, code in pending.items():
                try:
                    codes[key] = code.result()
                except CompileError as error:
                    _rejected[key] = str(error)
            if len(codes) == len(pending):
                if codes:
                    replace_kernel_data(lowered.module, codes)
                return lowered

    return run


wrap_lowering(_completing)
