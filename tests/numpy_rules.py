"""JAX's primitives by numpy: what an equation of a program does to arrays (`tests.quickly`).

Primitives that are not here, and keys of random numbers, are left to JAX. Transcendental functions
are computed by XLA, whose last digits they have then.
"""

from __future__ import annotations

import math
import string
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

ALIKE: dict[str, Callable] = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative,
    "max": np.maximum, "min": np.minimum, "abs": np.abs, "sqrt": np.sqrt, "floor": np.floor,
    "ceil": np.ceil, "square": np.square, "is_finite": np.isfinite,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor,
    "not": np.invert, "stop_gradient": lambda x: x, "name": lambda x: x, "copy": lambda x: x,
    "copy_p": lambda x: x, "batch_first": lambda x, *_: x, "batch_last": lambda x: x,
    "fusion_barrier": lambda *xs: xs, "optimization_barrier": lambda *xs: xs,
}  # fmt: skip
RULES: dict[str, Callable[[Any], Callable | None]] = {}


def rule(*names: str) -> Callable:
    return lambda f: RULES.update(dict.fromkeys(names, f)) or f


def shape_of(eqn: Any) -> tuple[int, ...]:
    return eqn.outvars[0].aval.shape


def _floats(eqn: Any) -> bool:
    return all(np.issubdtype(v.aval.dtype, np.floating) for v in eqn.invars)


@rule("div")
def _div(eqn):
    return np.divide if _floats(eqn) else None


@rule("integer_pow")
def _integer_pow(eqn):
    y = eqn.params["y"]

    def power(x: Any) -> Any:  # as XLA's
        out, n = None, abs(y)
        while n:
            if n & 1:
                out = x if out is None else out * x
            n >>= 1
            if n:
                x = x * x
        return out if y > 0 else 1 / out

    return power if y and _floats(eqn) else None


@rule("convert_element_type")
def _convert(eqn):
    dtype = eqn.params["new_dtype"]
    if jnp.issubdtype(dtype, jax.dtypes.extended):
        return None
    return lambda x: x.astype(dtype)


@rule("select_n")
def _select(eqn):
    if eqn.invars[0].aval.dtype != bool or len(eqn.invars) != 3:
        return None
    return lambda which, no, yes: np.where(which, yes, no)


@rule("broadcast_in_dim")
def _broadcast(eqn):
    if len(eqn.invars) > 1:
        return None
    shape, dims = shape_of(eqn), eqn.params["broadcast_dimensions"]
    given = eqn.invars[0].aval
    between = [1] * len(shape)
    for size, d in zip(given.shape, dims, strict=True):
        between[d] = size
    if tuple(between) == shape:
        return lambda x: np.reshape(x, shape)

    def full(x: Any) -> Any:
        out = np.empty(shape, given.dtype)
        out[...] = np.reshape(x, between)
        return out

    return full


@rule("reshape", "squeeze", "expand_dims")
def _reshape(eqn):
    if eqn.params.get("dimensions") and eqn.primitive.name == "reshape":
        return None
    shape = shape_of(eqn)
    return lambda x: np.reshape(x, shape)


@rule("transpose")
def _transpose(eqn):
    order = eqn.params["permutation"]
    return lambda x: np.transpose(x, order)


@rule("slice")
def _slice(eqn):
    p = eqn.params
    strides = p["strides"] or (1,) * len(p["start_indices"])
    part = tuple(map(slice, p["start_indices"], p["limit_indices"], strides))
    return lambda x: x[part]


@rule("concatenate")
def _concatenate(eqn):
    axis = eqn.params["dimension"]
    return lambda *xs: np.concatenate(xs, axis)


@rule("stack")
def _stack(eqn):
    axis = eqn.params["axis"]
    return lambda *xs: np.stack(xs, axis)


@rule("unstack")
def _unstack(eqn):
    axis = eqn.params["axis"]
    return lambda x: list(np.moveaxis(x, axis, 0))


@rule("split")
def _split(eqn):
    at, axis = np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"]
    return lambda x: np.split(x, at, axis)


@rule("pad")
def _pad(eqn):
    config, shape = eqn.params["padding_config"], shape_of(eqn)
    if any(low < 0 or high < 0 for low, high, _ in config):
        return None
    sizes = eqn.invars[0].aval.shape
    inside = tuple(
        slice(low, low + max(0, (size - 1) * (between + 1) + 1), between + 1)
        for (low, _, between), size in zip(config, sizes, strict=True)
    )

    def pad(x: Any, value: Any) -> Any:
        out = np.full(shape, value)
        out[inside] = x
        return out

    return pad


@rule("iota")
def _iota(eqn):
    if eqn.invars:
        return None
    p = eqn.params
    row = np.arange(p["shape"][p["dimension"]], dtype=p["dtype"])
    sizes = [-1 if d == p["dimension"] else 1 for d in range(len(p["shape"]))]
    full = np.broadcast_to(row.reshape(sizes), p["shape"])
    return lambda: full


REDUCTIONS = {"sum": np.sum, "max": np.max, "min": np.min, "or": np.any, "and": np.all}


@rule(*(f"reduce_{name}" for name in REDUCTIONS))
def _reduce(eqn):
    f, axes = REDUCTIONS[eqn.primitive.name.removeprefix("reduce_")], eqn.params["axes"]
    given = eqn.invars[0].aval
    if (f in (np.any, np.all) and given.dtype != bool) or given.size == 0:
        return None
    if f is np.sum:
        return lambda x: np.sum(x, axes, dtype=given.dtype)
    return lambda x: f(x, axes)


@rule("dot_general")
def _dot(eqn):
    contracted, batch = eqn.params["dimension_numbers"]
    if not _floats(eqn):
        return None
    if batch == ((), ()):
        return lambda a, b: np.tensordot(a, b, contracted)
    letters = iter(string.ascii_letters)
    left, right = ([""] * v.aval.ndim for v in eqn.invars)
    for pairs in (batch, contracted):
        for i, j in zip(*pairs, strict=True):
            left[i] = right[j] = next(letters)
    both = [left[i] for i in batch[0]]
    free = [[k for k, x in enumerate(side) if not x] for side in (left, right)]
    for side, places in zip((left, right), free, strict=True):
        for k in places:
            side[k] = next(letters)
            both.append(side[k])
    sums = f"{''.join(left)},{''.join(right)}->{''.join(both)}"
    return lambda a, b: np.einsum(sums, a, b)


# ---------------------------------------------------------------- elementwise functions

SIZES = (8, 64, 512, 4096)  # of the arrays that XLA computes transcendental functions of


TRANSCENDENTAL = (
    "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh",
    "atanh", "exp", "exp2", "log", "log1p", "expm1", "logistic", "erf", "erfc", "erf_inv",
    "rsqrt", "cbrt", "atan2", "pow", "sincos",
)  # fmt: skip


@rule(*TRANSCENDENTAL)
def _transcendental(eqn):
    """XLA's own function, of arrays of few sizes: each is compiled once for all shapes."""
    shape, p = shape_of(eqn), eqn.primitive
    n = math.prod(shape)
    if not _floats(eqn) or ((n,) == shape and n in SIZES) or not 0 < n <= SIZES[-1]:
        return None
    room = min(size for size in SIZES if size >= n)
    dtypes = [v.aval.dtype for v in eqn.invars]

    def run(*xs: Any) -> Any:
        padded = [np.ones(room, dtype) for dtype in dtypes]
        for to, x in zip(padded, xs, strict=True):
            to[:n] = np.ravel(x) if np.shape(x) == shape else np.broadcast_to(x, shape).ravel()
        out = p.bind(*padded, **eqn.params)
        many = [np.asarray(y)[:n].reshape(shape) for y in (out if p.multiple_results else [out])]
        return many if p.multiple_results else many[0]

    return run


@rule("sign")
def _sign(eqn):
    return (lambda x: np.where(x == 0, x, np.sign(x))) if _floats(eqn) else np.sign


@rule("rem")
def _rem(eqn):
    return np.fmod if _floats(eqn) else None


@rule("clamp")
def _clamp(eqn):
    return lambda low, x, high: np.minimum(np.maximum(x, low), high)


@rule("round")
def _round(eqn):
    even = eqn.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    return np.rint if even else None


@rule("shift_right_logical", "shift_left")
def _shift(eqn):
    if any(not np.issubdtype(v.aval.dtype, np.unsignedinteger) for v in eqn.invars):
        return None
    f = np.left_shift if eqn.primitive.name == "shift_left" else np.right_shift
    bits = eqn.outvars[0].aval.dtype.itemsize * 8
    return lambda x, y: np.where(y < bits, f(x, y), 0).astype(x.dtype)


@rule("bitcast_convert_type")
def _bitcast(eqn):
    dtype = eqn.params["new_dtype"]
    if eqn.invars[0].aval.dtype.itemsize != np.dtype(dtype).itemsize:
        return None
    return lambda x: np.asarray(x).view(dtype)


# ---------------------------------------------------------------- along one axis


@rule("rev")
def _rev(eqn):
    dims = eqn.params["dimensions"]
    return lambda x: np.flip(x, dims)


@rule("cumsum", "cumprod", "cummax", "cummin")
def _cumulate(eqn):
    axis, back, dtype = eqn.params["axis"], eqn.params["reverse"], eqn.outvars[0].aval.dtype
    f = {
        "cumsum": np.add, "cumprod": np.multiply, "cummax": np.maximum, "cummin": np.minimum,
    }[eqn.primitive.name].accumulate  # fmt: skip
    if back:
        return lambda x: np.flip(f(np.flip(x, axis), axis, dtype), axis)
    return lambda x: f(x, axis, dtype)


@rule("argmax", "argmin")
def _argmax(eqn):
    (axis,), dtype = eqn.params["axes"], eqn.params["index_dtype"]
    f = np.argmax if eqn.primitive.name == "argmax" else np.argmin
    return lambda x: np.asarray(f(x, axis)).astype(dtype)


@rule("reduce_prod")
def _product(eqn):
    axes, dtype = eqn.params["axes"], eqn.invars[0].aval.dtype
    return lambda x: np.prod(x, axes, dtype=dtype)


@rule("sort")
def _sort(eqn):
    axis = eqn.params["dimension"]
    if eqn.params["num_keys"] != 1:
        return None

    def run(key: Any, *others: Any) -> list:
        order = np.argsort(key, axis, kind="stable")
        return [np.take_along_axis(x, order, axis) for x in (key, *others)]

    return run
