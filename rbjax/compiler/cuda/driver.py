"""Calls of the CUDA driver: early compilation of PTX, kernel resources, and device limits."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rbjax.compiler.cuda.nvrtc import CompileError

# enumerations of cuda.h
REGISTERS, LOCAL_BYTES, SHARED_BYTES = 4, 3, 1  # CUfunction_attribute
CLOCK_KHZ, MULTIPROCESSORS, MEMORY_KHZ, BUS_BITS = 13, 16, 36, 37  # CUdevice_attribute
#: float32 lanes of a multiprocessor by compute capability; 128 for all others. Source: CUDA C++
#: Programming Guide, "Throughput of Native Arithmetic Instructions"
LANES = {"6.0": 64, "7.0": 64, "7.2": 64, "7.5": 64, "8.0": 64}
#: KiB of shared memory of a multiprocessor that blocks may take, by compute capability; `LEAST_KIB`
#: for all others. Source: the same, "Technical Specifications per Compute Capability"
SHARED_KIB = {"7.0": 96, "8.0": 163, "8.7": 163, "9.0": 227, "10.0": 227, "10.3": 227}
LEAST_KIB = 64
#: the shortest PTX, in characters, that is compiled early
LONG = 50_000
_compiled: set[bytes] = set()  # digests of the PTX that this process has compiled early


@dataclass(frozen=True)
class Resources:
    """The resources that a kernel uses.

    registers: registers per thread.
    local_bytes: bytes of local memory per thread.
    shared_bytes: bytes of shared memory per block.
    """

    registers: int
    local_bytes: int
    shared_bytes: int


@dataclass(frozen=True)
class PeakRates:
    """The peak rates of a device: instructions per second, and bytes per second."""

    instructions: float
    bandwidth: float


def lanes(capability: str) -> int:
    """Return the number of float32 lanes of a multiprocessor, by compute capability ("9.0")."""
    return LANES.get(capability, 128)


def shared_bytes_of(capability: str) -> int:
    """Return the bytes of shared memory of a multiprocessor, by compute capability ("9.0")."""
    return SHARED_KIB.get(capability, LEAST_KIB) * 1024


def compile_ahead(ptx: str, ordinal: Callable[[], int]) -> threading.Thread | None:
    """Compile PTX in a background thread, to warm the driver's cache on disk (`CUDA_CACHE_PATH`).

    The driver compiles a kernel before its first launch, in one second for 5,000 lines. The thread
    loads the same PTX while XLA compiles the rest of the program. Returns None if the PTX is short
    or was compiled before, if there is no driver, or if its cache is disabled.

    Args:
        ordinal: returns the driver's number of the GPU, whose context this process has open.
    """
    if len(ptx) < LONG or os.environ.get("CUDA_CACHE_DISABLE", "0") == "1":
        return None
    digest = hashlib.sha256(ptx.encode()).digest()
    try:
        driver = _driver()
    except CompileError:
        return None
    if digest in _compiled:
        return None
    _compiled.add(digest)
    thread = threading.Thread(target=_load, args=(driver, ptx, ordinal()), name="rbjax-ptx")
    thread.start()
    return thread


def _load(driver: ctypes.CDLL, ptx: str, ordinal: int) -> None:
    """Load and unload a module. Errors are ignored, because XLA loads it again and reports them."""
    with contextlib.suppress(CompileError), _context(driver, ordinal), _module(driver, ptx):
        pass


def resources(ptx: str, name: str, ordinal: int = 0) -> Resources:
    """Return the resources of a kernel after the driver has compiled it for a device."""
    cuda, function, found = _driver(), ctypes.c_void_p(), []
    with _context(cuda, ordinal), _module(cuda, ptx) as module:
        _check(cuda.cuModuleGetFunction(ctypes.byref(function), module, name.encode()), "find it")
        for attribute in (REGISTERS, LOCAL_BYTES, SHARED_BYTES):
            value = ctypes.c_int()
            _check(cuda.cuFuncGetAttribute(ctypes.byref(value), attribute, function), "ask of it")
            found.append(value.value)
    return Resources(*found)


def limits(capability: str, ordinal: int = 0) -> PeakRates:
    """Return the peak rates of a GPU, from its clock rates."""
    cuda = _driver()

    def attribute(number: int) -> int:
        value = ctypes.c_int()
        status = cuda.cuDeviceGetAttribute(ctypes.byref(value), number, device)
        _check(status, "describe the device")
        return value.value

    with _context(cuda, ordinal) as device:
        instructions = attribute(MULTIPROCESSORS) * lanes(capability) * 1e3 * attribute(CLOCK_KHZ)
        # two transfers per clock cycle
        return PeakRates(instructions, 2e3 * attribute(MEMORY_KHZ) * attribute(BUS_BITS) / 8)


def _driver() -> ctypes.CDLL:
    try:
        return ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        raise CompileError("found no CUDA driver (libcuda.so.1)") from error


@contextlib.contextmanager
def _context(cuda: ctypes.CDLL, ordinal: int) -> Iterator[ctypes.c_int]:
    """Make the primary context of a device, which JAX also uses, current in this thread."""
    device, context, before = ctypes.c_int(), ctypes.c_void_p(), ctypes.c_void_p()
    _check(cuda.cuInit(0), "start")
    _check(cuda.cuDeviceGet(ctypes.byref(device), ordinal), "find a device")
    _check(cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), device), "open the device")
    try:
        _check(cuda.cuCtxGetCurrent(ctypes.byref(before)), "find the current context")
        _check(cuda.cuCtxSetCurrent(context), "enter the device")
        yield device
        cuda.cuCtxSetCurrent(before)
    finally:
        cuda.cuDevicePrimaryCtxRelease(device)


@contextlib.contextmanager
def _module(cuda: ctypes.CDLL, ptx: str) -> Iterator[ctypes.c_void_p]:
    """Load PTX as a module inside a `with` block."""
    module = ctypes.c_void_p()
    _check(cuda.cuModuleLoadData(ctypes.byref(module), ptx.encode()), "load a kernel")
    try:
        yield module
    finally:
        cuda.cuModuleUnload(module)


def _check(status: int, action: str) -> None:
    if status:
        raise CompileError(f"the CUDA driver fails to {action}: status {status}")
