"""Options of the XLA compiler that make programs on lanes fastest on the CPU.

By default LLVM uses vectors of 256 bits, even if a core has 512. The fusion emitters of jaxlib
0.10, on by default, compile a loop with many results (`fusion_barrier`) slower and to slower code
than the older compiler. jaxlib 0.11 has only the emitters.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import get_opaque_trace_state

_AT_IMPORT = get_opaque_trace_state()
WIDE = ("xla_cpu_prefer_vector_width", 512)
WITHOUT_EMITTERS = ("xla_cpu_use_fusion_emitters", False)


@functools.cache
def xla_accepts(option: str, value: Any) -> bool:
    """Check whether this jaxlib's compiler has an option; the options change with its version."""
    try:
        jax.jit(lambda x: x + 1, compiler_options={option: value}).lower(1.0).compile()
    except jax.errors.JaxRuntimeError:  # any other cause recurs when compiling without the option
        return False
    return True


def compiler_options() -> dict[str, Any]:
    """Return the options of `jax.jit` that make rbjax fastest on the CPU; none on other platforms.

    The options are vectors of 512 bits (a core with fewer uses its own width), and no fusion
    emitters if jaxlib can switch them off. They shorten run times of rollouts in f64
    (benchmarks/results/work-precision-*.json, "options") and compile times of implicit methods
    (benchmarks/results/cpu-implicit-*.json). JAX accepts options only at the outermost `jit`, so
    pass them to your own `jit`. An algorithm, a `rollout` or a `simulate` outside any `jit` already
    uses them.

    Returns:
        name -> value, of the options that this jaxlib has.

    Example:
        >>> import rbjax as rb, jax
        >>> model = rb.load("pendulum")
        >>> run = jax.jit(rb.mass_matrix, compiler_options=rb.compiler_options())
        >>> run(model, model.default_state().q).shape
        (1, 1)
    """
    return _known(WIDE, WITHOUT_EMITTERS)


def wide_vectors() -> dict[str, Any]:
    """Return the compiler option of 512-bit vectors, without the option of the fusion emitters. Use
    it for arctangents and logarithms, which the older compiler computes twice."""
    return _known(WIDE)


def _known(*options: tuple[str, Any]) -> dict[str, Any]:
    if jax.default_backend() != "cpu":
        return {}
    return dict(option for option in options if xla_accepts(*option))


def alone() -> bool:
    """Return True if a call is outside any trace and any transformation of JAX."""
    return get_opaque_trace_state() == _AT_IMPORT and _imported_alone()


@functools.cache
def _imported_alone() -> bool:
    """Return True if this module was imported outside any trace. Call it only in the trace state of
    the import: the result is cached."""
    return not isinstance(jnp.zeros(()), jax.core.Tracer)


def inside_jit() -> bool:
    """Check whether a program is being traced (by jit, scan ...). A vmap or grad outside any jit is
    not such a trace."""
    return not alone() and isinstance(jnp.zeros(()), jax.core.Tracer)


def compiled(
    f: Callable,
    jit: Callable = jax.jit,
    options: Callable[[], dict[str, Any]] = compiler_options,
    **how: Any,
) -> Callable:
    """Return `jit(f, **how)`, with the compiler options `options()` for calls outside any trace."""
    program = jitted(f, jit, options, **how)

    def call(*args: Any, **kwargs: Any) -> Any:
        return program()(*args, **kwargs)

    return call


def jitted(
    f: Callable,
    jit: Callable = jax.jit,
    options: Callable[[], dict[str, Any]] = compiler_options,
    **how: Any,
) -> Callable[[], Callable]:
    """Return a function that returns `jit(f, **how)`, with `options` only outside any trace,
    because JAX accepts options only at the outermost `jit`."""

    @functools.cache
    def program(with_options: bool) -> Callable:
        return jit(f, compiler_options=options() if with_options else None, **how)

    return lambda: program(alone())
