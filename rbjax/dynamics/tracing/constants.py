"""Dof constants, computed before the programs that read them."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

from rbjax.compiler.jax.function import trace
from rbjax.compiler.jax.primitive import run
from rbjax.model import Model, with_constants


def with_compiled_constants(model: Model, dtype: Any) -> Model:
    """`with_constants` as a program of its own, which compiles sooner than under XLA."""
    if model.execution.constants is not None:
        return model
    found: list[Any] = []

    def numbers() -> list[jax.Array]:
        leaves, tree = jax.tree.flatten(with_constants(model, dtype).execution.constants)
        found[:] = leaves, tree
        return [x for x in leaves if isinstance(x, jax.core.Tracer)]

    program, operands = trace(numbers, [])
    program = dataclasses.replace(program, compile_fast=True)
    leaves, tree = found
    made = iter(run(program, operands) if operands else ())
    known = [next(made) if isinstance(x, jax.core.Tracer) else x for x in leaves]
    return model.replace(constants=jax.tree.unflatten(tree, known))
