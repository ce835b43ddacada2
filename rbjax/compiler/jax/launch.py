"""A kernel inside a jitted program.

XLA loads PTX and launches it in order with everything else, without Python at run time. The name of
the custom call is internal to XLA, and only this file uses it. If a version of XLA removes it, a
typed FFI handler can replace it (`jax.ffi.register_ffi_target`): a compiled function that gets the
stream and calls `cuLaunchKernel` on a module that it has loaded once.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import mlir

from rbjax._jax_compat import GPU_KERNEL
from rbjax.compiler.cuda.driver_cache import compile_ahead
from rbjax.compiler.cuda.kernels import Kernel
from rbjax.compiler.cuda.nvrtc import CompileError, ptx
from rbjax.compiler.ir.values import Unsupported
from rbjax.compiler.jax import self_test
from rbjax.compiler.jax.custom_call import typed_call

TARGET = GPU_KERNEL


def gpu() -> jax.Device:
    """The GPU of this process with the least compute capability: all others run its code too."""
    version = lambda d: [int(n) for n in str(d.compute_capability).split(".")]  # noqa: E731
    return min(jax.local_devices(backend="cuda"), key=version)


def ordinal() -> int:
    """The CUDA driver's number of that GPU, which need not be 0 if there are several processes."""
    return gpu().local_hardware_id or 0


def capability() -> str:
    """The compute capability for which kernels are compiled."""
    return str(gpu().compute_capability)


_kernel = Primitive("gpu_kernel")
_kernel.multiple_results = True
_kernel.def_abstract_eval(lambda *operands, results, **how: list(results))


def launch(
    kernel: Kernel, operands: Sequence[jax.Array], results: Sequence[Any]
) -> list[jax.Array]:
    """The kernel's results, with these shapes and types. Only for programs lowered for CUDA.

    Raises:
        Unsupported: NVRTC rejects the kernel.
    """
    try:
        code = ptx(kernel.source, capability())
    except CompileError as error:
        raise Unsupported(f"a program that the GPU's compiler rejects ({error})") from error
    compile_ahead(code, ordinal)
    how = {"name": kernel.name, "code": code, "grid": kernel.grid, "block": kernel.block}
    return _kernel.bind(*operands, results=tuple(results), **how)


def _lower(ctx: Any, *operands: Any, results: Any, name: str, code: str, grid: int, block: int):
    one = np.int32(1)
    return typed_call(
        TARGET, ctx, *operands, name=name, kernel_type="ptx", kernel_data=code,
        grid_x=np.int32(grid), grid_y=one, grid_z=one,
        block_x=np.int32(block), block_y=one, block_z=one, shared_mem_bytes=np.int32(0),
    )  # fmt: skip


mlir.register_lowering(_kernel, _lower, platform="cuda")

SELF_TEST = """
extern "C" __global__ void self_test(const float* x, float* y) {
  y[threadIdx.x] = 2.0f * x[threadIdx.x];
}
"""


@functools.cache
def works() -> bool:
    """Whether kernels run here: NVRTC compiles, XLA launches. Tested once; a failure warns."""

    def double(x: np.ndarray) -> jax.Array:
        test = Kernel(SELF_TEST, "self_test", x.size, 1, (False,))
        run = jax.jit(lambda x: launch(test, [x], [ShapedArray(x.shape, x.dtype)])[0])
        return run(jax.device_put(x, gpu()))

    return self_test.passes(
        double,
        "rbjax: kernels of threads do not run here ({}), so batches run under XLA, several times "
        'slower. Install what they need with pip install "rbjax[cuda]", and a recent jax.',
    )
