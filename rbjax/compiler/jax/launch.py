"""Calls of compiled code from jitted programs, on GPUs and on CPUs, and the devices that run it.

On a GPU, XLA loads PTX and launches it. The name of that custom call is internal to XLA; if a
version removes it, a typed FFI handler that calls `cuLaunchKernel` can replace it. On a CPU, the
machine code is itself a typed FFI handler, which is registered by the hash of its IR. Executables
from JAX's cache work in a new process, because lowering registers the handler again.
"""

from __future__ import annotations

import functools
import os
import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import mlir

from rbjax._jax_compat import GPU_KERNEL, typed
from rbjax.compiler.cuda.driver import compile_ahead, shared_bytes_of
from rbjax.compiler.cuda.kernels import DRIVERS_BYTES, Kernel
from rbjax.compiler.cuda.nvrtc import CompileError, ptx
from rbjax.compiler.ir.program import Written, batch_first
from rbjax.compiler.ir.statements import Unsupported
from rbjax.compiler.jax.kernel_code import KernelCode, compile_in_background
from rbjax.compiler.llvm import jit as llvm_jit
from rbjax.compiler.llvm.xla_handler import write_handler
from rbjax.compiler.lower.write import write_program
from rbjax.errors import InputError

#: the environment variable that chooses the compiler of functions of one sample on the CPU
VARIABLE = "RBJAX_CPU"
CHOICES = ("llvm", "xla")
default_choice = "llvm"
#: the operand of the self-tests, with one number per thread of a block
NUMBERS = np.arange(32, dtype=np.float32)
SELF_TEST = """
extern "C" __global__ void self_test(const float* x, float* y) {
  y[threadIdx.x] = 2.0f * x[threadIdx.x];
}
"""

# ------------------------------------------------------------------- devices


@functools.cache
def has_gpu() -> bool:
    """Return whether this process has an NVIDIA GPU."""
    try:
        return bool(jax.local_devices(backend="cuda"))
    except RuntimeError:
        return False


@functools.cache
def uses_llvm() -> bool:
    """Return whether functions on the CPU are compiled by LLVM, and not by XLA."""
    choice = os.environ.get(VARIABLE, default_choice)
    if choice not in CHOICES:
        raise InputError(f"{VARIABLE}: got {choice!r}, expected one of {', '.join(CHOICES)}")
    return choice == "llvm" and host_kernels_work()


def kernels_available() -> bool:
    """Return whether some device runs functions of one sample as kernels."""
    return has_gpu() or uses_llvm()


def oldest_gpu() -> jax.Device:
    """Return this process's GPU with the least compute capability; its code runs on all GPUs."""
    version = lambda d: [int(n) for n in str(d.compute_capability).split(".")]  # noqa: E731
    return min(jax.local_devices(backend="cuda"), key=version)


def ordinal() -> int:
    """Return the CUDA driver's number of `oldest_gpu()`; not always 0 with several processes."""
    return oldest_gpu().local_hardware_id or 0


def capability() -> str:
    """Return the compute capability for which kernels are compiled, such as "9.0"."""
    return str(oldest_gpu().compute_capability)


# ------------------------------------------------------------------- calls from XLA


def typed_call(target: str, ctx, *operands, **attributes: object):
    """Emit a call of a typed FFI handler, marked as typed by StableHLO's own attribute.

    JAX marks typed handlers by an attribute that the XLA of jax 0.11 loses when it rewrites a call,
    for example a call with an empty operand.
    """
    results = jax.ffi.ffi_lowering(target)(ctx, *operands, **attributes)
    first: Any = results[0]
    typed(first.owner.attributes, mlir.i32_attr(4))
    return results


_gpu_kernel = Primitive("gpu_kernel")
_gpu_kernel.multiple_results = True
_gpu_kernel.def_abstract_eval(lambda *operands, results, **params: list(results))


def launch_kernel(
    kernel: Kernel, operands: Sequence[jax.Array], results: Sequence[ShapedArray]
) -> list[jax.Array]:
    """Launch a kernel on a GPU. results: shapes and dtypes of its results.

    Raises:
        Unsupported: NVRTC has rejected the kernel, in the second lowering of a program.
    """

    def compiled() -> str:
        code = ptx(kernel.source, capability())
        compile_ahead(code, ordinal)
        return code

    try:
        code = compile_in_background(kernel.source, compiled)
    except CompileError as error:
        raise Unsupported(f"a program that the GPU's compiler rejects ({error})") from error
    params = {
        "name": kernel.name, "code": code, "grid": kernel.grid, "block": kernel.block,
        "shared_bytes": kernel.shared_bytes,
    }  # fmt: skip
    return _gpu_kernel.bind(*operands, results=tuple(results), **params)


def _lower_gpu_kernel(
    ctx, *operands, results, name: str, code: KernelCode, grid: int, block: int, shared_bytes: int
):
    one = np.int32(1)
    return typed_call(
        GPU_KERNEL, ctx, *operands, name=name, kernel_type="ptx", kernel_data=code.text(),
        grid_x=np.int32(grid), grid_y=one, grid_z=one,
        block_x=np.int32(block), block_y=one, block_z=one, shared_mem_bytes=np.int32(shared_bytes),
    )  # fmt: skip


mlir.register_lowering(_gpu_kernel, _lower_gpu_kernel, platform="cuda")


@dataclass(frozen=True)
class HostKernel:
    """A registered handler of machine code.

    parts: number of parts of the batch. Each summed result has one row per part.
    """

    name: str
    parts: int


#: code that XLA may call; never freed, because XLA does not report when it drops a handler
_registered: dict[str, llvm_jit.Code] = {}
_lock = threading.Lock()  # XLA rejects a second handler of the same name


def register_host_kernel(
    program: Written,
    levels: llvm_jit.OptimizationLevels = llvm_jit.LEVELS,
    samples: int | None = None,
) -> HostKernel:
    """Compile a program and register its handler. samples: number of samples per part of the batch.

    Raises:
        Unsupported: the program has an operation that LLVM lacks, LLVM rejects it, or XLA rejects
            the handler.
    """
    module, rows = write_handler(program, samples)
    try:
        code = llvm_jit.compile_module(module, levels)
    except llvm_jit.NoCompiler as error:
        raise Unsupported(str(error)) from error
    name = f"rbjax_{code.key}"
    with _lock:
        if name not in _registered:
            try:
                jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(code.address), platform="cpu")
            except (RuntimeError, ValueError) as error:
                raise Unsupported(f"a handler that XLA rejects: {error}") from error
            _registered[name] = code
    return HostKernel(name, rows)


_host_kernel = Primitive("host_kernel")
_host_kernel.multiple_results = True
_host_kernel.def_abstract_eval(lambda *operands, results, name: list(results))


def call_host_kernel(
    kernel: HostKernel, operands: Sequence[jax.Array], results: Sequence[ShapedArray]
) -> list[jax.Array]:
    """Call a handler on a CPU. results: shapes and dtypes of its results."""
    return _host_kernel.bind(*operands, results=tuple(results), name=kernel.name)


mlir.register_lowering(
    _host_kernel, lambda ctx, *xs, results, name: typed_call(name, ctx, *xs), platform="cpu"
)


# ------------------------------------------------------------------- self-tests


def passes_self_test(double: Callable[[np.ndarray], jax.Array], warning: str) -> bool:
    """Return whether double(x) = 2 x. If not, warn, with the reason in place of `{}`."""
    try:
        if np.array_equal(double(NUMBERS), 2 * NUMBERS):
            return True
        problem = "the self-test's result is wrong"
    except (Unsupported, RuntimeError) as error:  # errors of JAX and of compilers
        problem = str(error)[:300]
    warnings.warn(warning.format(problem), stacklevel=3)
    return False


def _double_on_gpu(x: np.ndarray, shared_bytes: int = 0) -> jax.Array:
    test = Kernel(SELF_TEST, "self_test", x.size, 1, 1, (False,), shared_bytes)
    run = jax.jit(lambda x: launch_kernel(test, [x], [ShapedArray(x.shape, x.dtype)])[0])
    with jax.ensure_compile_time_eval():
        return run(jax.device_put(x, oldest_gpu()))


@functools.cache
def kernels_work() -> bool:
    """Return whether NVRTC compiles and XLA launches kernels. The first call runs a self-test."""
    return passes_self_test(
        _double_on_gpu,
        "rbjax: GPU kernels are disabled ({}), so batches run under XLA, several times slower. "
        'Install what they need with pip install "rbjax[cuda]", and a recent jax.',
    )


@functools.cache
def multiprocessor_bytes() -> int:
    """Return the bytes of shared memory of a multiprocessor; 0 if a block cannot take all of it.
    The first call runs a self-test."""
    bytes = shared_bytes_of(capability())
    if not has_gpu():  # a test compiles for a GPU
        return bytes
    test = functools.partial(_double_on_gpu, shared_bytes=bytes - DRIVERS_BYTES)
    warning = "rbjax: kernels with large shared memory do not run ({}), so some take twice as long."
    return bytes if passes_self_test(test, warning) else 0


@functools.cache
def host_kernels_work() -> bool:
    """Return whether XLA can call rbjax's machine code on this CPU. The first call runs a
    self-test."""

    def double(x: np.ndarray) -> jax.Array:
        traced, parts = jax.make_jaxpr(lambda x: [x + x])(x[0]), 2
        layouts = [batch_first((), x.shape)]
        program = write_program(traced, x.shape, layouts, layouts, platform="cpu")
        test = register_host_kernel(program, samples=x.size // parts)
        run = jax.jit(lambda x: call_host_kernel(test, [x], [ShapedArray(x.shape, x.dtype)])[0])
        # with several processes, the first device may belong to another process
        own = jax.local_devices(backend="cpu")[0]
        with jax.ensure_compile_time_eval(), jax.default_device(own):
            return run(x)

    return passes_self_test(
        double,
        "rbjax: machine code does not run inside of XLA here ({}), so functions on the CPU run "
        "under XLA, which takes longer.",
    )
