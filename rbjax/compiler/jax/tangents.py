"""Derivatives of programs: a linear primitive for tangents, which JAX transposes for cotangents.

A batch of directions at one sample batches only the tangents.
"""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from rbjax._jax_compat import needs_devices
from rbjax.compiler.jax.garbage import gc_paused
from rbjax.compiler.jax.primitive import add_axis, place_batch, result_avals, run, threads_p
from rbjax.compiler.jax.saved import inside, saving
from rbjax.compiler.lower.lowering import Equation, Lowering, rule

#: the number of directions that fill a sector of a GPU's memory
DIRECTIONS = 8

tangent_p = Primitive("threads_tangent")
tangent_p.multiple_results = True
"""Operands: arguments, residuals of the program, and the tangents of the moving arguments."""
tangent_p.def_abstract_eval(result_avals)


def _as_threads(program, moving, batch, ins, outs):
    return {"program": program.tangent(moving), "batch": batch, "ins": ins, "outs": outs}


def _evaluate(*operands, **params):
    return threads_p.bind(*operands, **_as_threads(**params))


tangent_p.def_impl(_evaluate)
mlir.register_lowering(tangent_p, mlir.lower_fun(_evaluate, multiple_results=True))
needs_devices(tangent_p)


@rule("threads_tangent")
def _tangent_inside(low: Lowering, eqn: Equation, ins: list) -> list:
    f = functools.partial(_evaluate, **eqn.params)
    return low.evaluate(f, *ins, avals=[v.aval for v in eqn.invars])


def _batched_tangent(operands, dims, program, moving, batch, ins, outs):
    size = next(x.shape[d] for x, d in zip(operands, dims, strict=True) if d is not None)
    moved = tuple(add_axis(d, axes) for d, axes in zip(dims, ins, strict=True))
    # many directions of one sample lie last, as in a Jacobian: threads write adjacent entries
    fixed = len(moving) + len(program.residuals(moving))
    last = size >= DIRECTIONS and all(d is None for d in dims[:fixed])
    at = [len(a.shape) + len(batch) if last else 0 for a in program.outputs]
    new = tuple(add_axis(k, axes) for k, axes in zip(at, outs, strict=True))
    out = tangent_p.bind(
        *operands, program=program, moving=moving, batch=(size, *batch), ins=moved, outs=new
    )
    return out, at


batching.primitive_batchers[tangent_p] = _batched_tangent


def _zero(x: jax.Array) -> ad.Zero:
    """Return the zero tangent of an argument."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def _is_float(x: jax.Array) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


@gc_paused()
def _jvp(primals, tangents, *, program, batch, ins, outs):
    pairs = zip(primals, tangents, strict=True)
    moving = tuple(type(t) is not ad.Zero and _is_float(x) for x, t in pairs)
    moved = [t for t, m in zip(tangents, moving, strict=True) if m]
    if not any(moving):
        found = run(program, primals, batch, ins, outs)
        return found, [_zero(x) for x in found]
    if program.for_batch_size is not None:
        program = program.for_batch_size(math.prod(batch), moving)
    if program.saves:
        program = saving(program, moving)
    n, residuals, positions = len(program.outputs), [], ()
    if program.forward_with_residuals is None:
        found = run(program, primals, batch, ins, outs)
    else:
        # residuals have the batch axes last, which threads read fastest
        forward, first = program.forward_with_residuals(moving), program.first_residual
        last = [tuple(range(a.ndim, a.ndim + len(batch))) for a in forward.outputs[n:]]
        found = run(forward, primals, batch, ins, (*outs, *last))
        residuals, positions = found[first:], (*outs, *last)[first:]
    axes = (*ins, *positions, *(a for a, m in zip(ins, moving, strict=True) if m))
    first = tuple(range(len(batch)))
    whole = tuple(first if None in a else a for a in outs)  # sums over samples come later
    rate = tangent_p.bind(
        *primals, *residuals, *moved, program=program, moving=moving, batch=batch, ins=axes,
        outs=whole,
    )  # fmt: skip
    return found[:n], [
        (t if own == a else place_batch(t, a)) if _is_float(t) else _zero(x)
        for t, own, a, x in zip(rate, whole, outs, found[:n], strict=True)
    ]


ad.primitive_jvps[threads_p] = _jvp


ad.primitive_jvps[tangent_p] = lambda primals, tangents, **params: _jvp(
    primals, tangents, **_as_threads(**params)
)


@gc_paused()
def _transpose(cotangents, *operands, program, moving, batch, ins, outs):
    n = len(moving) + len(program.residuals(moving))
    has_cotangent = tuple(type(c) is not ad.Zero for c in cotangents)
    if not any(has_cotangent):
        return [None] * n + [ad.Zero(x.aval) if ad.is_undefined_primal(x) else None
                             for x in operands[n:]]  # fmt: skip
    given = [bar for bar, w in zip(cotangents, has_cotangent, strict=True) if w]
    first = tuple(range(len(batch)))
    there = [a for a, w in zip(outs, has_cotangent, strict=True) if w]
    axes, positions = ins[n:], []
    for a in axes:  # sum in the kernel if an operand lacks all batch axes
        whole = all(k is not None for k in a) or all(k is None for k in a)
        positions.append(a if whole else first)
    with inside(program):
        transposed = program.transposed(moving, has_cotangent)
    found = run(transposed, [*operands[:n], *given], batch, [*ins[:n], *there], positions)
    found = [
        x if o == a else place_batch(x, a) for x, o, a in zip(found, positions, axes, strict=True)
    ]
    return [None] * n + [
        x if ad.is_undefined_primal(y) else None for x, y in zip(found, operands[n:], strict=True)
    ]


ad.primitive_transposes[tangent_p] = _transpose


def _transpose_linear(cotangents, *operands, program, batch, ins, outs):
    """Transpose a program that is linear in some operands: it is its own tangent, at zero."""
    moving = tuple(map(ad.is_undefined_primal, operands))
    at = [jnp.zeros(x.aval.shape, x.aval.dtype) if m else x
          for x, m in zip(operands, moving, strict=True)]  # fmt: skip
    along = [x for x, m in zip(operands, moving, strict=True) if m]
    axes = [a for a, m in zip(ins, moving, strict=True) if m]
    found = iter(_transpose(
        cotangents, *at, *along, program=program, moving=moving, batch=batch,
        ins=(*ins, *axes), outs=outs,
    )[len(at) :])  # fmt: skip
    return [next(found) if m else None for m in moving]


ad.primitive_transposes[threads_p] = _transpose_linear
