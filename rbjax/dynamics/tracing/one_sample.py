"""One program for a function of one sample: a GPU thread, or a SIMD lane of machine code."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiler import kernels_available
from rbjax.compiler.jax.function import trace
from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.uniform import hoist_uniform
from rbjax.dynamics.tracing.custom_rules import split_tracers

MOST_PROGRAMS = 32  # traced programs that a cache keeps


def run_sample(
    f: Callable,
    own: Any,
    shared: Any = (),
    *,
    saves: bool = False,
    multi_kernel: Callable | None = None,
    cache: dict | None = None,
) -> Any:
    """Compute f(own, shared), whose `vmap` is one kernel.

    Values that are not traced are constants of the program. If no device runs kernels, XLA runs f.

    own: arguments of the sample, a pytree.
    shared: arguments that all samples of a batch usually share, a pytree. Work that depends only on
        them is done once.
    saves: whether a reverse derivative saves the named values of the forward pass.
    multi_kernel: function of the traced values of `own` that computes the leaves of the result in
        several kernels, for a large model on a GPU; or None.
    cache: programs of f that are already traced, by their arguments; None to trace f at each call.
        f must not close over traced values then. It keeps the last MOST_PROGRAMS programs, so that
        it does not grow with each new constant.
    """
    moving, closed = split_tracers((own, shared))
    if not moving or not kernels_available():
        return f(own, shared)
    key = _key((own, shared)) if cache is not None else None
    found = cache.get(key) if cache is not None else None
    if found is None:
        structure: list[Any] = []

        def flat(*args: jax.Array) -> list[jax.Array]:
            leaves, tree = jax.tree.flatten(f(*closed(list(args))))
            structure.append(tree)
            return [jnp.asarray(x) for x in leaves]

        program, closed_over = trace(flat, moving)
        if saves:
            program = dataclasses.replace(program, saves=True)
        if multi_kernel is not None:
            program = dataclasses.replace(program, multi_kernel=multi_kernel)
        found = program, closed_over, structure[0], (own, shared)
        if cache is not None and not closed_over:
            # JAX arrays are identified by `id`, so they are kept
            cache[key] = *found[:3], closed([None] * len(moving))
            while len(cache) > MOST_PROGRAMS:
                cache.pop(next(iter(cache)))
    program, closed_over, tree, _ = found
    count = len(split_tracers(own)[0])
    if count == len(moving):
        return jax.tree.unflatten(tree, run(program, [*closed_over, *moving]))
    known = [True] * len(closed_over) + [False] * count + [True] * (len(moving) - count)
    operands = [*closed_over, *[None] * count, *moving[count:]]
    program, uniform = hoist_uniform(program, known, operands, run)
    return jax.tree.unflatten(tree, run(program, [*moving[:count], *uniform]))


def _key(given: Any) -> tuple:
    """Return the key of a program: types of traced values, and constants."""
    leaves, tree = jax.tree.flatten(given)
    return tree, *map(_identity, leaves)


def _identity(x: Any) -> Any:
    """Return the type of a traced value, the entries of a NumPy array, or the id of a JAX array."""
    if isinstance(x, jax.core.Tracer):
        return x.shape, x.dtype
    if isinstance(x, np.ndarray | np.generic):
        return x.shape, x.dtype, x.tobytes()
    return id(x)
