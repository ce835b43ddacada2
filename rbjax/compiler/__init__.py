"""Compiles a function of one sample: one GPU thread a sample, or one SIMD lane of the CPU.

`threads` batches a function through `jax.vmap`; `compile` gives a Python function that runs one
sample; `explain` shows the program that a function becomes.

    ir      the program of one thread: statements, operations, the builder that writes it
    lower   from a jaxpr to a program, one rule a primitive
    passes  analyses and transformations of a finished program
    cuda    back end of NVIDIA GPUs: C, compiled by NVRTC
    llvm    back end of CPUs: LLVM IR, one sample a lane of a vector
    jax     the JAX primitive: batching, derivatives, sharding, calls from XLA
"""

from rbjax.compiler.cuda.nvrtc import quickly as quickly
from rbjax.compiler.ir.values import Unsupported as Unsupported
from rbjax.compiler.jax.backend import wanted as wanted
from rbjax.compiler.jax.explain import Explanation as Explanation
from rbjax.compiler.jax.explain import explain as explain
from rbjax.compiler.jax.function import in_parts as in_parts
from rbjax.compiler.jax.function import side_by_side as side_by_side
from rbjax.compiler.jax.function import threaded as threaded
from rbjax.compiler.jax.function import threads as threads
from rbjax.compiler.jax.native import compile as compile

__all__ = ["Explanation", "Unsupported", "compile", "explain", "threads"]
