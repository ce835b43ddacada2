"""Properties of a compiled kernel and of the device, from the CUDA driver."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

from rbjax.compiler.cuda.nvrtc import CompileError

# of cuda.h
REGISTERS, LOCAL_BYTES, SHARED_BYTES = 4, 3, 1  # CUfunction_attribute
CLOCK_KHZ, MULTIPROCESSORS, MEMORY_KHZ, BUS_BITS = 13, 16, 36, 37  # CUdevice_attribute
#: f32 lanes of a multiprocessor, by compute capability; all others have 128. Source: CUDA C++
#: Programming Guide, "Throughput of Native Arithmetic Instructions"
LANES = {"6.0": 64, "7.0": 64, "7.2": 64, "7.5": 64, "8.0": 64}


@dataclass(frozen=True)
class Resources:
    """Registers and bytes of local memory of a thread; bytes of shared memory of a block."""

    registers: int
    local_bytes: int
    shared_bytes: int


@dataclass(frozen=True)
class Limits:
    """Limits of the device: instructions and bytes a second."""

    instructions: float
    bandwidth: float


def _driver() -> ctypes.CDLL:
    try:
        return ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        raise CompileError("found no CUDA driver (libcuda.so.1)") from error


def _check(status: int, what: str) -> None:
    if status:
        raise CompileError(f"the CUDA driver fails to {what}: status {status}")


def lanes(capability: str) -> int:
    """The number of f32 lanes of a multiprocessor, by compute capability ("9.0")."""
    return LANES.get(capability, 128)


def resources(code: str, name: str, ordinal: int = 0) -> Resources:
    """The resources of a kernel's PTX, as compiled by the driver for a device."""
    cuda, module, function = _driver(), ctypes.c_void_p(), ctypes.c_void_p()
    _in_context(cuda, ordinal)
    _check(cuda.cuModuleLoadData(ctypes.byref(module), code.encode()), "load a kernel")
    try:
        _check(cuda.cuModuleGetFunction(ctypes.byref(function), module, name.encode()), "find it")
        found = []
        for attribute in (REGISTERS, LOCAL_BYTES, SHARED_BYTES):
            value = ctypes.c_int()
            _check(cuda.cuFuncGetAttribute(ctypes.byref(value), attribute, function), "ask of it")
            found.append(value.value)
        return Resources(*found)
    finally:
        cuda.cuModuleUnload(module)


def limits(capability: str, ordinal: int = 0) -> Limits:
    """The limits of a GPU, from its clocks."""
    cuda = _driver()
    device = _in_context(cuda, ordinal)

    def ask(attribute: int) -> int:
        value = ctypes.c_int()
        status = cuda.cuDeviceGetAttribute(ctypes.byref(value), attribute, device)
        _check(status, "describe the device")
        return value.value

    clock = 1e3 * ask(CLOCK_KHZ)
    # two transfers a clock
    return Limits(
        ask(MULTIPROCESSORS) * lanes(capability) * clock, 2e3 * ask(MEMORY_KHZ) * ask(BUS_BITS) / 8
    )


def _in_context(cuda: ctypes.CDLL, ordinal: int) -> ctypes.c_int:
    """Make the primary context of a device (JAX's own) current, and return the device."""
    device, context = ctypes.c_int(), ctypes.c_void_p()
    _check(cuda.cuInit(0), "start")
    _check(cuda.cuDeviceGet(ctypes.byref(device), ordinal), "find a device")
    _check(cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), device), "open the device")
    _check(cuda.cuCtxSetCurrent(context), "enter the device")
    return device
