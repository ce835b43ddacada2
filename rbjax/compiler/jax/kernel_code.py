"""Compiles the kernels of a program in parallel, while JAX lowers the rest of it.

NVRTC takes seconds for a long kernel, and a gradient has two kernels. So a kernel is compiled in a
background thread, and the call that launches it is first written with a placeholder in place of the
PTX. When JAX has lowered the whole program, the placeholders are replaced. If NVRTC rejects a
kernel, the program is lowered once more, and the function of this kernel runs under XLA.
"""

from __future__ import annotations

import contextvars
import functools
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from rbjax._jax_compat import replace_kernel_data, wrap_lowering
from rbjax.compiler.cuda.nvrtc import CompileError, compiles_fast

#: the largest number of kernels that are compiled at the same time
MAX_THREADS = 8
#: source of a kernel, and whether it is compiled fast
Key = tuple[str, bool]


class KernelCode:
    """The PTX of a kernel, compiled in a background thread."""

    def __init__(self, key: Key, future: Future[str]):
        self.key, self.future = key, future

    def text(self) -> str:
        """Return the PTX, or during a lowering a placeholder that is replaced at its end."""
        if _lowering.pending is None:
            return self.future.result()
        placeholder = f"rbjax kernel {id(self)}"
        _lowering.pending[placeholder] = self
        return placeholder


class _Lowering(threading.local):
    """The program that JAX lowers in this thread.

    pending: placeholder -> PTX; None if no program is being lowered.
    rejected: the kernels that NVRTC has rejected in an earlier pass, with its messages.
    """

    pending: dict[str, KernelCode] | None = None
    rejected: dict[Key, str] = {}  # noqa: RUF012 (replaced, never changed)


_lowering = _Lowering()
#: kernels to which a program refers
_codes: weakref.WeakValueDictionary[Key, KernelCode] = weakref.WeakValueDictionary()
_lock = threading.Lock()


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(MAX_THREADS, "rbjax-nvrtc")


def compile_in_background(source: str, compile: Callable[[], str]) -> KernelCode:
    """Begin to compile a kernel.

    compile: function that returns the PTX, or raises CompileError.

    Raises:
        CompileError: NVRTC has rejected the kernel when this program was lowered first.
    """
    key = source, compiles_fast()
    if key in _lowering.rejected:
        raise CompileError(_lowering.rejected[key])
    with _lock:
        code = _codes.get(key)
        if code is None:
            context = contextvars.copy_context()  # the thread reads the caller's `compiles_fast`
            code = _codes[key] = KernelCode(key, _threads().submit(context.run, compile))
    if not LOWERING_IS_WRAPPED:
        code.future.result()
    return code


def _with_kernels(lower: Callable) -> Callable:
    """Return the function that lowers a program and replaces the placeholders of its kernels."""

    @functools.wraps(lower)
    def run(*args: Any, **kwargs: Any) -> Any:
        rejected: dict[Key, str] = {}
        while True:
            outer = _lowering.pending, _lowering.rejected
            _lowering.pending, _lowering.rejected = {}, rejected
            try:
                lowered, pending = lower(*args, **kwargs), _lowering.pending
            finally:
                _lowering.pending, _lowering.rejected = outer
            texts, failed = dict[str, str](), dict[Key, str]()
            for placeholder, code in pending.items():
                try:
                    texts[placeholder] = code.future.result()
                except CompileError as error:
                    with _lock:
                        _codes.pop(code.key, None)
                    if code.key in rejected:  # it was launched when the program was traced
                        raise
                    failed[code.key] = str(error)
            if not failed:
                if texts:
                    replace_kernel_data(lowered.module, texts)
                return lowered
            rejected = rejected | failed

    return run


#: whether placeholders are replaced; otherwise kernels are compiled one after the other
LOWERING_IS_WRAPPED = wrap_lowering(_with_kernels)
