"""`rb.compile(f, *example)`: a function of one sample as machine code, called with numpy arrays."""

from __future__ import annotations

import ctypes
import functools
import inspect
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiler.ir.program import batch_first
from rbjax.compiler.ir.values import Unsupported
from rbjax.compiler.jax.function import flattened
from rbjax.compiler.llvm import jit as llvm_jit
from rbjax.compiler.llvm import module as llvm_ir
from rbjax.compiler.llvm import numpy_abi
from rbjax.compiler.lower.write import write_program
from rbjax.errors import InputError


def compile(f: Callable, *example: Any) -> Callable:
    """f as machine code of this processor, called without JAX's dispatch: for control loops.

    g = compile(f, x); g(x) = f(x)

    A call reads its arguments in place and returns new numpy arrays. Arguments of other types
    (lists, f64 for f32, strided arrays) are converted, which takes longer. The GIL is released, and
    several threads may call at once. f may contain loops, branches and derivatives (`jax.grad`,
    `jacfwd`); it is traced once, so what it closes over (a model, gains) is constant. Without
    llvmlite, or if f has a primitive that the compiler does not support, f runs under `jax.jit`; a
    warning at compile time says why.

    Args:
        f: a function from arrays, or pytrees of them, to the same, for one sample and small.
        example: arguments of f. Shapes and types of later arguments are these; with
            `jax_enable_x64` off, floats are f32.

    Returns:
        A function with the arguments of f. Its `native` says whether it is machine code; else it is
        `jax.jit`'s.

    Raises:
        TypeError: f is not a function.
        InputError: an argument is not an array or a number; when called, an argument has another
            shape, a type that does not convert, or another structure than the example.

    Source: the program is that of `rb.threads`; LLVM compiles it (Lattner and Adve 2004).

    Example:
        >>> import rbjax as rb, numpy as np
        >>> model = rb.load("arm7")
        >>> fall = lambda q, v: rb.forward_dynamics(model, q, v, np.zeros(model.nv))
        >>> fall = rb.compile(fall, np.zeros(7), np.zeros(7))
        >>> fall(np.ones(7), np.zeros(7)).shape
        (7,)
    """
    if not callable(f):
        raise TypeError(f"compile: got {type(f).__name__}, expected a function of one sample")
    try:
        leaves, flat, shape = flattened(f, example, {})
    except (TypeError, ValueError) as error:
        raise InputError(
            f"compile: got an example that is not of arrays and numbers ({error}); close over "
            "what is neither, as in lambda q: f(q, name)"
        ) from error
    closed = jax.make_jaxpr(flat)(*leaves)
    for x in (*leaves, *closed.out_avals):
        if not isinstance(x.dtype, np.dtype):
            raise InputError(
                f"compile: got an array of {x.dtype}, which numpy lacks; of a random key take "
                "jax.random.key_data(key), and jax.random.wrap_key_data inside"
            )
    ins, outs = ([batch_first(a.shape, ()) for a in avals] for avals in (leaves, closed.out_avals))
    operands, results = ([(a.shape, np.dtype(a.dtype)) for a in x]
                         for x in (leaves, closed.out_avals))  # fmt: skip
    try:
        if not numpy_abi.holds():
            raise llvm_jit.NoCompiler("numpy's arrays have an unknown layout")
        program = write_program(closed, (), ins, outs, platform="cpu")
        code = llvm_jit.compiled(llvm_ir.module(program))
    except (Unsupported, llvm_jit.NoCompiler) as error:
        warnings.warn(f"compile: {error}; {_name(f)} runs under XLA", stacklevel=2)
        code = None
    call = _Call(f, jax.tree.structure(example), shape[-1], operands, results, code)
    return functools.wraps(f)(call.function())


Kind = tuple[tuple[int, ...], np.dtype]  # the shape and the dtype of an array


class _Call:
    """A call of a compiled function: what goes to the machine code, and what comes back."""

    def __init__(
        self, f: Callable, tree: Any, shape: Any, operands: list[Kind], results: list[Kind],
        code: llvm_jit.Code | None,
    ):  # fmt: skip
        self._f, self._tree, self._shape, self._code = f, tree, shape, code
        self._operands, self._results = operands, results
        known = [id(np.ndarray), *(id(dtype) for _, dtype in operands)]
        self._types = (ctypes.c_void_p * len(known))(*known)
        self._known = ctypes.addressof(self._types)
        if code is None:
            self._run = self._by(jax.jit(f))
        else:
            kind = ctypes.CFUNCTYPE(
                ctypes.c_int, ctypes.c_void_p, ctypes.py_object, ctypes.py_object
            )
            self._run = kind(code.address)

    def function(self) -> Callable:
        """The call as a plain function, which Python calls faster than an object. What it needs
        most often it holds itself."""
        run, known, converted, empty = self._run, self._known, self._converted, np.empty
        in_order = self._in_order
        kinds, shape, results_of = self._results, self._shape, jax.tree.unflatten
        n = self._tree.num_leaves

        def call(*args: Any, **names: Any) -> Any:
            args = in_order(args, names) if names else args
            leaves = args if plain else self._flattened(args)
            results = tuple([empty(s, d) for s, d in kinds])
            if run(known, leaves, results):
                converted(leaves, results)
            return results_of(shape, results)

        def call_of_arrays(*args: Any, **names: Any) -> Any:
            args = in_order(args, names) if names else args
            result = empty(*kinds[0])
            if run(known, args, (result,)):
                converted(args, (result,))
            return result

        # an array is its own tree: no need to look into it
        plain = self._tree == jax.tree.structure((0,) * n)
        one: Any = call_of_arrays if plain and shape == jax.tree.structure(0) else call
        one.native = self._code is not None
        return one

    def _converted(self, leaves: tuple, results: tuple) -> None:
        """The call with arguments that are not yet plain arrays of the right type, or are wrong."""
        if len(leaves) != len(self._operands):
            raise InputError(
                f"{_name(self._f)}: got {len(leaves)} arguments, expected {len(self._operands)}, "
                "as in the example given to compile"
            )
        fitting = tuple(self._fitting(x, k) for k, x in enumerate(leaves))
        if self._run(self._known, fitting, results):
            raise MemoryError(f"{_name(self._f)}: no memory for its local arrays")

    def _in_order(self, args: tuple, names: dict[str, Any]) -> tuple:
        """Positional and named arguments in the order of the example."""
        try:
            bound = inspect.signature(self._f).bind(*args, **names)
        except (TypeError, ValueError) as error:  # the message of a call of f
            raise InputError(f"{_name(self._f)}: {error}") from error
        if bound.kwargs:
            raise InputError(
                f"{_name(self._f)}: got {', '.join(bound.kwargs)} by name only; the example given "
                "to compile has no such argument, so close over it: "
                "compile(lambda q: f(q, name=value), q)"
            )
        return bound.args

    def _flattened(self, args: tuple) -> tuple:
        leaves, tree = jax.tree.flatten(args)
        if tree != self._tree:
            raise InputError(
                f"{_name(self._f)}: got arguments of structure {tree}, expected {self._tree}, as "
                "in the example given to compile"
            )
        return tuple(leaves)

    def _fitting(self, x: Any, k: int) -> np.ndarray:
        """An argument as an array of the right shape and type, its entries one after another."""
        shape, dtype = self._operands[k]
        if isinstance(x, jax.core.Tracer):
            raise InputError(
                f"{_name(self._f)}: {self._argument(k)} is traced (by jit, vmap, grad); a compiled "
                "function takes numpy arrays: use the function that you compiled instead"
            )
        try:
            found = np.asarray(x)
        except (TypeError, ValueError):
            found = np.asarray(None)
        if found.dtype.kind not in "biuf" or not np.can_cast(found.dtype, dtype, "same_kind"):
            got = getattr(x, "dtype", type(x).__name__)
            raise InputError(
                f"{_name(self._f)}: {self._argument(k)} is of type {got}, expected {dtype}, "
                f"as in the example; convert it with np.asarray(x, np.{dtype})"
            )
        if found.shape != shape:
            raise InputError(
                f"{_name(self._f)}: {self._argument(k)} has shape {found.shape}, expected "
                f"{shape}, as in the example; for a batch call it for each sample, or "
                "compile jax.vmap(f)"
            )
        fitting = np.empty(shape, dtype)
        fitting[...] = found
        return fitting

    def _argument(self, k: int) -> str:
        """The name of a leaf of the arguments."""
        paths, _ = jax.tree_util.tree_flatten_with_path(
            jax.tree.unflatten(self._tree, [0] * self._tree.num_leaves)
        )
        first, *rest = paths[k][0]
        try:
            name = list(inspect.signature(self._f).parameters)[first.idx]
        except (IndexError, TypeError, ValueError):  # f(*args), or a function of C
            name = f"argument {first.idx}"
        return name + jax.tree_util.keystr(tuple(rest))

    def _by(self, jitted: Callable) -> Callable:
        """The same call by `jax.jit`."""

        def run(known: int, leaves: tuple, results: tuple) -> int:
            kinds = [(x.shape, x.dtype) if type(x) is np.ndarray else None for x in leaves]
            if kinds != self._operands:
                return 1
            args = jax.tree.unflatten(self._tree, [jnp.array(x) for x in leaves])
            for place, y in zip(results, jax.tree.leaves(jitted(*args)), strict=True):
                place[...] = y
            return 0

        return run


def _name(f: Callable) -> str:
    return getattr(f, "__name__", type(f).__name__)
