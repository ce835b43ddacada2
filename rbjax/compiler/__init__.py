"""A compiler of functions of one sample: one GPU thread, or one SIMD lane of a CPU, runs a sample.

`threads` compiles a function for batches, by `jax.vmap`. `compile` returns a Python function that
runs one sample. `explain` describes the program that a function becomes.

    ir      the program of one thread: statements, operations, the builder that emits them
    lower   from a jaxpr to a program, by one rule per primitive
    passes  analyses and transformations of a finished program
    cuda    back end for NVIDIA GPUs: C, compiled by NVRTC
    llvm    back end for CPUs: LLVM IR, one sample per lane of a vector
    jax     the JAX primitive: batching, derivatives, sharding, calls from XLA
"""

from rbjax.compiler.cuda.nvrtc import fast_compile as fast_compile
from rbjax.compiler.ir.statements import Unsupported as Unsupported
from rbjax.compiler.jax.explain import Explanation as Explanation
from rbjax.compiler.jax.explain import explain as explain
from rbjax.compiler.jax.function import compile_threads as compile_threads
from rbjax.compiler.jax.function import map_threads as map_threads
from rbjax.compiler.jax.function import threads as threads
from rbjax.compiler.jax.function import with_multi_kernel as with_multi_kernel
from rbjax.compiler.jax.launch import kernels_available as kernels_available
from rbjax.compiler.jax.native import compile as compile

__all__ = ["Explanation", "Unsupported", "compile", "explain", "threads"]

__dir__ = __all__.copy
