"""Derivatives of programs: tangents beside the values, and cotangents by transposing the tangents.

A tangent is a primitive of its own, linear in the tangents of the arguments. So JAX transposes it
for a reverse derivative, and a batch of directions of one sample is a batch of tangents only.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from rbjax._jax_compat import needs_devices
from rbjax.compiler.jax.primitive import batched_shape, placed, result, run, threads_p, with_axis
from rbjax.compiler.lower.lowering import Equation, Lowering, rule

#: so many directions fill a sector of a GPU's memory
DIRECTIONS = 8

tangent_p = Primitive("threads_tangent")
tangent_p.multiple_results = True
"""Operands: arguments, values that the program keeps, and the tangents of moving arguments."""


def _as_threads(program, moving, batch, ins, outs):
    return {"program": program.tangent(moving), "batch": batch, "ins": ins, "outs": outs}


@tangent_p.def_abstract_eval
def _(*operands, program, moving, batch, ins, outs):
    return [
        result(batched_shape(a.shape, batch, axes), a.dtype, operands)
        for a, axes in zip(program.outputs, outs, strict=True)
    ]


def _evaluate(*operands, program, moving, batch, ins, outs):
    return threads_p.bind(*operands, **_as_threads(program, moving, batch, ins, outs))


tangent_p.def_impl(_evaluate)
mlir.register_lowering(tangent_p, mlir.lower_fun(_evaluate, multiple_results=True))
needs_devices(tangent_p)


@rule("threads_tangent")
def _tangent_inside(low: Lowering, eqn: Equation, ins: list) -> list:
    f = functools.partial(_evaluate, **eqn.params)
    return low.evaluate(f, *ins, avals=[v.aval for v in eqn.invars])


def _batched_tangent(operands, dims, program, moving, batch, ins, outs):
    size = next(x.shape[d] for x, d in zip(operands, dims, strict=True) if d is not None)
    moved = tuple(with_axis(d, axes) for d, axes in zip(dims, ins, strict=True))
    # many directions of one sample lie last, as in a Jacobian: threads write side by side
    fixed = len(moving) + len(program.kept(moving))
    last = size >= DIRECTIONS and all(d is None for d in dims[:fixed])
    at = [len(a.shape) + len(batch) if last else 0 for a in program.outputs]
    new = tuple(with_axis(k, axes) for k, axes in zip(at, outs, strict=True))
    out = tangent_p.bind(
        *operands, program=program, moving=moving, batch=(size, *batch), ins=moved, outs=new
    )
    return out, at


batching.primitive_batchers[tangent_p] = _batched_tangent


def _rates(primals, tangents):
    """Which arguments have tangents, and these tangents."""
    moving = tuple(type(t) is not ad.Zero and _is_float(x) for x, t in zip(
        primals, tangents, strict=True))  # fmt: skip
    return moving, [t for t, m in zip(tangents, moving, strict=True) if m]


def _zero(x: Any) -> ad.Zero:
    """The zero tangent of an argument that does not move."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def _is_float(x: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def _jvp(primals, tangents, *, program, batch, ins, outs):
    moving, rates = _rates(primals, tangents)
    if not any(moving):
        found = run(program, primals, batch, ins, outs)
        return found, [_zero(x) for x in found]
    if program.sized is not None:
        program = program.sized(math.prod(batch), moving)
    n, kept = len(program.outputs), []
    if program.keeping is None:
        found = run(program, primals, batch, ins, outs)
    else:
        # internal values have the layout that threads read fastest
        keeping = program.keeping(moving)
        last = [tuple(range(a.ndim, a.ndim + len(batch))) for a in keeping.outputs[n:]]
        places = (*outs, *last)
        found = run(keeping, primals, batch, ins, places)
        kept = found[program.reads :]
    kept_axes = places[program.reads :] if kept else ()
    axes = (*ins, *kept_axes, *(a for a, m in zip(ins, moving, strict=True) if m))
    first = tuple(range(len(batch)))
    whole = tuple(first if None in a else a for a in outs)  # sums over samples are taken here
    rate = tangent_p.bind(
        *primals, *kept, *rates, program=program, moving=moving, batch=batch, ins=axes, outs=whole
    )
    return found[:n], [
        (t if own == a else placed(t, a)) if _is_float(t) else _zero(x)
        for t, own, a, x in zip(rate, whole, outs, found[:n], strict=True)
    ]


ad.primitive_jvps[threads_p] = _jvp


def _jvp_of_tangent(primals, tangents, *, program, moving, batch, ins, outs):
    return _jvp(primals, tangents, **_as_threads(program, moving, batch, ins, outs))


ad.primitive_jvps[tangent_p] = _jvp_of_tangent


def _transpose(bars, *operands, program, moving, batch, ins, outs):
    n = len(moving) + len(program.kept(moving))
    weighed = tuple(type(bar) is not ad.Zero for bar in bars)
    if not any(weighed):
        return [None] * n + [ad.Zero(x.aval) if ad.is_undefined_primal(x) else None
                             for x in operands[n:]]  # fmt: skip
    given = [bar for bar, w in zip(bars, weighed, strict=True) if w]
    first = tuple(range(len(batch)))
    there = [a for a, w in zip(outs, weighed, strict=True) if w]
    axes, places = ins[n:], []
    for a in axes:  # summed in the kernel if an operand has no batch at all
        whole = all(k is not None for k in a) or all(k is None for k in a)
        places.append(a if whole else first)
    found = run(
        program.transposed(moving, weighed), [*operands[:n], *given], batch, [*ins[:n], *there],
        places,
    )  # fmt: skip
    found = [x if o == a else placed(x, a) for x, o, a in zip(found, places, axes, strict=True)]
    return [None] * n + [
        x if ad.is_undefined_primal(y) else None for x, y in zip(found, operands[n:], strict=True)
    ]


ad.primitive_transposes[tangent_p] = _transpose
