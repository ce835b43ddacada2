"""Compiles the kernels of a program in parallel, while JAX lowers the rest of it.

NVRTC takes seconds for a long kernel, and a gradient has two. So a kernel is compiled in a thread,
and the call that launches it is first written with a placeholder in place of the code. When JAX has
lowered the whole program, the placeholders are replaced. If NVRTC rejects a kernel, the program is
lowered once more, and the function of this kernel runs under XLA.
"""

from __future__ import annotations

import contextvars
import functools
import os
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from rbjax._jax_compat import replace_kernel_data, wrap_lowering
from rbjax.compiler.cuda.nvrtc import CompileError, compiles_fast

#: the least and the largest number of kernels that are compiled at the same time
AT_ONCE = 2, 8


class KernelCode:
    """The code of a kernel, which a thread compiles."""

    def __init__(self, source: str, future: Future[str]):
        self.source, self.future = source, future

    def text(self) -> str:
        """Return a placeholder for the program that is being lowered, or the code."""
        if _lowering.pending is None:
            return self.future.result()
        placeholder = f"rbjax kernel {id(self)}"
        _lowering.pending[placeholder] = self
        return placeholder


class _Lowering(threading.local):
    """The program that JAX lowers in this thread."""

    #: placeholder -> code; None if no program is being lowered
    pending: dict[str, KernelCode] | None = None


_lowering = _Lowering()
#: the codes that programs need now, by source and `compiles_fast`
_codes: weakref.WeakValueDictionary[tuple[str, bool], KernelCode] = weakref.WeakValueDictionary()
#: the message of NVRTC for each source that it rejects
_rejected: dict[str, str] = {}


@functools.cache
def _compilers() -> ThreadPoolExecutor:
    least, most = AT_ONCE
    return ThreadPoolExecutor(min(max(os.cpu_count() or 1, least), most), "rbjax-nvrtc")


def compile_aside(source: str, compile: Callable[[], str]) -> KernelCode:
    """Begin to compile a kernel.

    compile: function that returns the code, or raises CompileError.

    Raises:
        CompileError: NVRTC rejects the kernel.
    """
    if source in _rejected:
        raise CompileError(_rejected[source])
    key = source, compiles_fast()
    code = _codes.get(key)
    if code is None:
        own = contextvars.copy_context()  # in which `compiles_fast` is the same
        code = _codes[key] = KernelCode(source, _compilers().submit(own.run, compile))
    if not _completes:  # with such a JAX only here
        code.future.result()
    return code


def _completing(lower: Callable) -> Callable:
    """Return the function that lowers a program and replaces the placeholders of its kernels."""

    @functools.wraps(lower)
    def run(*args: Any, **named: Any) -> Any:
        while True:
            outer, _lowering.pending = _lowering.pending, {}
            try:
                lowered, pending = lower(*args, **named), _lowering.pending
            finally:
                _lowering.pending = outer
            texts: dict[str, str] = {}
            for placeholder, code in pending.items():
                try:
                    texts[placeholder] = code.future.result()
                except CompileError as error:
                    _rejected[code.source] = str(error)
            if len(texts) == len(pending):
                if texts:
                    replace_kernel_data(lowered.module, texts)
                return lowered

    return run


#: whether placeholders are replaced
_completes = wrap_lowering(_completing)
