"""Machine code inside a jitted program on the CPU, called by XLA without Python.

The code is a typed FFI handler (`llvm_xla`), registered by the hash of its IR: a program that JAX
has cached on disk finds it again in another process, because lowering registers it first.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import mlir

from rbjax.compiler.ir.program import Written, batch_first
from rbjax.compiler.ir.values import Unsupported
from rbjax.compiler.jax import self_test
from rbjax.compiler.jax.custom_call import typed_call
from rbjax.compiler.llvm import jit as llvm_jit
from rbjax.compiler.llvm.xla_handler import handler
from rbjax.compiler.lower.write import write_program

#: code that XLA may call; never freed, because XLA does not report when it drops a handler
_registered: dict[str, llvm_jit.Code] = {}
_lock = threading.Lock()  # XLA rejects a second handler of one name


@dataclass(frozen=True)
class HostKernel:
    """A registered handler. grid: the parts of the batch, which are rows of each result that is
    summed over it."""

    name: str
    grid: int


def host_kernel(
    program: Written, levels: llvm_jit.Levels = llvm_jit.LEVELS, samples: int | None = None
) -> HostKernel:
    """The handler of a program. samples: the size of a part of the batch; None: by its work.

    Raises:
        Unsupported: the program has an operation that LLVM lacks, LLVM rejects it, or XLA rejects
            the handler.
    """
    module, rows = handler(program, samples)
    try:
        code = llvm_jit.compiled(module, levels)
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


_kernel = Primitive("host_kernel")
_kernel.multiple_results = True
_kernel.def_abstract_eval(lambda *operands, results, name: list(results))


def launch(
    kernel: HostKernel, operands: Sequence[jax.Array], results: Sequence[Any]
) -> list[jax.Array]:
    """The kernel's results, with these shapes and types. Only for programs lowered for a CPU."""
    return _kernel.bind(*operands, results=tuple(results), name=kernel.name)


def _lower(ctx: Any, *operands: Any, results: Any, name: str) -> Any:
    return typed_call(name, ctx, *operands)


mlir.register_lowering(_kernel, _lower, platform="cpu")


@functools.cache
def works() -> bool:
    """Whether machine code runs inside of XLA here. Tested once, with a batch of two parts; a
    failure warns."""

    def double(x: np.ndarray) -> jax.Array:
        traced, parts = jax.make_jaxpr(lambda x: [x + x])(x[0]), 2
        places = [batch_first((), x.shape)]
        program = write_program(traced, x.shape, places, places, platform="cpu")
        test = host_kernel(program, samples=x.size // parts)
        run = jax.jit(lambda x: launch(test, [x], [ShapedArray(x.shape, x.dtype)])[0])
        # with several processes the first device may belong to another process
        own = jax.local_devices(backend="cpu")[0]
        with jax.ensure_compile_time_eval(), jax.default_device(own):
            return run(x)

    return self_test.passes(
        double,
        "rbjax: machine code does not run inside of XLA here ({}), so functions on the CPU run "
        "under XLA, which takes longer.",
    )
