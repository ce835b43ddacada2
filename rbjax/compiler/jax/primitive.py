"""The primitive `threads`: a batch of a `Program`, which runs as one kernel.

`vmap` adds an axis to the batch, and operands keep their layout. Values that do not depend on the
sample are computed once, outside the kernel (`uniform`). The derivative is another primitive
(`tangents`), which is linear in the tangents.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Primitive
from jax.interpreters import batching, mlir

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
from rbjax.compiler.ir.program import BatchLayout, Written
from rbjax.compiler.ir.statements import Unsupported
from rbjax.compiler.jax import launch
from rbjax.compiler.jax.garbage import gc_paused
from rbjax.compiler.jax.programs import Program
from rbjax.compiler.jax.sharding import Axes, shard_batch
from rbjax.compiler.jax.uniform import hoist_uniform
from rbjax.compiler.llvm import jit as llvm_jit
from rbjax.compiler.lower.control import inner_jaxprs
from rbjax.compiler.lower.lowering import Equation, Lowering, placing_rule
from rbjax.compiler.lower.write import write_program

# ------------------------------------------------------------------- evaluation

threads_p = Primitive("threads")
threads_p.multiple_results = True


def run(
    program: Program, operands: Sequence[jax.Array], batch: tuple[int, ...] = (),
    ins: Sequence[Axes] | None = None, outs: Sequence[Axes] | None = None,
) -> list[jax.Array]:  # fmt: skip
    """Evaluate a program for a batch.

    Args:
        ins, outs: the position of each axis of the batch in each operand and result. A result
            without a position is summed over the batch.
    """
    first = tuple(range(len(batch)))
    ins = tuple(ins) if ins is not None else ((None,) * len(batch),) * len(operands)
    outs = tuple(outs) if outs is not None else (first,) * len(program.outputs)
    operands = _equally_varying(operands)
    return threads_p.bind(*operands, program=program, batch=batch, ins=ins, outs=outs)


def _equally_varying(operands: Sequence[jax.Array]) -> list[jax.Array]:
    """Make all operands vary along the same axes of a mesh (see `jax.lax.pcast`)."""
    own = [varying_axes(jax.typeof(x)) for x in operands]
    every = frozenset().union(*own)
    return [
        jax.lax.pcast(x, tuple(every - v), to="varying") if every - v else x
        for x, v in zip(operands, own, strict=True)
    ]


def batched_shape(sample: tuple[int, ...], batch: tuple[int, ...], axes: Axes) -> tuple[int, ...]:
    """Return the shape of an array of samples. axes: position of each axis of the batch in it."""
    sizes = {axis: n for axis, n in zip(axes, batch, strict=True) if axis is not None}
    rest = iter(sample)
    return tuple(sizes[k] if k in sizes else next(rest) for k in range(len(sizes) + len(sample)))


@threads_p.def_abstract_eval
def result_avals(*operands, program, batch, ins, outs, moving=None):
    """Return the avals of the results, which vary along the mesh axes of the operands."""
    varying = any(varying_axes(x) for x in operands)
    aval = functools.partial(like, operands[0]) if varying else ShapedArray
    return [
        aval(batched_shape(a.shape, batch, axes), a.dtype)
        for a, axes in zip(program.outputs, outs, strict=True)
    ]


threads_p.def_impl(functools.partial(apply_primitive, threads_p))


def _remaining_axis(axes: Axes, level: int) -> int | None:
    """Return the position of an axis of the batch after the axes before it are removed."""
    axis = axes[level]
    return None if axis is None else axis - sum(a is not None and a < axis for a in axes[:level])


def under_xla(*operands, program, batch, ins, outs, each=jax.vmap):
    """Evaluate a program for a batch under XLA, by `vmap` of the traced function.
    each: function (f, in_axes) that maps f over a batch."""
    f: Callable = program
    for level in reversed(range(len(batch))):
        axes = [_remaining_axis(a, level) for a in ins]
        if all(a is None for a in axes):  # no operand has this axis
            f = functools.partial(_repeated, f, batch[level])
        else:
            f = each(f, in_axes=axes)
    return [place_batch(x, axes) for x, axes in zip(f(*operands), outs, strict=True)]


def _one_by_one(f: Callable, in_axes: Sequence[int | None]) -> Callable:
    """Map f over a batch like `vmap`, in a loop over the samples. Samples may then take different
    numbers of iterations of a `while`."""

    def run(*args: jax.Array) -> list[jax.Array]:
        moved = [jnp.moveaxis(x, a, 0) for x, a in zip(args, in_axes, strict=True) if a is not None]

        def one(rows: list[jax.Array]) -> list[jax.Array]:
            own = iter(rows)
            given = zip(args, in_axes, strict=True)
            return f(*(x if a is None else next(own) for x, a in given))

        return jax.lax.map(one, moved)

    return run


def _repeated(f: Callable, size: int, *args: jax.Array) -> list[jax.Array]:
    return [jnp.broadcast_to(x, (size, *x.shape)) for x in f(*args)]


def place_batch(x: jax.Array, axes: Axes) -> jax.Array:
    """Move the leading batch axes of a result to their positions. Sum over those that lack one."""
    gone = tuple(k for k, axis in enumerate(axes) if axis is None)
    x = x.sum(gone) if gone else x
    there = [axis for axis in axes if axis is not None]
    return jnp.moveaxis(x, range(len(there)), there)


def as_kernel(platform, *operands, program, batch, ins, outs):
    """Evaluate a program for a batch by a kernel, or under XLA if a primitive is not supported."""
    if 0 in batch:
        params = {"program": program, "batch": batch, "ins": ins, "outs": outs}
        avals = threads_p.abstract_eval(*operands, **params)[0]
        return [jnp.zeros(a.shape, a.dtype) for a in avals]
    summed = tuple(bool(batch) and all(a is None for a in axes) for axes in outs)
    shapes = tuple(x.shape for x in operands)
    try:
        code = _kernel(platform, program, batch, ins, outs, shapes, summed)
        results = [
            ShapedArray(
                (code.parts, *a.shape) if s else batched_shape(a.shape, batch, axes), a.dtype
            )
            for a, axes, s in zip(program.outputs, outs, summed, strict=True)
        ]
        call = launch.launch_kernel if platform == "cuda" else launch.call_host_kernel
        found = call(code, operands, results)
    except Unsupported as reason:
        _warn(str(reason))
        return under_xla(*operands, program=program, batch=batch, ins=ins, outs=outs)
    return [x.sum(0) if s else x for x, s in zip(found, summed, strict=True)]


def on_gpu(*operands, program, batch, ins, outs):
    """Evaluate a program for a batch on a GPU: by one kernel, by several, or under XLA."""
    params = {"batch": batch, "ins": ins, "outs": outs}
    samples = math.prod(batch)
    if samples and program.compile_fast:
        return under_xla(*operands, program=program, **params)
    if samples and program.uses_multi_kernel(samples):
        return under_xla(*operands, program=program.multi_kernel, **params)
    return as_kernel("cuda", *operands, program=program, **params)


def on_cpu(*operands, **params):
    """Evaluate a program for a batch on a CPU by machine code."""
    return as_kernel("cpu", *operands, **params)


@functools.lru_cache(maxsize=256)
@gc_paused()
def _kernel(platform, program, batch, ins, outs, shapes, summed):
    operands = [BatchLayout(shape, axes) for shape, axes in zip(shapes, ins, strict=True)]
    results = [
        BatchLayout(a.shape, ()) if s else BatchLayout(batched_shape(a.shape, batch, axes), axes)
        for a, axes, s in zip(program.outputs, outs, summed, strict=True)
    ]
    args = program.closed, batch, operands, results, summed, platform
    if platform == "cpu":
        written = write_program(*args, matrices=program.team and not batch)
        return launch.register_host_kernel(written, _levels(program, written))
    if program.team and team.fits(written := write_program(*args, team=True)):
        return team.kernel(written)
    return cuda.kernel(write_program(*args), multiprocessor_bytes=launch.multiprocessor_bytes)


def _levels(program: Program, written: Written) -> llvm_jit.OptimizationLevels:
    """Return the optimization levels of a program on a CPU."""
    if written.batch:
        return llvm_jit.SAMPLE_LEVELS if program.team else llvm_jit.LEVELS
    if program.compile_fast:
        return llvm_jit.QUICK_LEVELS
    iterates = written.iterates and written.statements <= llvm_jit.SAMPLE_STATEMENTS
    return llvm_jit.SAMPLE_LEVELS if program.team or iterates else llvm_jit.LEVELS


@functools.cache
def _warn(reason: str) -> None:
    warnings.warn(
        f"rbjax.compiler: no kernel for {reason}; the function runs under XLA", stacklevel=2
    )


def _lower(evaluate, ctx, *operands, program, batch, ins, outs):
    """Lower the primitive for one device, or for several that each evaluate a part of the batch."""
    params = {"program": program, "ins": ins, "outs": outs}
    devices = device_count(ctx)

    def part(batch):
        return functools.partial(evaluate, batch=batch, **params)

    run = part(batch)
    if devices > 1 and batch and not is_manual(ctx):
        ranks = [len(a.shape) for a in ctx.avals_in], [len(a.shape) for a in ctx.avals_out]
        run = shard_batch(part, batch, ins, outs, ranks)
    # each device is independent, so constants inside need not vary like the operands
    own = ctx.replace(avals_in=[ShapedArray(a.shape, a.dtype) for a in ctx.avals_in])
    return mlir.lower_fun(run, multiple_results=True)(own, *operands)


def _lower_for_gpu(ctx, *operands, **params):
    return _lower(on_gpu if launch.kernels_work() else under_xla, ctx, *operands, **params)


def _lower_for_cpu(ctx, *operands, **params):
    return _lower(on_cpu if launch.uses_llvm() else under_xla, ctx, *operands, **params)


mlir.register_lowering(threads_p, functools.partial(_lower, under_xla))
needs_devices(threads_p)
mlir.register_lowering(threads_p, _lower_for_cpu, platform="cpu")
mlir.register_lowering(threads_p, _lower_for_gpu, platform="cuda")


def _has_while(closed: ClosedJaxpr) -> bool:
    """Return whether the number of iterations of some loop depends on values."""
    for eqn in closed.jaxpr.eqns:
        program = eqn.params.get("program")
        inner = [program.closed] if program is not None else [x for x, _ in inner_jaxprs(eqn)]
        if eqn.primitive.name == "while" or any(map(_has_while, inner)):
            return True
    return False


@placing_rule("threads")
def _inside(low: Lowering, eqn: Equation, ins: list, places: list) -> list:
    """Lower a program inside another program. A batch of it becomes a loop if the samples may take
    different numbers of iterations, else `vmap`, which keeps entries that are zero in all samples.
    """
    closed = eqn.params["program"].closed
    if not eqn.params["batch"]:
        return low.closed(closed, ins, places)
    each = _one_by_one if _has_while(closed) else jax.vmap
    f = functools.partial(under_xla, **eqn.params, each=each)
    return low.evaluate(f, *ins, avals=[v.aval for v in eqn.invars])


# ------------------------------------------------------------------- batches


def add_axis(new: int | None, axes: Axes) -> Axes:
    """Return the positions of the axes of a batch after a new first axis is inserted at `new`."""
    return (new, *(a if a is None or new is None or a < new else a + 1 for a in axes))


def _batched(operands, dims, program, batch, ins, outs):
    """Add an axis to the batch, before its other axes: the batching rule of the primitive."""
    size = next(x.shape[d] for x, d in zip(operands, dims, strict=True) if d is not None)
    known = tuple(
        d is None and all(a is None for a in axes) for d, axes in zip(dims, ins, strict=True)
    )
    varying = any(varying_axes(jax.typeof(x)) for x in operands)
    if program.max_batch is not None and not program.uses_multi_kernel(size * math.prod(batch)):
        program = dataclasses.replace(program, multi_kernel=None, max_batch=None)
    # these variants require the original operands, so shared work cannot be hoisted
    variants = program.vjp, program.for_batch_size, program.multi_kernel
    if any(known) and not varying and variants == (None, None, None):
        program, more = hoist_uniform(program, known, operands, run)
        operands = [x for x, k in zip(operands, known, strict=True) if not k] + more
        dims = [d for d, k in zip(dims, known, strict=True) if not k] + [None] * len(more)
        nowhere = (None,) * len(batch)
        ins = [a for a, k in zip(ins, known, strict=True) if not k] + [nowhere] * len(more)
    moved = tuple(add_axis(d, axes) for d, axes in zip(dims, ins, strict=True))
    last = _lies_last(operands, dims, ins)
    new, where = [], []
    for a, axes in zip(program.outputs, outs, strict=True):
        if all(x is None for x in axes) and batch:  # sum over the samples after the kernel
            axes = tuple(range(len(batch)))
        at = len(a.shape) + sum(x is not None for x in axes) if last else 0
        new.append(add_axis(at, axes))
        where.append(at)
    found = run(program, operands, (size, *batch), moved, new)
    out: list[jax.Array] = []
    for x, axes, at in zip(found, outs, where, strict=True):
        if all(k is None for k in axes) and batch:
            inner = tuple(k for k in range(x.ndim) if k in new[len(out)][1:])
            x, at = x.sum(inner), at - sum(k < at for k in inner)
        out.append(x)
        where[len(out) - 1] = at
    return out, where


def _lies_last(operands, dims, ins) -> bool:
    """Return whether the new axis is the last axis of each operand that has it."""
    found = [
        d == x.ndim - 1 and x.ndim > 1 + sum(a is not None for a in axes)
        for x, d, axes in zip(operands, dims, ins, strict=True)
        if d is not None and x.ndim > 1 + sum(a is not None for a in axes)
    ]
    return bool(found) and all(found)


batching.primitive_batchers[threads_p] = _batched
