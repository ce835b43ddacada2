"""Lowering rules for random numbers: threefry keys, with the same bits as `jax.random`.

Source: Salmon et al., *Parallel random numbers: as easy as 1, 2, 3*, 2011.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from rbjax._jax_compat import key_implementation
from rbjax.compiler.ir.statements import Unsupported, Value
from rbjax.compiler.lower.arrays import ThreadArray, indices_of
from rbjax.compiler.lower.elementwise import map_entries
from rbjax.compiler.lower.lowering import KEY, Equation, Lowering, dtype_of, rule

U32 = np.dtype(np.uint32)
#: more blocks than this are computed by a loop
LOOP_ABOVE = 16
ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)


@rule("threefry2x32")
def _threefry(low: Lowering, eqn: Equation, ins: list) -> list:
    shape, f = eqn.outvars[0].aval.shape, functools.partial(threefry, low)
    return map_entries(low, [U32] * 2, shape, f, *ins, loop_above=LOOP_ABOVE)


@rule("iota_2x32_shape")
def _counters(low: Lowering, eqn: Equation, ins: list) -> list:
    shape = eqn.outvars[0].aval.shape
    count = np.arange(np.prod(shape, dtype=np.int64), dtype=np.uint64).reshape(shape)
    return [(count >> np.uint64(32)).astype(U32), count.astype(U32)]


def threefry(low: Lowering, k0: Value, k1: Value, x: Value, y: Value) -> tuple[Value, Value]:
    """Emit twenty rounds of the cipher threefry2x32 with key (k0, k1) on the block (x, y)."""
    b = low.b

    def op(name: str, *args: Value) -> Value:
        return b.op(name, U32, *args)

    keys = k0, k1, op("xor", op("xor", k0, k1), U32.type(0x1BD11BDA))
    x, y = op("add", x, k0), op("add", y, k1)
    for turn in range(5):
        for r in ROTATIONS[turn % 2]:
            x = op("add", x, y)
            y = op("or", op("shl", y, U32.type(r)), op("shr", y, U32.type(32 - r)))
            y = op("xor", x, y)
        x = op("add", x, keys[(turn + 1) % 3])
        y = op("add", op("add", y, keys[(turn + 2) % 3]), U32.type(turn + 1))
    return x, y


def unwrap_keys(low: Lowering, keys: ThreadArray) -> np.ndarray:
    """Convert 64-bit keys (...) to pairs of 32-bit integers (..., 2)."""
    b, x = low.b, low.to_scalars(keys)
    out = np.empty((*x.shape, 2), object)
    for i in indices_of(x.shape):
        out[(*i, 0)] = b.cast(x[i], U32)
        out[(*i, 1)] = b.cast(b.op("shr", KEY, x[i], KEY.type(32)), U32)
    return out


def wrap_keys(low: Lowering, data: ThreadArray) -> np.ndarray:
    """Convert pairs of 32-bit integers (..., 2) to 64-bit keys (...)."""
    b, x = low.b, low.to_scalars(data)
    out = np.empty(x.shape[:-1], object)
    for i in indices_of(out.shape):
        high = b.op("shl", KEY, b.cast(x[(*i, 1)], KEY), KEY.type(32))
        out[i] = b.op("or", KEY, b.cast(x[(*i, 0)], KEY), high)
    return out


def _impl(dtype: Any) -> Any:
    if dtype_of(jax.ShapeDtypeStruct((), dtype)) != KEY:
        raise Unsupported(f"random keys of type {dtype}")
    return key_implementation(dtype)


@rule("random_wrap")
def _wrap(low: Lowering, eqn: Equation, ins: list) -> list:
    _impl(eqn.outvars[0].aval.dtype)
    return [wrap_keys(low, ins[0])]


@rule("random_unwrap")
def _unwrap(low: Lowering, eqn: Equation, ins: list) -> list:
    return [unwrap_keys(low, ins[0])]


@rule("random_clone")
def _clone(low: Lowering, eqn: Equation, ins: list) -> list:
    return list(ins)


@rule("random_seed")
def _seed(low: Lowering, eqn: Equation, ins: list) -> list:
    impl, aval = _impl(eqn.outvars[0].aval.dtype), eqn.invars[0].aval
    return [wrap_keys(low, _each(low, impl.seed, aval.shape, [ins[0]], [aval.dtype])[0])]


@rule("random_bits")
def _bits(low: Lowering, eqn: Equation, ins: list) -> list:
    P, aval = eqn.params, eqn.invars[0].aval
    impl = _impl(aval.dtype)
    f = lambda key: impl.random_bits(key, P["bit_width"], P["shape"])  # noqa: E731
    return _each(low, f, aval.shape, [unwrap_keys(low, ins[0])], [U32])


@rule("random_split")
def _split(low: Lowering, eqn: Equation, ins: list) -> list:
    aval = eqn.invars[0].aval
    f = lambda key: _impl(aval.dtype).split(key, eqn.params["shape"])  # noqa: E731
    return [wrap_keys(low, _each(low, f, aval.shape, [unwrap_keys(low, ins[0])], [U32])[0])]


@rule("random_fold_in")
def _fold_in(low: Lowering, eqn: Equation, ins: list) -> list:
    key, message = (v.aval for v in eqn.invars)
    shape = eqn.outvars[0].aval.shape
    keys = np.broadcast_to(unwrap_keys(low, ins[0]), (*shape, 2))
    args = [keys, np.broadcast_to(low.to_scalars(ins[1]), shape)]
    (out,) = _each(low, _impl(key.dtype).fold_in, shape, args, [U32, message.dtype])
    return [wrap_keys(low, out)]


def _each(low: Lowering, f: Callable, shape: tuple, args: list, dtypes: list) -> list[ThreadArray]:
    """Lower f, mapped over the leading axes `shape` of its arguments."""
    for _ in shape:
        f = jax.vmap(f)
    avals = [jax.ShapeDtypeStruct(x.shape, d) for x, d in zip(args, dtypes, strict=True)]
    return low.evaluate(f, *args, avals=avals)
