"""Rules for the primitives of Equinox and lineax, and for calls into Python.

A thread has no batch, so Equinox's selections by batch are constant, and its reductions over the
batch are the value itself.
"""

from __future__ import annotations

import functools

import numpy as np
from jax.extend.core import ClosedJaxpr

from rbjax._jax_compat import UNVMAP, is_error
from rbjax.compiler.ir.statements import Unsupported
from rbjax.compiler.lower.lowering import Equation, Lowering, rule
from rbjax.compiler.lower.reductions import reduce_entries


@rule("select_if_vmap", unread=(0, 2))
def _select_if_vmap(low: Lowering, eqn: Equation, ins: list) -> list:
    return [ins[1]]  # without a batch, a loop's predicate is true while the loop runs


@rule("maybe_set", "linear_solve")
def _implemented(low: Lowering, eqn: Equation, ins: list) -> list:
    f = functools.partial(eqn.primitive.impl, **eqn.params)  # which JAX traces
    return low.evaluate(f, *ins, avals=[v.aval for v in eqn.invars])


def _unvmap(low: Lowering, eqn: Equation, ins: list) -> list:
    dtype, name = eqn.outvars[0].aval.dtype, UNVMAP[eqn.primitive.name]
    x = ins[0]
    if not x.size:
        return [np.asarray(name == "and", dtype)]
    return [
        reduce_entries(
            low, x, tuple(range(x.ndim)), dtype, functools.partial(low.b.op, name, dtype)
        )
    ]


rule(*UNVMAP)(_unvmap)


@rule("pure_callback", "io_callback", "debug_callback", "debug_print")
def _callback(low: Lowering, eqn: Equation, ins: list) -> list:
    raise Unsupported(f"{eqn.primitive.name}, a call back into Python")


def only_reports(branch: ClosedJaxpr) -> bool:
    """Return whether a branch raises an error of `equinox.error_if`, which ends the run."""
    return any(map(is_error, branch.jaxpr.eqns))
