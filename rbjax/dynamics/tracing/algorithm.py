"""The entry of every public algorithm: checked arguments, one dtype, one compiled call.

Outside traced code an algorithm checks the values of its arguments and runs compiled. The model's
numbers are arguments of the program, so changing one never recompiles. The same holds under a
`vmap` or `grad` outside of any `jit`. Inside traced code it is inlined: a model that is closed over
is constant, and its zeros vanish from the program. A batch runs as a program of one sample: a
thread on a GPU, a lane of machine code on a CPU (`rbjax.compiler`). Without either it
runs under XLA, as JAX maps it.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.compiler import wanted
from rbjax.compiler.jax.backend import gpu
from rbjax.compiler.jax.function import trace
from rbjax.compiler.jax.primitive import run
from rbjax.compiling import inside_jit, jitted
from rbjax.dynamics.arguments import check_arrays, check_static, check_takes
from rbjax.dynamics.drivers.choice import THREADS_APART_ABOVE, on_threads
from rbjax.dynamics.tracing.algorithm import with_compiled_constants
from rbjax.dynamics.tracing.custom_rules import is_traced, split_tracers
from rbjax.meshes import on_auto_axes, on_explicit_axes
from rbjax.model import Model

#: arguments that are part of the program
STATIC = ("body", "site", "integrator", "dynamics", "constraints")
#: programs that an algorithm keeps, by the functions that it was called with (laws, integrators)
PROGRAMS_OF_FUNCTIONS = 64


def algorithm(
    *names: str,
    pairs: bool = False,
    long: bool = False,
    apart: Callable | None = None,
    where: str = "",
    functions: tuple[str, ...] = (),
) -> Callable[[Callable], Callable]:
    """Decorate f(model, *arrays, *rest) whose arrays have the named shapes.

    The name `state` is a `State`. Names of bodies and sites are static. `pairs`: most of the work
    is on pairs of links. `long`: it has twice the statements of the others for each link.
    `apart`: the same function as several kernels, for a batch of a large model on a GPU.
    `where`: the name in messages, that of f if empty. `functions`: arguments that may be functions
    of (t, state) in place of arrays; they are part of the program.
    """

    def decorate(f: Callable) -> Callable:
        signature = inspect.signature(f)
        suited = functools.partial(for_threads, pairs=pairs, long=long)
        static = [n for n in STATIC if n in signature.parameters]
        required = [n for n in names if signature.parameters[n].default is not None]
        name = where or f.__name__

        @functools.wraps(f)
        def inlined(*args: Any, **kwargs: Any) -> Any:
            if on_explicit_axes(args, kwargs):
                return on_auto_axes(lambda args, kwargs: inlined(*args, **kwargs), args, kwargs)
            kernels = wanted()
            moving, closed = split_tracers((suited(args) if kernels else args, kwargs))
            if not moving or not kernels:
                return f(*args, **kwargs)
            shape: list[Any] = []

            def flat(*moving: Any) -> list[jax.Array]:
                args, kwargs = closed(list(moving))
                leaves, tree = jax.tree.flatten(f(*args, **kwargs))
                shape.append(tree)
                return [jnp.asarray(x) for x in leaves]

            program, closed_over = trace(flat, moving)
            if apart is not None and args[0].nv > THREADS_APART_ABOVE:
                as_given = split_tracers((args, kwargs))[1]

                def flat_apart(*moving: Any) -> list[jax.Array]:
                    args, kwargs = as_given(list(moving))
                    return jax.tree.leaves(apart(*args, **kwargs))

                program = dataclasses.replace(program, apart=flat_apart)
            return jax.tree.unflatten(shape[0], run(program, [*closed_over, *moving]))

        program = jitted(inlined, static_argnames=static)

        @functools.lru_cache(PROGRAMS_OF_FUNCTIONS)
        def program_with(**own: Callable) -> Callable:
            """The program of functions of a user. As static arguments `jax.jit` would keep them."""

            def run(*args: Any, **kwargs: Any) -> Any:
                return inlined(*args, **kwargs, **own)

            left = [p for n, p in signature.parameters.items() if n not in own]
            run.__signature__ = signature.replace(parameters=left)  # type: ignore[attr-defined]
            return jitted(run, static_argnames=[n for n in static if n not in own])

        @functools.wraps(f)
        def call(model: Model, *args: Any, **kwargs: Any) -> Any:
            bound = signature.bind(model, *args, **kwargs)
            asked = [n for n in functions if callable(bound.arguments.get(n))]
            given = {n: x for n, x in bound.arguments.items() if n in names and n not in asked}
            bound.arguments.update(check_arrays(name, model, given, (), required))
            for n in static:
                check_static(name, n, bound.arguments.get(n))
            for n in asked:
                check_takes(name, n, bound.arguments[n], "t", "state")
            if is_traced((bound.args, bound.kwargs)) and inside_jit():
                return inlined(*bound.args, **bound.kwargs)
            static_functions = {
                n: x for n in (*static, *asked) if callable(x := bound.arguments.get(n))
            }
            if not static_functions:
                return program()(*bound.args, **bound.kwargs)
            for n in static_functions:
                del bound.arguments[n]
            return program_with(**static_functions)()(*bound.args, **bound.kwargs)

        return call

    return decorate


def for_threads(args: tuple, *, pairs: bool = False, long: bool = False) -> tuple:
    """The arguments, whose first one, the model, has the driver that suits threads. Of many pairs
    on a CPU the link constants are a program of their own, if the model is an argument: half of
    all statements, which would else be compiled once for each part that reads them."""
    model, *rest = args
    arrays = [x for x in jax.tree.leaves(rest) if isinstance(x, jax.Array)]
    floats = [x.dtype for x in arrays if jnp.issubdtype(x.dtype, jnp.floating)]
    if not floats:
        return args
    model = on_threads(model, floats[0], pairs=pairs, long=long)
    if pairs and model.driver == "rolled" and not gpu():
        made = with_compiled_constants(model, floats[0])
        model = model.replace(constants=made.execution.constants)
    return (model, *rest)
