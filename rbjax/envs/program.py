"""One program for a function of one sample: a GPU thread, or a SIMD lane of machine code."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.compiler import kernels_available
from rbjax.compiler.jax.function import trace
from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.uniform import hoist_uniform
from rbjax.dynamics.tracing.custom_rules import split_tracers


def run_program(f: Callable, own: Any, params: Any, *, saves: bool) -> Any:
    """Compute f(own, params), whose `vmap` is one kernel.

    Values that are not traced are constants of the program. Work that depends only on `params` is
    done once for a batch that shares them.

    own: arguments of the sample, a pytree.
    params: arguments that samples usually share, a pytree.
    saves: whether a reverse derivative saves the named values of the forward pass.
    """
    moving, closed_own = split_tracers(own)
    given, closed_params = split_tracers(params)
    if not (moving or given) or not kernels_available():
        return f(own, params)
    structure: list[Any] = []

    def flat(*args: jax.Array) -> list[jax.Array]:
        mine, theirs = list(args[: len(moving)]), list(args[len(moving) :])
        leaves, tree = jax.tree.flatten(f(closed_own(mine), closed_params(theirs)))
        structure.append(tree)
        return [jnp.asarray(x) for x in leaves]

    program, closed_over = trace(flat, [*moving, *given])
    shared = [True] * len(closed_over) + [False] * len(moving) + [True] * len(given)
    operands = [*closed_over, *[None] * len(moving), *given]
    if saves:
        program = dataclasses.replace(program, saves=True)
    program, uniform = hoist_uniform(program, shared, operands, run)
    return jax.tree.unflatten(structure[0], run(program, [*moving, *uniform]))
