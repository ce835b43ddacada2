"""The driver's compiler, beside other work.

Where a kernel is first launched the driver compiles its PTX to machine code, a second for 5,000
lines, and keeps that in a cache on disk (`CUDA_CACHE_PATH`). A thread that loads the same PTX while
XLA compiles the rest of the program finds it in the cache then.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import threading
from collections.abc import Callable

#: characters of PTX from which on it pays
LONG = 50_000
_given: set[bytes] = set()  # digests of what it was given in this process


def compile_ahead(ptx: str, ordinal: Callable[[], int]) -> threading.Thread | None:
    """Have the driver compile PTX in a thread. None if the PTX is short or was compiled before, or
    if the driver's cache is off. ordinal: a function that returns the driver's number of the GPU,
    whose context this process has open."""
    if len(ptx) < LONG or os.environ.get("CUDA_CACHE_DISABLE", "0") == "1":
        return None
    digest, driver = hashlib.sha256(ptx.encode()).digest(), _library()
    if driver is None or digest in _given:
        return None
    _given.add(digest)
    given = driver, ptx.encode(), ordinal()
    thread = threading.Thread(target=_load, args=given, name="rbjax-ptx")
    thread.start()
    return thread


@functools.cache
def _library() -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL("libcuda.so.1")
    except OSError:
        return None


def _load(driver: ctypes.CDLL, ptx: bytes, ordinal: int) -> None:
    """Load a module, and forget it. An error is XLA's to report, which loads it again."""
    device, context, module = ctypes.c_int(), ctypes.c_void_p(), ctypes.c_void_p()
    if driver.cuInit(0) or driver.cuDeviceGet(ctypes.byref(device), ordinal):
        return
    if driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), device):
        return
    if not driver.cuCtxSetCurrent(context):
        if not driver.cuModuleLoadData(ctypes.byref(module), ptx):
            driver.cuModuleUnload(module)
        driver.cuCtxSetCurrent(None)
    driver.cuDevicePrimaryCtxRelease(device)
