"""`threads`: a function of one sample, whose batch runs as one kernel.

There are two primitives. `threads_p` evaluates a `Program` for a batch. `tangent_p` (`tangents`)
evaluates its derivative along tangents, in which it is linear. `vmap` adds an axis to the batch,
and operands keep their layout. Values that depend on no sample are computed once, outside of the
kernel. In reverse mode the kernel of the transposed function recomputes the forward values in
registers. Only the arguments are stored in memory, and the values that a `Program` keeps.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from numpy.typing import DTypeLike

from rbjax._jax_compat import (
    apply_primitive,
    device_count,
    is_manual,
    like,
    needs_devices,
    varying_axes,
)
from rbjax.compiler.cuda import kernels as cuda
from rbjax.compiler.cuda import team
from rbjax.compiler.ir.program import Layout
from rbjax.compiler.ir.values import Unsupported
from rbjax.compiler.jax import backend, host_call, launch
from rbjax.compiler.jax.programs import Program
from rbjax.compiler.jax.sharding import spread
from rbjax.compiler.jax.uncollected import uncollected
from rbjax.compiler.jax.uniform import divided
from rbjax.compiler.llvm import jit as llvm_jit
from rbjax.compiler.lower.lowering import Equation, Lowering, rule
from rbjax.compiler.lower.write import write_program

Axes = tuple[int | None, ...]

# ------------------------------------------------------------------- evaluation

threads_p = Primitive("threads")
threads_p.multiple_results = True


def run(
    program: Program, operands: Sequence[jax.Array], batch: tuple[int, ...] = (),
    ins: Sequence[Axes] | None = None, outs: Sequence[Axes] | None = None,
) -> list[jax.Array]:  # fmt: skip
    """Runs the program for a batch. `ins`, `outs`: the place of each axis of the batch in each
    operand and result. A result without a place is summed over the batch."""
    first = tuple(range(len(batch)))
    ins = tuple(ins) if ins is not None else ((None,) * len(batch),) * len(operands)
    outs = tuple(outs) if outs is not None else (first,) * len(program.outputs)
    return threads_p.bind(*_alike(operands), program=program, batch=batch, ins=ins, outs=outs)


def _alike(operands: Sequence[jax.Array]) -> list[jax.Array]:
    """The operands, all varying along the same axes of a mesh."""
    own = [varying_axes(jax.typeof(x)) for x in operands]
    every = frozenset().union(*own)
    return [
        jax.lax.pcast(x, tuple(every - v), to="varying") if every - v else x
        for x, v in zip(operands, own, strict=True)
    ]


def result(shape: tuple[int, ...], dtype: DTypeLike, operands: Sequence[jax.Array]) -> ShapedArray:
    """A result, which varies along the axes of the operands."""
    if not any(varying_axes(x) for x in operands):
        return ShapedArray(shape, dtype)
    return like(operands[0], shape, dtype)


def batched_shape(sample: tuple[int, ...], batch: tuple[int, ...], axes: Axes) -> tuple[int, ...]:
    """The shape of an array with these axes of the batch."""
    sizes = {axis: n for axis, n in zip(axes, batch, strict=True) if axis is not None}
    rest = iter(sample)
    return tuple(sizes[k] if k in sizes else next(rest) for k in range(len(sizes) + len(sample)))


@threads_p.def_abstract_eval
def _(*operands, program, batch, ins, outs):
    return [
        result(batched_shape(a.shape, batch, axes), a.dtype, operands)
        for a, axes in zip(program.outputs, outs, strict=True)
    ]


threads_p.def_impl(functools.partial(apply_primitive, threads_p))


def _inner(axes: Axes, level: int) -> int | None:
    """The place of an axis of the batch after those before it are removed."""
    axis = axes[level]
    return None if axis is None else axis - sum(a is not None and a < axis for a in axes[:level])


def under_xla(*operands, program, batch, ins, outs):
    """The same by `vmap` of the traced function."""
    f: Callable = program
    for level in reversed(range(len(batch))):
        axes = [_inner(a, level) for a in ins]
        if all(a is None for a in axes):  # no operand has this axis: one result for all
            f = functools.partial(_repeated, f, batch[level])
        else:
            f = jax.vmap(f, in_axes=axes)
    return [placed(x, axes) for x, axes in zip(f(*operands), outs, strict=True)]


def _repeated(f: Callable, size: int, *args: Any) -> list[jax.Array]:
    return [jnp.broadcast_to(x, (size, *x.shape)) for x in f(*args)]


def placed(x: Any, axes: Axes) -> Any:
    """A result with the batch first, with its axes moved to their places, or summed."""
    gone = tuple(k for k, axis in enumerate(axes) if axis is None)
    x = x.sum(gone) if gone else x
    there = [axis for axis in axes if axis is not None]
    return jnp.moveaxis(x, range(len(there)), there)


def as_kernel(platform, *operands, program, batch, ins, outs):
    """The same by a kernel; under XLA if the compiler does not support a primitive."""
    if 0 in batch:
        return [jnp.zeros(a.shape, a.dtype) for a in threads_p.abstract_eval(
            *operands, program=program, batch=batch, ins=ins, outs=outs)[0]]  # fmt: skip
    summed = tuple(bool(batch) and all(a is None for a in axes) for axes in outs)
    shapes = tuple(x.shape for x in operands)
    try:
        code = _kernel(platform, program, batch, ins, outs, shapes, summed)
        results = [
            ShapedArray(
                (code.grid, *a.shape) if s else batched_shape(a.shape, batch, axes), a.dtype
            )
            for a, axes, s in zip(program.outputs, outs, summed, strict=True)
        ]
        found = (launch if platform == "cuda" else host_call).launch(code, operands, results)
    except Unsupported as reason:
        _say(str(reason))
        return under_xla(*operands, program=program, batch=batch, ins=ins, outs=outs)
    return [x.sum(0) if s else x for x, s in zip(found, summed, strict=True)]


def on_gpu(*operands, program, batch, ins, outs):
    """The same by one or more kernels of a GPU."""
    how = {"batch": batch, "ins": ins, "outs": outs}
    samples = math.prod(batch)
    if samples and (program.once or program.goes_apart(samples)):
        return under_xla(*operands, program=program if program.once else program.apart, **how)
    return as_kernel("cuda", *operands, program=program, **how)


def on_cpu(*operands, **how):
    """The same by machine code."""
    return as_kernel("cpu", *operands, **how)


@functools.lru_cache(maxsize=256)
@uncollected
def _kernel(platform, program, batch, ins, outs, shapes, summed):
    operands = [Layout(shape, axes) for shape, axes in zip(shapes, ins, strict=True)]
    results = [
        Layout(a.shape, ()) if s else Layout(batched_shape(a.shape, batch, axes), axes)
        for a, axes, s in zip(program.outputs, outs, summed, strict=True)
    ]
    how = program.closed, batch, operands, results, summed, platform
    if platform == "cpu":
        levels = llvm_jit.MATRIX_LEVELS if program.team else llvm_jit.LEVELS
        levels = llvm_jit.QUICK_LEVELS if program.once and not batch else levels
        single = program.team and not batch
        return host_call.host_kernel(write_program(*how, matrices=single), levels)
    if program.team and team.fits(written := write_program(*how, team=True)):
        return team.kernel(written)
    return cuda.kernel(write_program(*how))


@functools.cache
def _say(reason: str) -> None:
    warnings.warn(
        f"rbjax.compiler: no kernel for {reason}; the function runs under XLA", stacklevel=2
    )


def _lower(evaluate, ctx, *operands, program, batch, ins, outs):
    """For one device, or for several that each evaluate their part of the batch."""
    how = {"program": program, "ins": ins, "outs": outs}
    devices = device_count(ctx)

    def part(batch):
        return functools.partial(evaluate, batch=batch, **how)

    run = part(batch)
    if devices > 1 and batch and not is_manual(ctx):
        ranks = [len(a.shape) for a in ctx.avals_in], [len(a.shape) for a in ctx.avals_out]
        run = spread(part, batch, ins, outs, ranks)
    # each device is independent: constants inside need not vary like operands
    own = ctx.replace(avals_in=[ShapedArray(a.shape, a.dtype) for a in ctx.avals_in])
    return mlir.lower_fun(run, multiple_results=True)(own, *operands)


def _lower_for_gpu(ctx, *operands, **how):
    return _lower(on_gpu if launch.works() else under_xla, ctx, *operands, **how)


def _lower_for_cpu(ctx, *operands, **how):
    return _lower(on_cpu if backend.on_cpu() else under_xla, ctx, *operands, **how)


mlir.register_lowering(threads_p, functools.partial(_lower, under_xla))
needs_devices(threads_p)
mlir.register_lowering(threads_p, _lower_for_cpu, platform="cpu")
mlir.register_lowering(threads_p, _lower_for_gpu, platform="cuda")


@rule("threads")
def _inside(low: Lowering, eqn: Equation, ins: list) -> list:
    """A program inside a thread, which runs a batch of it in a loop."""
    program, how = eqn.params["program"], eqn.params
    if not how["batch"]:
        return low.closed(program.closed, ins)
    f = functools.partial(under_xla, **how)
    return low.evaluate(f, *ins, avals=[v.aval for v in eqn.invars])


# ------------------------------------------------------------------- batches


def with_axis(new: int | None, axes: Axes) -> Axes:
    """The places of the axes of a batch after a new first one is added at `new`."""
    return (new, *(a if a is None or new is None or a < new else a + 1 for a in axes))


def _batched(operands, dims, program, batch, ins, outs):
    """The same with one more axis, before the others."""
    size = next(x.shape[d] for x, d in zip(operands, dims, strict=True) if d is not None)
    known = tuple(
        d is None and all(a is None for a in axes) for d, axes in zip(dims, ins, strict=True)
    )
    varying = any(varying_axes(jax.typeof(x)) for x in operands)
    if program.up_to is not None and not program.goes_apart(size * math.prod(batch)):
        program = dataclasses.replace(program, apart=None, up_to=None)
    own_ways = program.vjp, program.sized, program.apart  # these take the operands as they are
    if any(known) and not varying and own_ways == (None, None, None):
        program, more = divided(program, known, operands, run)
        operands = [x for x, k in zip(operands, known, strict=True) if not k] + more
        dims = [d for d, k in zip(dims, known, strict=True) if not k] + [None] * len(more)
        nowhere = (None,) * len(batch)
        ins = [a for a, k in zip(ins, known, strict=True) if not k] + [nowhere] * len(more)
    moved = tuple(with_axis(d, axes) for d, axes in zip(dims, ins, strict=True))
    last = _lies_last(operands, dims, ins)
    new, where = [], []
    for a, axes in zip(program.outputs, outs, strict=True):
        if all(x is None for x in axes) and batch:  # the sum over samples is taken afterwards
            axes = tuple(range(len(batch)))
        at = len(a.shape) + sum(x is not None for x in axes) if last else 0
        new.append(with_axis(at, axes))
        where.append(at)
    found = run(program, operands, (size, *batch), moved, new)
    out: list[Any] = []
    for x, axes, at in zip(found, outs, where, strict=True):
        if all(k is None for k in axes) and batch:
            inner = tuple(k for k in range(x.ndim) if k in new[len(out)][1:])
            x, at = x.sum(inner), at - sum(k < at for k in inner)
        out.append(x)
        where[len(out) - 1] = at
    return out, where


def _lies_last(operands, dims, ins) -> bool:
    """Whether all operands with the new axis have it last, after the entries of the sample."""
    found = [
        d == x.ndim - 1 and x.ndim > 1 + sum(a is not None for a in axes)
        for x, d, axes in zip(operands, dims, ins, strict=True)
        if d is not None and x.ndim > 1 + sum(a is not None for a in axes)
    ]
    return bool(found) and all(found)


batching.primitive_batchers[threads_p] = _batched
