"""Machine code inside a jitted program on the CPU, called by XLA without Python.

The code is a typed FFI handler (`llvm_xla`), registered by the hash of its IR: a program that JAX
has cached on disk finds it again in another process, because lowering registers it first.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import mlir

from rbjax.threads import llvm_jit, self_test
from rbjax.threads.custom_call import typed_call
from rbjax.threads.frame import Written, batch_first, write_program
from rbjax.threads.llvm_xla import handler
from rbjax.threads.lowering import Unsupported

#: code that XLA may call; it is never freed
_registered: dict[str, llvm_jit.Code] = {}


@dataclass(frozen=True)
class HostKernel:
    """A registered handler. grid: the parts of the batch, which are rows of each result that is
    summed over it."""

    name: str
    grid: int


def host_kernel(program: Written, levels: llvm_jit.Levels = llvm_jit.LEVELS) -> HostKernel:
    """The handler of a program.

    Raises:
        Unsupported: the program has an operation that LLVM lacks, or LLVM refuses it.
    """
    module, rows = handler(program)
    try:
        code = llvm_jit.compiled(module, levels)
    except llvm_jit.NoCompiler as error:
        raise Unsupported(str(error)) from error
    name = f"rbjax_{code.key}"
    if name not in _registered:
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(code.address), platform="cpu")
        _registered[name] = code
    return HostKernel(name, rows)


_kernel = Primitive("host_kernel")
_kernel.multiple_results = True
_kernel.def_abstract_eval(lambda *operands, results, name: list(results))


def launch(kernel: HostKernel, operands: Sequence[Any], results: Sequence[Any]) -> list[Any]:
    """The kernel's results, with these shapes and types. Only for programs lowered for a CPU."""
    return _kernel.bind(*operands, results=tuple(results), name=kernel.name)


def _lower(ctx: Any, *operands: Any, results: Any, name: str) -> Any:
    return typed_call(name, ctx, *operands)


mlir.register_lowering(_kernel, _lower, platform="cpu")


@functools.cache
def works() -> bool:
    """Whether machine code runs inside of XLA here. Tested once; a failure warns."""

    def double(x: np.ndarray) -> jax.Array:
        traced = jax.make_jaxpr(lambda x: [x + x])(x)
        places = [batch_first(x.shape, ())]
        test = host_kernel(write_program(traced, (), places, places))
        run = jax.jit(lambda x: launch(test, [x], [ShapedArray(x.shape, x.dtype)])[0])
        with jax.ensure_compile_time_eval(), jax.default_device(jax.devices("cpu")[0]):
            return run(x)

    return self_test.passes(
        double,
        "rbjax: machine code does not run inside of XLA here ({}), so functions on the CPU run "
        "under XLA, which takes longer.",
    )
