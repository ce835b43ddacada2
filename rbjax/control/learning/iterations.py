"""The iterations of a training as one program.

    x_0 = begin(...),    x_{k+1}, c_k = turn(x_k)

XLA compiles all of them as one loop, or in chunks that report progress. Compiling takes longer
than a short training, so for a short one on a GPU it is shortened.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.compiler import fast_compile
from rbjax.progress import progress_line

CHUNKS = 10  # reports of progress

#: On a GPU XLA measures ways to multiply matrices for some five seconds, and kernels are optimised
#: for three: more than this many iterations of a small policy take
UNMEASURED = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}
OPTIMISED_FROM = 2000


def iterated(
    where: str, turn: Callable, begin: Callable, given: tuple, iterations: int, progress: bool
) -> tuple[Any, jax.Array]:
    """All iterations from begin(*given), in one program, or in chunks that report."""
    quick = jax.default_backend() == "gpu" and iterations < OPTIMISED_FROM
    options: Any = UNMEASURED if quick else None
    first = jax.jit(
        lambda count, *given: jax.lax.scan(turn, begin(*given), None, count), static_argnums=0,
        compiler_options=options,
    )
    more = jax.jit(lambda now, count: jax.lax.scan(turn, now, None, count), static_argnums=1,
                   compiler_options=options)  # fmt: skip
    with fast_compile(quick):
        return _run(where, first, more, given, iterations, progress)


def _run(
    where: str, first: Callable, more: Callable, given: tuple, iterations: int, progress: bool
) -> tuple[Any, jax.Array]:
    if not progress:
        return first(iterations, *given)
    chunk = max(1, iterations // CHUNKS)
    with progress_line(where) as say:
        say("compiling")
        now, some = first(min(chunk, iterations), *given)
        costs, done = [some], len(some)
        while done < iterations:
            say(f"iteration {done} of {iterations}, cost of a step {float(some[-1]):.4g}")
            now, some = more(now, min(chunk, iterations - done))
            costs.append(some)
            done += len(some)
    return now, jnp.concatenate(costs)
