"""`rb.compile(f, *example)`: a function of one sample as machine code, called with numpy arrays."""

from __future__ import annotations

import ctypes
import functools
import inspect
import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import PyTreeDef

from rbjax.compiler.ir.program import batch_first
from rbjax.compiler.ir.statements import Unsupported
from rbjax.compiler.jax.function import flatten_call
from rbjax.compiler.llvm import jit as llvm_jit
from rbjax.compiler.llvm import numpy_call
from rbjax.compiler.lower.write import write_program
from rbjax.errors import InputError


def compile(f: Callable, *example: object) -> Callable:
    """Compile f to machine code that runs without JAX's dispatch, for control loops.

    g = compile(f, x); g(x) = f(x)

    A call reads its arguments in place and returns new numpy arrays. Arguments of other types
    (lists, f64 for f32, strided arrays) are converted, which takes longer. The GIL is released, and
    several threads may call at once. f may contain loops, branches and derivatives (`jax.grad`,
    `jacfwd`). It is traced once, so the values that it closes over (a model, gains) are constants.
    Without llvmlite, or if f has a primitive that the compiler does not support, f runs under
    `jax.jit`, and a warning at compile time gives the reason.

    Args:
        f: a small function of one sample. Its arguments and results are arrays or pytrees of
            arrays.
        example: arguments of f, which fix the shapes and dtypes of later arguments. If
            `jax_enable_x64` is off, floats are f32.

    Returns:
        A function with the arguments of f. Its attribute `native` is False if it runs under
        `jax.jit`.

    Raises:
        TypeError: f is not a function.
        InputError: an argument of the example is not an array or a number. A call raises it if an
            argument has another shape or structure than the example, or a dtype that does not
            convert.

    Source: LLVM (Lattner and Adve 2004) compiles the program, which `rb.threads` also uses.

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
        leaves, flat, structures = flatten_call(f, example, {})
    except (TypeError, ValueError) as error:
        raise InputError(
            f"compile: every example argument must be an array or a number ({error}); capture "
            "other values in a closure, as in lambda q: f(q, name)"
        ) from error
    closed = jax.make_jaxpr(flat)(*leaves)
    for x in (*leaves, *closed.out_avals):
        if not isinstance(x.dtype, np.dtype):
            raise InputError(
                f"compile: numpy has no dtype {x.dtype}; pass jax.random.key_data(key), and use "
                "jax.random.wrap_key_data inside f"
            )
    ins, outs = ([batch_first(a.shape, ()) for a in avals] for avals in (leaves, closed.out_avals))
    operands, results = ([(a.shape, np.dtype(a.dtype)) for a in x]
                         for x in (leaves, closed.out_avals))  # fmt: skip
    try:
        if not numpy_call.layout_is_known():
            raise llvm_jit.NoCompiler("numpy's arrays have an unknown layout")
        program = write_program(closed, (), ins, outs, platform="cpu")
        code = llvm_jit.compile_module(numpy_call.write_module(program))
    except (Unsupported, llvm_jit.NoCompiler) as error:
        warnings.warn(f"compile: {error}; {_name(f)} runs under XLA", stacklevel=2)
        code = None
    call = _Call(f, jax.tree.structure(example), structures[-1], operands, results, code)
    return functools.wraps(f)(call.function())


ArrayType = tuple[tuple[int, ...], np.dtype]  # shape and dtype of an array


class _Call:
    """A call of a compiled function, with checks and conversions of its arguments."""

    def __init__(
        self, f: Callable, tree: PyTreeDef, structure: PyTreeDef, operands: list[ArrayType],
        results: list[ArrayType], code: llvm_jit.Code | None,
    ):  # fmt: skip
        self._f, self._tree, self._structure, self._code = f, tree, structure, code
        self._operands, self._results = operands, results
        known = [id(np.ndarray), *(id(dtype) for _, dtype in operands)]
        self._types = (ctypes.c_void_p * len(known))(*known)
        self._known = ctypes.addressof(self._types)
        if code is None:
            self._run = self._run_jitted(jax.jit(f))
        else:
            kind = ctypes.CFUNCTYPE(
                ctypes.c_int, ctypes.c_void_p, ctypes.py_object, ctypes.py_object
            )
            self._run = kind(code.address)

    def function(self) -> Callable:
        """Return the call as a plain function, which Python calls faster than an object."""
        run, known, converted, empty = self._run, self._known, self._run_converted, np.empty
        in_order = self._order_arguments
        kinds, structure, unflatten = self._results, self._structure, jax.tree.unflatten
        n = self._tree.num_leaves

        def call(*args: object, **names: object) -> object:
            args = in_order(args, names) if names else args
            leaves = args if plain else self._flatten(args)
            results = tuple([empty(s, d) for s, d in kinds])
            if run(known, leaves, results):
                converted(leaves, results)
            return unflatten(structure, results)

        def call_of_arrays(*args: object, **names: object) -> object:
            args = in_order(args, names) if names else args
            result = empty(*kinds[0])
            if run(known, args, (result,)):
                converted(args, (result,))
            return result

        plain = self._tree == jax.tree.structure((0,) * n)  # every argument is one array
        one = call_of_arrays if plain and structure == jax.tree.structure(0) else call
        one.native = self._code is not None  # type: ignore[attr-defined]
        return one

    def _run_converted(self, leaves: tuple, results: tuple) -> None:
        """Convert the arguments to contiguous arrays of the expected dtypes, and run the code."""
        if len(leaves) != len(self._operands):
            raise InputError(
                f"{_name(self._f)}: got {len(leaves)} arguments, expected {len(self._operands)}, "
                "as in the example given to compile"
            )
        fitting = tuple(self._convert(x, k) for k, x in enumerate(leaves))
        if self._run(self._known, fitting, results):
            raise MemoryError(f"{_name(self._f)}: no memory for its local arrays")

    def _order_arguments(self, args: tuple, names: dict[str, object]) -> tuple:
        """Put positional and named arguments in the order of the example."""
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

    def _flatten(self, args: tuple) -> tuple:
        leaves, tree = jax.tree.flatten(args)
        if tree != self._tree:
            raise InputError(
                f"{_name(self._f)}: got arguments of structure {tree}, expected {self._tree}, as "
                "in the example given to compile"
            )
        return tuple(leaves)

    def _convert(self, x: object, k: int) -> np.ndarray:
        """Convert an argument to a contiguous array of the expected shape and dtype, or raise."""
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
        """Return the name of the k-th leaf of the arguments, for messages."""
        paths, _ = jax.tree_util.tree_flatten_with_path(
            jax.tree.unflatten(self._tree, [0] * self._tree.num_leaves)
        )
        first, *rest = paths[k][0]
        try:
            name = list(inspect.signature(self._f).parameters)[first.idx]
        except (IndexError, TypeError, ValueError):  # f has *args or is written in C
            name = f"argument {first.idx}"
        return name + jax.tree_util.keystr(tuple(rest))

    def _run_jitted(self, jitted: Callable) -> Callable:
        """Return a function that calls `jax.jit`'s code with the signature of the machine code."""

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
