"""`rb.threads(f)`: a function of one sample, whose `vmap` is one kernel."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
from jax.extend.core import Var

from rbjax.compiler.jax import tangents  # noqa: F401 (registers its rules)
from rbjax.compiler.jax.derivatives import close, needed
from rbjax.compiler.jax.garbage import gc_paused
from rbjax.compiler.jax.launch import has_gpu, kernels_available
from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import Program
from rbjax.compiler.jax.saved import has_saving, inside
from rbjax.compiler.jax.uniform import split_results
from rbjax.compiling import inside_jit
from rbjax.meshes import automatic

F = TypeVar("F", bound=Callable[..., Any])


def threads(f: F, *, team: bool = False) -> F:
    """Compile a function of one sample, so that its `vmap` is one kernel.

    g = threads(f); jax.vmap(g)(xs)[i] = f(xs[i])

    On a GPU, one thread runs each sample. On a CPU, the kernel is machine code with one sample in
    each lane of a vector. If neither is available, the result is f. Derivatives (`jax.jvp`, `vjp`,
    `grad`, `jacfwd`, `hessian`) also run as kernels, each compiled from the derivative of f.
    Reverse mode recomputes the forward values. If f has a primitive that the compiler does not
    support, it runs under XLA, and a warning names the primitive.

    Args:
        f: a small function of one sample. Its arguments and results are arrays or pytrees of
            arrays. It may close over arrays that all samples share (weights, a model).
        team: whether a block of GPU threads runs each sample, with its arrays in shared memory.
            Use it for recursions of matrices of about ten rows, which are too large for one
            thread's registers. It does not affect derivatives.

    Returns:
        The same function of one sample. Batch it with `jax.vmap`.

    Raises:
        TypeError: f is not a function.

    Source: DiffEqGPU.jl (Utkarsh et al. 2024), for one thread per trajectory.

    Example:
        >>> import rbjax as rb, jax, jax.numpy as jnp
        >>> act = rb.threads(lambda x: jnp.tanh(x).sum())
        >>> jax.vmap(act)(jnp.zeros((4, 3))).shape
        (4,)
    """
    if not callable(f):
        raise TypeError(f"threads: got {type(f).__name__}, expected a function of one sample")
    kernel = compile_threads(f, team=team)

    @functools.wraps(f)
    def call(*args: object, **kwargs: object) -> object:
        return (kernel if kernels_available() else f)(*args, **kwargs)

    return cast(F, call)


def flatten_call(
    f: Callable, args: tuple, kwargs: dict
) -> tuple[list[jax.Array], Callable, list[jax.tree_util.PyTreeDef]]:
    """Return the arrays of a call, f as a flat function of them, and the list `structures`.

    The flat function returns a list of arrays. Each of its traces appends the pytree structure of
    f's results to `structures`.
    """
    leaves, tree = jax.tree.flatten((args, kwargs))
    structures: list[jax.tree_util.PyTreeDef] = []

    def flat(*xs: jax.Array) -> list[jax.Array]:
        args, kwargs = jax.tree.unflatten(tree, xs)
        out, structure = jax.tree.flatten(f(*args, **kwargs))
        structures.append(structure)
        return [jnp.asarray(x) for x in out]

    return [jnp.asarray(x) for x in leaves], flat, structures


def compile_threads(f: Callable, team: bool = False) -> Callable:
    """Compile f like `threads`, but also if no device runs kernels.
    f must not close over traced values."""

    @automatic
    def bound(*args: object, **kwargs: object) -> object:
        leaves, flat, structures = flatten_call(f, args, kwargs)
        program, closed_over = trace(flat, leaves)
        if team:
            program = dataclasses.replace(program, team=True)
        return jax.tree.unflatten(structures[0], run(program, [*closed_over, *leaves]))

    compiled = jax.jit(bound)

    @functools.wraps(f)
    def call(*args: object, **kwargs: object) -> object:
        # outside of a trace, JAX caches the compiled f
        return (bound if inside_jit() else compiled)(*args, **kwargs)

    return call


def one_program(f: Callable) -> Callable:
    """Compile f so that all its calls share one program and one kernel, in all loops that call it.

    f may close over traced values that exist at each call. If no device runs kernels, all calls
    share the trace of `jax.jit`.
    """
    if not kernels_available():
        return jax.jit(f)
    programs: dict[object, tuple] = {}

    def made(leaves: list[jax.Array], tree: jax.tree_util.PyTreeDef) -> tuple:
        """Return the program, the values that it closes over, the results that are constants, with
        None for the others, and the structure of all results."""
        found: list = []

        def flat(*xs: jax.Array) -> list[jax.Array]:
            found[:] = jax.tree.flatten(f(*jax.tree.unflatten(tree, xs)))
            return [x for x in found[0] if isinstance(x, jax.core.Tracer)]

        program, closed_over = trace(flat, leaves)
        constants = [None if isinstance(x, jax.core.Tracer) else x for x in found[0]]
        return program, closed_over, constants, found[1]

    @functools.wraps(f)
    def call(*args: object) -> object:
        given, tree = jax.tree.flatten(args)
        leaves = [jnp.asarray(x) for x in given]
        key = tree, tuple((x.shape, x.dtype) for x in leaves)
        if key not in programs:
            programs[key] = made(leaves, tree)
        program, closed_over, constants, structure = programs[key]
        rest = iter(run(program, [*closed_over, *leaves]))
        return jax.tree.unflatten(structure, [next(rest) if x is None else x for x in constants])

    return call


def with_multi_kernel(f: Callable, kernels: Callable, max_batch: int) -> Callable:
    """Compile f like `threads`, and run `kernels` for batches of up to `max_batch` on a GPU.

    `kernels` computes the same function as several kernels, which use more threads. Both may close
    over traced values, and are traced together.
    """
    if not has_gpu():
        return threads(f)

    @functools.wraps(f)
    def call(*args: object) -> object:
        leaves, flat, structures = flatten_call(lambda *args: (f(*args), kernels(*args)), args, {})
        both, closed_over = trace(flat, leaves)
        program, other = split_results(both, 2)
        program = dataclasses.replace(program, multi_kernel=other, max_batch=max_batch)
        found = run(program, [*closed_over, *leaves])
        return jax.tree.unflatten(structures[0], [*found, *found])[0]

    return call


def map_threads(f: Callable, xs: Sequence[jax.Array], axes: Sequence[int]) -> list[jax.Array]:
    """Map f over the slices of xs along `axes`, with one thread for each slice of each sample.

    axes: the mapped axis of each array of xs. It is the last axis of the results. All slices share
        the values that f closes over.
    """
    size = xs[0].shape[axes[0]]
    one = [
        jax.ShapeDtypeStruct(x.shape[:k] + x.shape[k + 1 :], x.dtype)
        for x, k in zip(xs, axes, strict=True)
    ]
    program, closed_over = trace(f, one)
    ins = [*[(None,)] * len(closed_over), *((k,) for k in axes)]
    outs = [(len(a.shape),) for a in program.outputs]
    return run(program, [*closed_over, *xs], (size,), ins, outs)


def trace(f: Callable, args: Sequence) -> tuple[Program, list[jax.Array]]:
    """Trace a flat function. Return its program, and the traced values that it closes over and
    that its results depend on. The inputs of the program are these values, then the arguments."""
    avals = [jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in args]
    with gc_paused(), inside():
        closed = jax.make_jaxpr(f)(*avals)
    jaxpr = closed.jaxpr
    saves = has_saving(jaxpr)
    consts = dict(zip(jaxpr.constvars, closed.consts, strict=True))
    if not any(isinstance(c, jax.core.Tracer) for c in consts.values()):
        return Program(closed, saves=saves), []
    eqns = needed(jaxpr.eqns, jaxpr.outvars, jaxpr.invars, bool(jaxpr.effects))
    read = {v for eqn in eqns for v in eqn.invars if isinstance(v, Var)}
    read.update(v for v in jaxpr.outvars if isinstance(v, Var))
    moving = {v: c for v, c in consts.items() if isinstance(c, jax.core.Tracer) and v in read}
    known = {v: c for v, c in consts.items() if v not in moving}
    ins = [*moving, *jaxpr.invars]
    whole = close(eqns, ins, jaxpr.outvars, known, frozenset(jaxpr.effects))
    return Program(whole, saves=saves), list(moving.values())
