"""Options of XLA's compiler under which programs on lanes run fastest on the CPU.

LLVM uses vectors of 256 bits unless told otherwise, also where a core has 512. And jaxlib 0.10's
fusion emitters, on by default, compile a loop with many results (`fusion_barrier`) slower and to
slower code than what they replace; jaxlib 0.11 has nothing else.
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
    """Whether this jaxlib's compiler knows an option: jaxlibs come and go with them."""
    try:
        jax.jit(lambda x: x + 1, compiler_options={option: value}).lower(1.0).compile()
    except jax.errors.JaxRuntimeError as error:
        if "compile option" not in str(error):
            raise
        return False
    return True


def compiler_options() -> dict[str, Any]:
    """Options for `jax.jit` under which rbjax runs fastest on the CPU; none on other platforms.

    Vectors of 512 bits (a core that has fewer uses what it has), and no fusion emitters where
    jaxlib can do without: rollouts of an arm in f64 take 0.7 of the time, of a humanoid 0.9
    (benchmarks/results/work-precision-*.json, "options"), implicit methods on an arm 0.5 to 0.9 of
    the time to compile (benchmarks/results/cpu-implicit-*.json). JAX takes them at the outermost
    `jit` alone, so they are the caller's to give; an algorithm, a `rollout` or a `simulate` that is
    called with nothing around it has them.

    Returns:
        what this jaxlib knows of them, name -> value.

    Example:
        >>> import rbjax as rb, jax
        >>> model = rb.load("pendulum")
        >>> run = jax.jit(rb.mass_matrix, compiler_options=rb.compiler_options())
        >>> run(model, model.default_state().q).shape
        (1, 1)
    """
    return _known(WIDE, WITHOUT_EMITTERS)


def wide_vectors() -> dict[str, Any]:
    """The option for arctangents and logarithms, which without the emitters are computed twice."""
    return _known(WIDE)


def _known(*options: tuple[str, Any]) -> dict[str, Any]:
    if jax.default_backend() != "cpu":
        return {}
    return dict(option for option in options if xla_accepts(*option))


def alone() -> bool:
    """Whether nothing is around a call: no program that is recorded, nothing transformed."""
    return get_opaque_trace_state() == _AT_IMPORT and _imported_alone()


@functools.cache
def _imported_alone() -> bool:
    """Whether no program was recorded around the import; asked where all is as it was then."""
    return not isinstance(jnp.zeros(()), jax.core.Tracer)


def inside_jit() -> bool:
    """Whether a program is being recorded (by jit, scan ...), rather than numbers transformed (by
    a vmap or grad outside of any jit)."""
    return not alone() and isinstance(jnp.zeros(()), jax.core.Tracer)


def compiled(
    f: Callable,
    jit: Callable = jax.jit,
    options: Callable[[], dict[str, Any]] = compiler_options,
    **how: Any,
) -> Callable:
    """`jit(f, **how)`, with `options` for calls that stand alone: JAX takes options at the
    outermost `jit` and nowhere else."""

    @functools.cache
    def program(with_options: bool) -> Callable:
        return jit(f, compiler_options=options() if with_options else None, **how)

    def call(*args: Any, **kwargs: Any) -> Any:
        return program(alone())(*args, **kwargs)

    return call
