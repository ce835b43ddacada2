"""The decorator of every public algorithm: checked arguments, one dtype, one compiled call.

Outside of `jit`, also under `vmap` or `grad`, an algorithm checks the values of its arguments and
runs compiled. The leaves of the model are arguments of the program, so a change of a leaf never
recompiles. Inside `jit` the algorithm is inlined: a model that is closed over is constant, and its
zeros vanish from the program. A batch runs as a program of one sample: a thread on a GPU, a SIMD
lane of machine code on a CPU (`rbjax.compiler`), otherwise by XLA.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiler import kernels_available
from rbjax.compiler.jax.function import trace
from rbjax.compiler.jax.launch import has_gpu
from rbjax.compiler.jax.primitive import run
from rbjax.compiling import inside_jit, jitted
from rbjax.dynamics.arguments import check_arrays, check_static, check_takes
from rbjax.dynamics.drivers.choice import KERNELS_ABOVE, on_threads
from rbjax.dynamics.tracing.custom_rules import is_traced, split_tracers
from rbjax.dynamics.tracing.one_sample import run_sample
from rbjax.errors import InputError
from rbjax.meshes import on_auto_axes, on_explicit_axes
from rbjax.model import Frame, Model, with_constants

P = ParamSpec("P")
R = TypeVar("R")

#: the arguments that are static: they determine the program
STATIC = ("body", "site", "integrator", "dynamics", "constraints", "contact")
#: the number of programs that an algorithm caches for functions of a user (dynamics, integrators)
PROGRAMS_OF_FUNCTIONS = 64


def algorithm(
    *names: str,
    pairs: bool = False,
    long: bool = False,
    multi_kernel: Callable | None = None,
    where: str = "",
    functions: tuple[str, ...] = (),
    saves: Callable[..., bool] | None = None,
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that makes f(model, *arrays, *rest) a public algorithm.

    Args:
        names: the names of the arrays (`dynamics.arguments.SHAPES`), or "state".
        pairs: True if most of the arithmetic is on pairs of links.
        long: True if f has twice as many statements for each link as other algorithms.
        multi_kernel: f as several kernels, for a batch of a large model on a GPU.
        where: the name of the algorithm in messages, by default the name of f.
        functions: names of arguments that may be functions of (t, state) instead of arrays; such a
            function is static.
        saves: function of the arguments: whether a reverse derivative saves the named values of the
            forward pass (`rbjax.compiler.jax.saved`).
    """

    def decorate(f: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(f)
        on_lanes = functools.partial(with_driver_of_threads, pairs=pairs, long=long)
        static = [n for n in STATIC if n in signature.parameters]
        required = [n for n in names if signature.parameters[n].default is not None]
        name = where or f.__name__

        @functools.wraps(f)
        def inlined(*args: Any, **kwargs: Any) -> Any:
            if on_explicit_axes(args, kwargs):
                return on_auto_axes(lambda args, kwargs: inlined(*args, **kwargs), args, kwargs)
            own = (on_lanes(args) if kernels_available() else args), kwargs
            kernels = None
            if multi_kernel is not None and args[0].nv > KERNELS_ABOVE:
                kernels = None if args[0].topology.frames else in_kernels(args, kwargs)
            keeps = saves is not None and saves(*args, **kwargs)
            return run_sample(of_pair, own, saves=keeps, multi_kernel=kernels)

        def of_pair(own: tuple, shared: Any) -> Any:
            return f(*own[0], **own[1])

        def in_kernels(args: tuple, kwargs: dict[str, Any]) -> Callable:
            closed = split_tracers((args, kwargs))[1]

            def leaves(*moving: Any) -> list[jax.Array]:
                args, kwargs = closed(list(moving))
                return jax.tree.leaves(multi_kernel(*args, **kwargs))  # type: ignore[misc]

            return leaves

        program = jitted(inlined, static_argnames=static)

        @functools.lru_cache(PROGRAMS_OF_FUNCTIONS)
        def program_with(**own: Callable) -> Callable:
            """Compile f with the user's functions as constants, in a cache of limited size."""

            def run(*args: Any, **kwargs: Any) -> Any:
                return inlined(*args, **kwargs, **own)

            left = [p for n, p in signature.parameters.items() if n not in own]
            run.__signature__ = signature.replace(parameters=left)  # type: ignore[attr-defined]
            return jitted(run, static_argnames=[n for n in static if n not in own])

        @functools.wraps(f)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            bound = signature.bind(*args, **kwargs)
            model = bound.args[0]
            if isinstance(frame := bound.arguments.get("body"), Frame):
                if others := [n for n in ("point", "site") if bound.arguments.get(n) is not None]:
                    raise InputError(f"{name}: got a Frame and {others[0]}, expected one")
                bound.arguments.update(frame.arguments())
            asked = [n for n in functions if callable(bound.arguments.get(n))]
            given = {n: x for n, x in bound.arguments.items() if n in names and n not in asked}
            bound.arguments.update(check_arrays(name, model, given, (), required))
            for n in static:
                check_static(name, n, bound.arguments.get(n))
            for n in asked:
                check_takes(name, n, bound.arguments[n], "t", "state")
            if is_traced((bound.args, bound.kwargs)) and inside_jit():
                return inlined(*bound.args, **bound.kwargs)
            arguments = {n: bound.arguments.get(n) for n in (*static, *asked)}
            with_arrays = any(map(_has_arrays, arguments.values()))  # as laws with arrays: no hash
            static_functions = {n: x for n, x in arguments.items() if callable(x) or _has_arrays(x)}
            if not static_functions:
                return program()(*bound.args, **bound.kwargs)
            for n in static_functions:
                del bound.arguments[n]
            of = program_with.__wrapped__ if with_arrays else program_with
            return of(**static_functions)()(*bound.args, **bound.kwargs)

        return call

    return decorate


def with_driver_of_threads(args: tuple, *, pairs: bool = False, long: bool = False) -> tuple:
    """Choose the driver of the model, the first argument, for GPU threads or SIMD lanes.

    For algorithms on pairs on a CPU, the link constants become a separate program. Otherwise their
    statements would be compiled once for each part that reads them.
    """
    model, *rest = args
    arrays = [x for x in jax.tree.leaves(rest) if isinstance(x, jax.Array)]
    floats = [x.dtype for x in arrays if jnp.issubdtype(x.dtype, jnp.floating)]
    if not floats:
        return args
    model = on_threads(model, floats[0], pairs=pairs, long=long)
    if pairs and model.driver == "rolled" and not has_gpu():
        made = with_compiled_constants(model, floats[0])
        model = model.replace(constants=made.execution.constants)
    return (model, *rest)


def with_compiled_constants(model: Model, dtype: Any) -> Model:
    """Compute `with_constants` as a separate program, which compiles faster than with XLA."""
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


def _has_arrays(x: Any) -> bool:
    return any(isinstance(leaf, jax.Array | np.ndarray) for leaf in jax.tree.leaves(x))
