"""`rb.threads(f)`: a function of one sample, whose `vmap` on a GPU is one kernel."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr

from rbjax._jax_compat import without_names
from rbjax.compiler.jax.backend import gpu, wanted
from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import Program
from rbjax.compiler.jax.tangents import tangent_p  # noqa: F401 (its rules)
from rbjax.compiler.jax.uncollected import collection_paused
from rbjax.compiler.jax.uniform import halves
from rbjax.compiling import inside_jit
from rbjax.meshes import automatic


def threads(f: Callable, *, team: bool = False) -> Callable:
    """f of one sample, whose `vmap` on a GPU is one kernel, one thread a sample; on a CPU it is
    machine code, one sample a lane.

    g = threads(f); jax.vmap(g)(xs)[i] = f(xs[i])

    Where neither runs this is f itself. Its derivatives (`jax.jvp`, `vjp`, `grad`, `jacfwd`,
    `hessian`) also run as kernels, each compiled from the derivative of f. Reverse mode recomputes
    the forward values. If f has a primitive that the compiler does not support, it runs under XLA,
    and a warning names the primitive.

    Args:
        f: a function from arrays, or pytrees of them, to the same, for one sample and small. It may
            close over arrays that all samples share (weights, a model).
        team: on a GPU a block of threads runs a sample, with its arrays in shared memory: for
            recursions of matrices of some ten rows, which are too many numbers for one thread.
            Elsewhere, and for derivatives, it changes nothing.

    Returns:
        The same function of one sample. Batch it with `jax.vmap`.

    Raises:
        TypeError: f is not a function.

    Source: the idea of one thread a trajectory is that of DiffEqGPU.jl (Utkarsh et al. 2024).

    Example:
        >>> import rbjax as rb, jax, jax.numpy as jnp
        >>> act = rb.threads(lambda x: jnp.tanh(x).sum())
        >>> jax.vmap(act)(jnp.zeros((4, 3))).shape
        (4,)
    """
    if not callable(f):
        raise TypeError(f"threads: got {type(f).__name__}, expected a function of one sample")

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        return whole(*args, **kwargs) if wanted() else f(*args, **kwargs)

    whole = threaded(f, team=team)
    return call


def flattened(f: Callable, args: tuple, kwargs: dict) -> tuple[list, Callable, list]:
    """The arrays of a call, f as a function from them to a list of arrays, and a list that gets
    the structure of the results when it is traced."""
    leaves, tree = jax.tree.flatten((args, kwargs))
    shape: list[Any] = []

    def flat(*xs: Any) -> list[Any]:
        args, kwargs = jax.tree.unflatten(tree, xs)
        out, treedef = jax.tree.flatten(f(*args, **kwargs))
        shape.append(treedef)
        return [jnp.asarray(x) for x in out]

    return [jnp.asarray(x) for x in leaves], flat, shape


def threaded(f: Callable, apart: Callable | None = None, team: bool = False) -> Callable:
    """`threads`, with or without a GPU. `apart`: the same function as several kernels. Neither may
    close over traced values."""

    @automatic
    def bound(*args: Any, **kwargs: Any) -> Any:
        leaves, flat, shape = flattened(f, args, kwargs)
        program, closed_over = trace(flat, leaves)
        if apart is not None:
            program = dataclasses.replace(program, apart=flattened(apart, args, kwargs)[1])
        if team:
            program = dataclasses.replace(program, team=True)
        return jax.tree.unflatten(shape[0], run(program, [*closed_over, *leaves]))

    compiled = jax.jit(bound)

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        # outside of a trace JAX caches the compiled f
        return (bound if inside_jit() else compiled)(*args, **kwargs)

    return call


def in_parts(f: Callable, parts: Callable, samples: int) -> Callable:
    """`threads(f)`; on a GPU a batch of up to so many samples runs `parts`, the same function as
    several kernels, which have more threads. Both may close over traced values, and are traced
    together."""
    if not gpu():
        return threads(f)

    @functools.wraps(f)
    def call(*args: Any) -> Any:
        leaves, flat, shape = flattened(lambda *args: (f(*args), parts(*args)), args, {})
        both, closed_over = trace(flat, leaves)
        program, other = halves(both)
        program = dataclasses.replace(program, apart=other, up_to=samples)
        found = run(program, [*closed_over, *leaves])
        return jax.tree.unflatten(shape[0], [*found, *found])[0]

    return call


def side_by_side(f: Callable, xs: Sequence[jax.Array], axes: Sequence[int]) -> Any:
    """f of each slice of xs along `axes`, one thread for each slice of each sample. Results, one
    array or several, have that axis last. All slices share the values that f closes over."""
    size = xs[0].shape[axes[0]]
    one = [
        jax.ShapeDtypeStruct(x.shape[:k] + x.shape[k + 1 :], x.dtype)
        for x, k in zip(xs, axes, strict=True)
    ]
    program, closed_over = trace(f, one)
    ins = [*[(None,)] * len(closed_over), *((k,) for k in axes)]
    outs = [(len(a.shape),) for a in program.outputs]
    return run(program, [*closed_over, *xs], (size,), ins, outs)


def trace(f: Callable, args: list[Any]) -> tuple[Program, list[Any]]:
    """The program of a flat function, whose inputs are the traced values that it closes over and
    its arguments; and these values."""
    avals = [jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in args]
    with collection_paused():
        closed = jax.make_jaxpr(f)(*avals)
    jaxpr, consts = closed.jaxpr, closed.consts
    traced = [isinstance(c, jax.core.Tracer) for c in consts]
    if not any(traced):
        return Program(closed), []
    pairs = list(zip(jaxpr.constvars, consts, traced, strict=True))
    known = [(v, c) for v, c, t in pairs if not t]
    moving = [(v, c) for v, c, t in pairs if t]
    whole = Jaxpr(
        [v for v, _ in known], [v for v, _ in moving] + list(jaxpr.invars), jaxpr.outvars,
        jaxpr.eqns, jaxpr.effects, without_names(jaxpr),
    )  # fmt: skip
    return Program(ClosedJaxpr(whole, [c for _, c in known])), [c for _, c in moving]
