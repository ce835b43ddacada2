"""The entry of every public algorithm: checked arguments, one dtype, one compiled call.

Outside traced code an algorithm checks the values of its arguments and runs compiled. The model's
numbers are arguments of the program, so changing one never recompiles. The same holds under a
`vmap` or `grad` outside of any `jit`. Inside traced code it is inlined: a model that is closed over
is constant, and its zeros vanish from the program. A batch runs as a program of one sample: a
thread on a GPU, a lane of machine code on a CPU (`rbjax.compiler`). Under XLA on a CPU `batching`
runs it.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.compiler import threaded, wanted
from rbjax.compiler.jax.backend import gpu
from rbjax.compiling import compiled, inside_jit
from rbjax.dynamics.arguments import check_arrays, check_static
from rbjax.dynamics.drivers.choice import THREADS_APART_ABOVE, on_threads
from rbjax.dynamics.tracing.ahead import made_by_threads
from rbjax.dynamics.tracing.batching import in_chunks
from rbjax.dynamics.tracing.custom_rules import split_tracers
from rbjax.meshes import automatic
from rbjax.model import Model, known_zeros

#: arguments that are part of the program
STATIC = ("body", "site", "integrator", "law", "constraints")
#: programs that an algorithm keeps, by the functions that it was called with (laws, integrators)
PROGRAMS_OF_FUNCTIONS = 64


def algorithm(
    *names: str, pairs: bool = False, long: bool = False, apart: Callable | None = None
) -> Callable[[Callable], Callable]:
    """Decorate f(model, *arrays, *rest) whose arrays have the named shapes.

    The name `state` is a `State`. Names of bodies and sites are static. `pairs`: most of the work
    is on pairs of links. `long`: it has twice the statements of the others for each link.
    `apart`: the same function as several kernels, for a batch of a large model on a GPU.
    """

    def decorate(f: Callable) -> Callable:
        signature = inspect.signature(f)
        suited = functools.partial(for_threads, pairs=pairs, long=long)
        static = [n for n in STATIC if n in signature.parameters]
        required = [n for n in names if signature.parameters[n].default is not None]

        @automatic
        @functools.wraps(f)
        def inlined(*args: Any, **kwargs: Any) -> Any:
            by_threads = wanted()
            moving, closed = split_tracers((suited(args) if by_threads else args, kwargs))

            def run(moving: list) -> Any:
                args, kwargs = closed(moving)
                return f(*args, **kwargs)

            if not moving:
                return run(moving)
            if not by_threads:
                return in_chunks(run)(moving)
            if apart is None or args[0].nv <= THREADS_APART_ABOVE:
                return threaded(run)(moving)
            as_given = split_tracers((args, kwargs))[1]

            def run_apart(moving: list) -> Any:
                args, kwargs = as_given(moving)
                return apart(*args, **kwargs)

            return threaded(run, run_apart)(moving)

        program = compiled(inlined, static_argnames=static)

        @functools.lru_cache(PROGRAMS_OF_FUNCTIONS)
        def program_with(**functions: Callable) -> Callable:
            """The program of functions of a user. As static arguments `jax.jit` would keep them."""

            def own(*args: Any, **kwargs: Any) -> Any:
                return inlined(*args, **kwargs, **functions)

            left = [p for n, p in signature.parameters.items() if n not in functions]
            own.__signature__ = signature.replace(parameters=left)  # type: ignore[attr-defined]
            return compiled(own, static_argnames=[n for n in static if n not in functions])

        @functools.wraps(f)
        def call(model: Model, *args: Any, **kwargs: Any) -> Any:
            bound = signature.bind(model, *args, **kwargs)
            given = {n: bound.arguments[n] for n in names if n in bound.arguments}
            bound.arguments.update(check_arrays(f.__name__, model, given, (), required))
            for n in static:
                check_static(f.__name__, n, bound.arguments.get(n))
            if split_tracers((bound.args, bound.kwargs))[0] and inside_jit():
                return inlined(*bound.args, **bound.kwargs)
            functions = {n: x for n in static if callable(x := bound.arguments.get(n))}
            if not functions:
                return program(*bound.args, **bound.kwargs)
            for n in functions:
                del bound.arguments[n]
            return program_with(**functions)(*bound.args, **bound.kwargs)

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
        made = made_by_threads(known_zeros(model), floats[0])
        model = model.replace(prepared=made.execution.prepared)
    return (model, *rest)
