"""Lowering rules for elementwise primitives."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.operations import OF_PRIMITIVE
from rbjax.compiler.ir.statements import BOOL, Unsupported, Value, Var
from rbjax.compiler.lower import arrays
from rbjax.compiler.lower.arrays import ThreadArray, View
from rbjax.compiler.lower.delayed import Delayed
from rbjax.compiler.lower.lowering import Equation, Lowering, accepts_delayed, dtype_of, rule
from rbjax.lanes import polynomial_sincos

#: arrays of more entries are computed by loops over memory
LOOP_ABOVE = 1024
#: the same threshold for arrays that are in memory already
LOOP_ABOVE_IN_MEMORY = 64


def map_entrywise(
    low: Lowering, dtype: DTypeLike, shape: tuple, f: Callable[..., Value], *xs: ThreadArray
) -> ThreadArray:
    """Apply f to the entries of arrays, which are broadcast to `shape`. f returns one value."""
    if not shape:
        out = np.empty((), object)
        out[()] = f(*(x[()] if isinstance(x, np.ndarray) else low.to_scalar(x) for x in xs))
        return out
    size = math.prod(shape)
    if low.b.in_team and _is_wide(xs, size):
        delayed = _delayed(low.b, dtype, shape, f, xs)
        if size > arrays.FEW or delayed.work > arrays.SHARED_ABOVE:
            return delayed
        xs = tuple(low.to_scalars(x) for x in xs)
    in_memory_now = size > LOOP_ABOVE_IN_MEMORY and any(isinstance(x, View) for x in xs)
    loop_above = 0 if in_memory_now else LOOP_ABOVE
    return map_entries(low, [dtype], shape, lambda *x: (f(*x),), *xs, loop_above=loop_above)[0]


def map_entries(
    low: Lowering, dtypes: Sequence[DTypeLike], shape: tuple, f: Callable[..., Sequence[Value]],
    *xs: ThreadArray, loop_above: int,
) -> list[ThreadArray]:  # fmt: skip
    """Apply f to the entries of arrays, which are broadcast to `shape`.

    f returns one value per dtype. Arrays of more than `loop_above` entries are computed by a loop
    over memory.
    """
    b, size = low.b, math.prod(shape)
    if size > loop_above:
        sources = [_in_loop(b, x, shape) for x in xs]
        results = [View.of(b.local(dtype, size), shape) for dtype in dtypes]
        views = results
        if not b.in_team:  # one loop in place of a nest, if all entries are equally spaced
            moving = [x for x in sources if isinstance(x, View)]
            flat = iter(arrays.as_flat_views(*moving, *results))
            sources = [next(flat) if isinstance(x, View) else x for x in sources]
            views = list(flat)

        def one(*i: Value) -> None:
            values = f(*(arrays.load_entry(b, x, i) for x in sources))
            for view, value in zip(views, values, strict=True):
                arrays.store_entry(b, view, i, value)

        arrays.for_each_index(b, views[0].shape, one)
        return list(results)
    operands = np.broadcast_arrays(*(low.to_scalars(x) for x in xs), np.empty(shape, bool))[:-1]
    outs = [np.empty(shape, object) for _ in dtypes]
    for i in arrays.indices_of(shape):
        for out, value in zip(outs, f(*(x[i] for x in operands)), strict=True):
            out[i] = value
    return list(outs)


def _in_loop(b: Builder, x: ThreadArray, shape: tuple) -> View | Delayed:
    """Return x, broadcast to a shape, for a loop over its entries. One value stays in its
    register."""
    if isinstance(x, np.ndarray) and own_entries(np.broadcast_to(x, shape)).size == 1:
        return source(b, x, shape)
    return arrays.broadcast_in_memory(b, x, _dtype(x), shape)


def _is_wide(xs: tuple, size: int) -> bool:
    """Return whether a team should compute the entries in a shared loop, not in registers."""
    if all(isinstance(x, np.ndarray) for x in xs):
        entries = sum(own_entries(x).size for x in xs if not arrays.is_constant(x))
        return size > arrays.FEW and 0 < entries < size
    return size > arrays.FEW or any(isinstance(x, Delayed) for x in xs)


def own_entries(x: np.ndarray) -> np.ndarray:
    """Return an array without the entries that broadcasting repeats."""
    own = (slice(0, 1) if s == 0 else slice(None) for s in x.strides)
    return x[tuple(own)] if x.size and x.ndim else x


def _delayed(b: Builder, dtype: DTypeLike, shape: tuple, f: Callable, xs: tuple) -> Delayed:
    """Return a delayed array of f applied to the entries of the arrays xs."""
    sources = [source(b, x, shape) for x in xs]
    operands = frozenset().union(*(s.sources for s in sources))
    cost = 1 + sum(s.cost for s in sources)

    def entry(*i: Value) -> Value:
        return f(*(s.entry(*i) for s in sources))

    return Delayed(shape, np.dtype(dtype), entry, operands, cost)


def source(b: Builder, x: ThreadArray, shape: tuple) -> Delayed:
    """Return a delayed array of the entries of x, broadcast to a shape by numpy's rules.
    Values in registers are also stored in memory, because an index may not be constant."""
    if not isinstance(x, np.ndarray):
        wide = x.broadcast(shape, range(len(shape) - x.ndim, len(shape)))
        if isinstance(wide, Delayed):
            return wide
        view = wide
        return Delayed(
            shape, view.dtype, lambda *i: arrays.load_entry(b, view, i), frozenset({view.array}), 1
        )
    x = np.broadcast_to(x, shape)
    own = own_entries(x)
    dtype = _dtype(x)
    if own.size == 1:
        value = own.reshape(-1)[0]
        return Delayed(shape, dtype, lambda *i: value, frozenset(), 0)
    memory = arrays.to_memory(b, x, dtype)

    def entry(*i: Value) -> Value:
        known = [k.item() for k in i if not isinstance(k, Var)]
        return x[tuple(known)] if len(known) == len(i) else arrays.load_entry(b, memory, i)

    return Delayed(shape, dtype, entry, frozenset(), 1)


def _dtype(x: ThreadArray) -> np.dtype:
    return x.flat[0].dtype if isinstance(x, np.ndarray) and x.dtype == object else x.dtype


def _shape(eqn: Equation) -> tuple[int, ...]:
    return eqn.outvars[0].aval.shape


def _one(low: Lowering, eqn: Equation, ins: list) -> list:
    operation, dtype = OF_PRIMITIVE[eqn.primitive.name], dtype_of(eqn.outvars[0].aval)
    if operation.fold and all(map(arrays.is_constant, ins)):
        with np.errstate(all="ignore"):
            return [np.asarray(operation.fold(*ins), dtype)]
    f = functools.partial(low.b.op, operation.name, dtype)
    return [map_entrywise(low, dtype, _shape(eqn), f, *ins)]


rule(*OF_PRIMITIVE)(_one)
accepts_delayed(
    *OF_PRIMITIVE, "div", "rem", "pow", "square", "integer_pow", "logistic", "sign", "round",
    "clamp", "select_n", "convert_element_type",
)  # fmt: skip


def entrywise(name: str) -> Callable:
    """Register f(builder, dtype of the result, parameters, *entries) as the rule of a primitive."""

    def register(f: Callable[..., Value]) -> Callable[..., Value]:
        def lower(low: Lowering, eqn: Equation, ins: list) -> list:
            dtype = dtype_of(eqn.outvars[0].aval)
            of_entries = functools.partial(f, low.b, dtype, eqn.params)
            return [map_entrywise(low, dtype, _shape(eqn), of_entries, *ins)]

        rule(name)(lower)
        return f

    return register


@rule("div")
def _div(low: Lowering, eqn: Equation, ins: list) -> list:
    dtype = dtype_of(eqn.outvars[0].aval)
    if dtype.kind == "f" and all(map(arrays.is_constant, ins)):
        with np.errstate(all="ignore"):
            return [np.asarray(np.divide(*ins), dtype)]
    f = functools.partial(low.b.op, "div" if dtype.kind == "f" else "idiv", dtype)
    return [map_entrywise(low, dtype, _shape(eqn), f, *ins)]


@entrywise("rem")
def _rem(b: Builder, dtype: np.dtype, params: dict, x: Value, y: Value) -> Value:
    return b.op("fmod" if dtype.kind == "f" else "irem", dtype, x, y)


@entrywise("pow")
def _pow(b: Builder, dtype: np.dtype, params: dict, x: Value, y: Value) -> Value:
    if dtype.kind != "f":
        raise Unsupported("pow of integers")
    return b.op("pow", dtype, x, b.cast(y, dtype))


@entrywise("square")
def _square(b: Builder, dtype: np.dtype, params: dict, x: Value) -> Value:
    return b.op("mul", dtype, x, x)


@rule("one_minus_square")  # from jax 0.11 on, in the derivatives of tanh, asin, acos, atanh
def _one_minus_square(low: Lowering, eqn: Equation, ins: list) -> list:
    return low.evaluate(lambda x: (1 + x) * (1 - x), *ins, avals=[eqn.invars[0].aval])


@entrywise("integer_pow")
def _integer_pow(b: Builder, dtype: np.dtype, params: dict, x: Value) -> Value:
    y = params["y"]
    n, square, out = abs(y), x, None
    while n:
        if n & 1:
            out = square if out is None else b.op("mul", dtype, out, square)
        n >>= 1
        if n:
            square = b.op("mul", dtype, square, square)
    out = dtype.type(1) if out is None else out
    return b.op("div", dtype, dtype.type(1), out) if y < 0 else out


@entrywise("logistic")
def _logistic(b: Builder, dtype: np.dtype, params: dict, x: Value) -> Value:
    one = dtype.type(1)
    e = b.op("exp", dtype, b.op("neg", dtype, x))
    return b.op("div", dtype, one, b.op("add", dtype, e, one))


@entrywise("sign")
def _sign(b: Builder, dtype: np.dtype, params: dict, x: Value) -> Value:
    zero, below = dtype.type(0), x  # x itself if x is 0 or nan
    if dtype.kind != "u":
        below = b.select(b.op("lt", BOOL, x, zero), dtype.type(-1), x)
    return b.select(b.op("gt", BOOL, x, zero), dtype.type(1), below)


@entrywise("round")
def _round(b: Builder, dtype: np.dtype, params: dict, x: Value) -> Value:
    return b.op("rint" if int(params["rounding_method"]) == 1 else "round", dtype, x)


@entrywise("clamp")
def _clamp(b: Builder, dtype: np.dtype, params: dict, least: Value, x: Value, most: Value) -> Value:
    return b.op("min", dtype, b.op("max", dtype, x, least), most)


@entrywise("select_n")
def _select_n(b: Builder, dtype: np.dtype, params: dict, which: Value, *cases: Value) -> Value:
    if len(cases) == 1:
        return cases[0]
    if which.dtype == BOOL:
        return b.select(which, cases[1], cases[0])
    out = cases[-1]
    for k in reversed(range(len(cases) - 1)):
        out = b.select(b.op("eq", BOOL, which, which.dtype.type(k)), cases[k], out)
    return out


@rule("convert_element_type", "reduce_precision")
def _convert(low: Lowering, eqn: Equation, ins: list) -> list:
    dtype, b = dtype_of(eqn.outvars[0].aval), low.b
    if eqn.primitive.name == "reduce_precision":
        bits = (eqn.params["exponent_bits"], eqn.params["mantissa_bits"])
        if bits != {4: (8, 23), 8: (11, 52)}[dtype.itemsize]:
            raise Unsupported(f"reduce_precision to {bits}")
        return list(ins)
    x = ins[0]
    if isinstance(x, View) and x.dtype == dtype:
        return [x]
    if arrays.is_constant(x) and dtype.kind == "f":
        return [x.astype(dtype)]

    def f(x: Value) -> Value:
        if dtype == BOOL:
            return b.op("ne", BOOL, x, x.dtype.type(0)) if x.dtype != BOOL else x
        return b.cast(x, dtype)

    return [map_entrywise(low, dtype, _shape(eqn), f, x)]


@rule("bitcast_convert_type")
def _bitcast(low: Lowering, eqn: Equation, ins: list) -> list:
    dtype = dtype_of(eqn.outvars[0].aval)
    if eqn.invars[0].aval.dtype.itemsize != dtype.itemsize:
        raise Unsupported("bitcast_convert_type to another size")
    f = functools.partial(low.b.op, "bitcast", dtype)
    return [map_entrywise(low, dtype, _shape(eqn), f, *ins)]


@rule("sincos")
def _sincos(low: Lowering, eqn: Equation, ins: list) -> list:
    """Emit the cosine and the sine of an angle, by polynomials of the same reduced angle."""
    dtype = eqn.invars[0].aval.dtype
    closed = _traced(polynomial_sincos, dtype)

    def pair(angle: Value) -> list[Value]:
        return [low.to_scalar(x) for x in low.closed(closed, [arrays.full_of((), angle)])]

    return map_entries(low, [dtype] * 2, _shape(eqn), pair, *ins, loop_above=LOOP_ABOVE_IN_MEMORY)


@functools.cache
def _traced(f: Callable, dtype: np.dtype) -> Any:
    return jax.make_jaxpr(f)(jnp.zeros((), dtype))
