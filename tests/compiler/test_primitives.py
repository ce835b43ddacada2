"""Every primitive that threads support, by the emitted C and LLVM IR against XLA, edge values
included."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.lax import GatherDimensionNumbers as Gather
from jax.lax import GatherScatterMode as Mode
from jax.lax import ScatterDimensionNumbers as Scatter

from rbjax.compiler.ir.statements import Unsupported
from rbjax.lanes import sincos
from tests.compiler.host import (
    COMPILER,
    GPU_ASKED,
    Case,
    by_llvm,
    by_vectors,
    by_xla,
    many_on_host,
    on_host,
    written,
)

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
host_alone = pytest.mark.skipif(GPU_ASKED, reason="is more than a GPU's thread takes")

F32, F64, I32, I64 = (np.dtype(x) for x in ("f4", "f8", "i4", "i8"))
FLOATS, SIGNED = (F32, F64), (np.dtype("i1"), np.dtype("i2"), I32, I64)
UNSIGNED = tuple(np.dtype(x) for x in ("u1", "u2", "u4", "u8"))
BOOL = np.dtype(bool)
INTS = (*SIGNED, *UNSIGNED)


def mostly_slow(quick: tuple, slow: tuple) -> list:
    """Parameters, of which some are left to the long run."""
    return [*quick, *(pytest.param(x, marks=pytest.mark.slow) for x in slow)]


def compare(cases: dict[str, Case], ulps: float = 4, absolute: float = 0.0) -> None:
    """The emitted C and LLVM IR of each case agree with XLA: integers exactly, floats to
    rounding."""
    every = list(cases.values())
    wants = by_xla(every)
    found = {"C": many_on_host(every, ("-O0", "-ffp-contract=off"))}
    if not GPU_ASKED:
        found["LLVM"], found["vectors"] = by_llvm(every), by_vectors(every)
    wrong = [
        f"{name} by {how}, {bad}"
        for how, results in found.items()
        for name, got, want in zip(cases, results, wants, strict=True)
        for g, w in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True)
        for bad in differences(g, repeated(w, g), ulps, absolute)
    ]
    assert not wrong, "\n".join(["", *wrong])


def repeated(want: np.ndarray, got: np.ndarray) -> np.ndarray:
    """What XLA finds, as often as a batch was repeated."""
    return np.resize(want, (len(got), *want.shape[1:])) if len(got) > len(want) else want


def differences(g: np.ndarray, w: np.ndarray, ulps: float, absolute: float) -> list[str]:
    """Shapes, types or entries that do not agree."""
    if (g.dtype, g.shape) != (w.dtype, w.shape):
        return [f"{g.dtype} {g.shape}, XLA: {w.dtype} {w.shape}"]
    bad = ~close(g, w, ulps, absolute)
    places = np.argwhere(bad)[:3].tolist()
    return [f"{places}: {g[bad][:3]}, XLA: {w[bad][:3]}"] if bad.any() else []


def close(got: np.ndarray, want: np.ndarray, ulps: float, absolute: float) -> np.ndarray:
    """Which entries agree."""
    if got.dtype.kind != "f":
        return got == want
    eps, tiny = float(np.finfo(got.dtype).eps), float(np.finfo(got.dtype).tiny)
    with np.errstate(all="ignore"):  # XLA's CPU code has no numbers below the least normal one
        return np.isclose(got, want, ulps * eps, absolute * eps + tiny, equal_nan=True)


def edges(dtype: np.dtype) -> np.ndarray:
    """Values at which something may go wrong."""
    if dtype.kind == "f":
        tiny, most = np.finfo(dtype).tiny, np.finfo(dtype).max
        x = [0.0, -0.0, 1, -1, 0.5, -0.5, 1.5, -1.5, 2.5, -2.5, 0.3, -0.7, 3.7, 1e-5, 12.25, -9.3]
        x += [100.1, 1e10, -1e10, 4e18, 3e9, -3e9, tiny, most, -most, np.inf, -np.inf, np.nan]
    elif dtype.kind == "b":
        x = [False, True]
    else:
        i = np.iinfo(dtype)
        x = [0, 1, 2, 3, 5, 7, 31, 32, 100, i.max, i.max - 1, i.min, i.min + 1]
        x += [-1, -2, -3, -7, -100] if i.min else [i.max // 2]
    with np.errstate(all="ignore"):
        return np.array(x, dtype)


def pairs(dtype: np.dtype) -> tuple[np.ndarray, np.ndarray]:
    x = edges(dtype)
    return np.repeat(x, len(x)), np.tile(x, len(x))


def normal(dtype: np.dtype, *shape: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if dtype.kind == "f":
        return rng.normal(size=shape).astype(dtype)
    if dtype.kind == "b":
        return rng.random(shape) < 0.5
    return rng.integers(0 if dtype.kind == "u" else -9, 9, shape).astype(dtype)


# ------------------------------------------------------------------- entry by entry

EXACT_UNARY = [jnp.negative, lax.abs, lax.sign, lax.floor, lax.ceil, lax.is_finite, lax.sqrt,
               lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN),
               lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO), lax.square]  # fmt: skip
UNARY = [lax.exp, lax.exp2, lax.expm1, lax.log, lax.log1p, lax.tanh, lax.asin, lax.acos, lax.atan,
         lax.sinh, lax.cosh, lax.asinh, lax.acosh, lax.atanh, lax.erf, lax.erfc, lax.logistic,
         lax.rsqrt, lax.cbrt, lax.erf_inv, lax.lgamma]  # fmt: skip
PERIODIC = [lax.sin, lax.cos, lax.tan]
BINARY = [lax.add, lax.sub, lax.mul, lax.div, lax.max, lax.min, lax.rem]
COMPARE = [lax.eq, lax.ne, lax.lt, lax.le, lax.gt, lax.ge]
BITS = [lax.bitwise_and, lax.bitwise_or, lax.bitwise_xor]
SHIFTS = [lax.shift_left, lax.shift_right_logical, lax.shift_right_arithmetic]


def slope(f: Callable, x: jax.Array) -> jax.Array:
    return jax.jvp(f, (x,), (jnp.ones_like(x),))[1]


def all_of(*fs: Callable) -> Callable:
    return lambda *args: tuple(f(*args) for f in fs)


@pytest.mark.parametrize("dtype", FLOATS, ids=str)
def test_functions_of_one_float(dtype):
    x = edges(dtype)
    ordinary = x[(np.abs(x) < 1e4) | ~np.isfinite(x)]
    cases: dict[str, Case] = {f"exact {k}": (f, (x,)) for k, f in enumerate(EXACT_UNARY)}
    cases |= {f.__name__: (f, (ordinary,)) for f in (*UNARY, *PERIODIC)}
    cases["log2"] = (jnp.log2, (ordinary,))
    for f in (lax.tanh, lax.asin, lax.acos, lax.atanh):
        cases[f"slope of {f.__name__}"] = (functools.partial(slope, f), (ordinary,))
    powers = [functools.partial(lax.integer_pow, y=y) for y in (-3, -1, 0, 1, 2, 3, 7)]
    cases["integer_pow"] = (all_of(*powers), (ordinary,))
    compare(cases, ulps=32, absolute=4)


def test_signs_of_zero_survive():
    """Where they show: copysign, atan2, and 1 / x."""
    x = np.array([0.0, -0.0, 1.0, -1.0])

    def f(x):
        quotients = 1 / -x, 1 / (x - 0.0), 1 / (0.0 - x), 1 / (x * 1.0)
        signs = jnp.copysign(2, x), jnp.arctan2(x, -1.0), 1 / jnp.round(x / 4), 1 / lax.sign(x)
        return quotients + signs

    got, want = on_host(f, x), jax.jit(jax.vmap(f))(x)
    for g, w in zip(got, want, strict=True):
        np.testing.assert_array_equal(g, w)


@pytest.mark.parametrize("dtype", FLOATS, ids=str)
def test_functions_of_two_floats(dtype):
    x, y = pairs(dtype)
    cases: dict[str, Case] = {f.__name__: (f, (x, y)) for f in (*BINARY, *COMPARE, lax.nextafter)}
    cases["atan2"] = (lax.atan2, (x, y))
    small = (np.abs(x) < 1e4) & (np.abs(y) < 20) | ~(np.isfinite(x) & np.isfinite(y))
    cases["pow"] = (lax.pow, (x[small], y[small]))
    cases["clamp"] = (lambda x, y: lax.clamp(y, x, y + 1), (x, y))
    compare(cases, ulps=32)


@pytest.mark.parametrize("dtype", FLOATS, ids=str)
def test_erf_inv_digamma_and_lgamma(dtype):
    x = np.concatenate([np.linspace(-1, 1, 41), 1 - np.logspace(-15, -1, 15), [2, np.nan]])
    y = np.concatenate([np.linspace(-4.9, 9.7, 74), [1e-3, 40, 1e6, 0, -1, -2, np.inf, np.nan]])
    cases: dict[str, Case] = {
        "erf_inv": (lax.erf_inv, (x.astype(dtype),)),
        "digamma": (lax.digamma, (y[y != 0].astype(dtype),)),  # at 0: -inf, before jax 0.11 nan
        "lgamma": (lax.lgamma, (y.astype(dtype),)),
    }
    compare(cases, ulps=64, absolute=64)


@pytest.mark.parametrize(
    "dtype",
    mostly_slow((I32, UNSIGNED[2]), (*SIGNED[:2], I64, *UNSIGNED[:2], UNSIGNED[3])),
    ids=str,
)
def test_integers(dtype):
    """Wrapping, division by zero, the least by -1, shifts beyond the width."""
    x, y = pairs(dtype)
    cases: dict[str, Case] = {"two": (all_of(*BINARY, *COMPARE, *BITS, *SHIFTS), (x, y))}
    unary = [lax.bitwise_not, lax.population_count, lax.clz, lax.sign, jnp.negative, jnp.abs,
             lambda x: lax.integer_pow(x, 3), lax.square]  # fmt: skip
    cases["one"] = (all_of(*unary), (edges(dtype),))
    cases["clamp"] = (lambda x, y: lax.clamp(dtype.type(1), x, y), (x, y))
    compare(cases)


def test_powers_of_integers():
    x, y = np.array([0, 1, 2, 3, -2, -1, 5], np.int32), np.array([0, 3, 5, 2, 3, 7, 1], np.int32)
    cases: dict[str, Case] = {
        "float, int": (lambda x, y: lax.pow(x.astype(jnp.float64), y), (x, y)),
        "jnp": (lambda x, y: jnp.power(x, y), (x, y)),
    }
    compare(cases)


def test_booleans():
    x, y = pairs(BOOL)
    cases: dict[str, Case] = {"two": (all_of(*COMPARE, *BITS, lax.max, lax.min), (x, y))}
    cases["not"] = (lax.bitwise_not, (x,))
    compare(cases)


@pytest.mark.parametrize(
    "source", mostly_slow((F64, F32, I32, BOOL), (*SIGNED[:2], I64, *UNSIGNED)), ids=str
)
def test_conversions(source):
    """From float to integer: towards zero, saturating, nan to 0."""
    targets = (*FLOATS, *INTS, BOOL)
    f = all_of(*(functools.partial(lax.convert_element_type, new_dtype=d) for d in targets))
    same = [d for d in targets if d.itemsize == source.itemsize and BOOL not in (d, source)]
    bits = all_of(*(functools.partial(lax.bitcast_convert_type, new_dtype=d) for d in same))
    compare({"convert": (f, (edges(source),)), "bitcast": (bits, (edges(source),))})


def test_select_by_number_and_by_truth():
    which = np.array([0, 1, 2, 1], np.int32)
    x, y, z = (normal(F64, 4, 3, seed=k) for k in range(3))
    cases: dict[str, Case] = {
        "three": (lambda w, x, y, z: lax.select_n(jnp.full(3, w), x, y, z), (which, x, y, z)),
        "scalar": (lambda w, x, y: lax.select_n(w == 1, x, y), (which, x, y)),
        "one": (lambda w, x: lax.select_n(jnp.full(3, w), x), (which, x)),
    }
    compare(cases)


# ------------------------------------------------------------------- reductions


@pytest.mark.parametrize("dtype", mostly_slow((F64, I32), (F32, np.dtype("u4"), I64)), ids=str)
def test_reductions(dtype):
    x = normal(dtype, 3, 2, 3, 4)
    if dtype.kind == "f":
        x[1, 0, 1, 2], x[2, 1, 2, :2] = np.nan, np.inf
    fs = [jnp.sum, jnp.prod, jnp.max, jnp.min]
    axes = [0, 1, 2, (0, 2), (0, 1, 2), ()]
    cases: dict[str, Case] = {
        f"{f.__name__} {a}": (functools.partial(f, axis=a), (x,)) for f in fs for a in axes
    }
    for k in range(3):
        for f in (jnp.argmax, jnp.argmin):
            cases[f"{f.__name__} {k}"] = (functools.partial(f, axis=k), (x,))
        for g in (lax.cumsum, lax.cumprod, lax.cummax, lax.cummin):
            for reverse in (False, True):
                h = functools.partial(g, axis=k, reverse=reverse)
                cases[f"{g.__name__} {k} {reverse}"] = (h, (x,))
        if dtype.kind == "f":
            cases[f"logsumexp {k}"] = (functools.partial(lax.cumlogsumexp, axis=k), (x,))
    compare(cases, ulps=32, absolute=16)


def test_reductions_of_truth_bits_and_nothing():
    x, i = normal(BOOL, 3, 4, 2), normal(I32, 3, 4, 2)
    none = np.zeros((3, 0, 2))
    cases: dict[str, Case] = {
        "truth": (lambda x: (x.any(0), x.all(1), x.any(), x.all()), (x,)),
        "bits": (lambda i: (lax.reduce_and(i, (0,)), lax.reduce_or(i, (1,)),
                            lax.reduce_xor(i, (0, 1))), (i,)),
        "nothing": (lambda x: (x.sum(0), x.prod(0), x.sum(), x * 2, jnp.concatenate([x, x]),
                               x.T @ x, x.max(1), (x > 0).any(0), (x > 0).all()), (none,)),
        "max of nothing": (lambda x: (lax.reduce_max(x, (0,)), lax.reduce_min(x, (0,))), (none,)),
        "nothing of integers": (lambda x: (lax.reduce_max(x, (0,)), lax.reduce_min(x, (0,))),
                                (none.astype(np.int32),)),
        "a reducer of one's own": (
            lambda x: lax.reduce(x, 1.0, lambda a, b: a * b + 0.0, (0,)), (normal(F64, 3, 4, 2),)),
        "of two arrays": (_first_greatest, (normal(F64, 3, 5), normal(I32, 3, 5))),
    }  # fmt: skip
    compare(cases, ulps=8)


def _first_greatest(x, i):
    def better(a, b):
        take = a[0] >= b[0]
        return jnp.where(take, a[0], b[0]), jnp.where(take, a[1], b[1])

    return lax.reduce((x, i), (-np.inf, np.int32(0)), better, (0,))


# ------------------------------------------------------------------- moving entries


def test_structure():
    x, y = normal(F64, 2, 3, 4), normal(F64, 2, 3, 4, seed=1)
    v = normal(F64, 2, 6)
    pad = lambda *config: lambda x: lax.pad(x, x[0, 0], config)  # noqa: E731
    cases: dict[str, Case] = {
        "slice": (lambda x: (x[1:, ::2], x[::-1, 3:0:-2], x[:, -1], x[2:2]), (x,)),
        "reshape": (lambda x: (x.T.reshape(2, 6), x.ravel(), x.reshape(1, 12, 1)), (x,)),
        "transpose": (lambda x: jnp.transpose(x.reshape(3, 2, 2), (2, 0, 1)), (x,)),
        "rev": (lambda x: lax.rev(x, (0, 1)), (x,)),
        "broadcast": (lambda x, v: x[:, :, None] + v, (x, v)),
        "concatenate": (lambda x, y: jnp.concatenate([x, y, x[:, :1]], 1), (x, y)),
        "stack": (lambda x, y: (jnp.stack([x, y], 1), jnp.stack([x[0], y[0]])), (x, y)),
        "split": (lambda x: tuple(jnp.split(x, [1, 3], 1)), (x,)),
        "unstack": (lambda x: tuple(jnp.unstack(x, axis=1)), (x,)),
        "pad": (all_of(pad((1, 2, 0), (0, 1, 2)), pad((-1, 0, 1), (-1, -2, 0)),
                       pad((-2, 3, 2), (1, -1, 1))), (x,)),
        "iota": (lambda x: x + jnp.arange(4) + lax.broadcasted_iota(F64, (3, 4), 0), (x,)),
        "roll": (lambda x: jnp.roll(x, (1, -1), (0, 1)), (x,)),
        "tile": (lambda x: jnp.tile(x, (2, 1)), (x,)),
        "same twice": (lambda x: (x, x, x[0], x), (x,)),
        "known": (lambda x: (jnp.eye(3), jnp.arange(3), x[0, 0]), (x,)),
        "into one result": (lambda x, v: jnp.concatenate([x.ravel(), v * 2, x[0], v]), (x, v)),
    }  # fmt: skip
    compare(cases)


# ------------------------------------------------------------------- indexing

INDICES = np.array([0, 1, 2, 3, 4, 5, 7, -1, -2, -9, 2**31 - 1, -(2**31)], np.int32)


@pytest.mark.parametrize("size", [5, 12], ids=["by selection", "in memory"])
@pytest.mark.parametrize(
    "index", mostly_slow((I32, np.dtype("u4")), (I64, np.dtype("u1"))), ids=str
)
def test_dynamic_slices(size, index):
    i = INDICES.astype(index)
    x, y = normal(F64, len(i), size), normal(F64, len(i), 2, seed=1)
    m = normal(F64, len(i), 3, size)

    def known(x, y):
        return lax.dynamic_slice(x, (7,), (2,)), lax.dynamic_update_slice(x, y, (-1,))

    cases: dict[str, Case] = {
        "slice": (lambda x, i: lax.dynamic_slice(x * 2, (i,), (2,)), (x, i)),
        "of operand": (lambda x, i: lax.dynamic_slice(x, (i,), (2,)), (x, i)),
        "update": (lambda x, y, i: lax.dynamic_update_slice(x * 2, y, (i,)), (x, y, i)),
        "update kept": (lambda x, y, i: (lax.dynamic_update_slice(x, y, (i,)), x + 1), (x, y, i)),
        "rows": (lambda m, i: lax.dynamic_slice(m, (i, i), (1, 3)), (m, i)),
        "rows update": (lambda m, y, i: lax.dynamic_update_slice(m, y[None], (i, i)), (m, y, i)),
        "known": (known, (x, y)),
        "index": (lambda x, i: (x[i], x.at[i].set(3.0), x.at[i].add(3.0, mode="drop")), (x, i)),
    }  # fmt: skip
    compare(cases)


MODES = [Mode.CLIP, Mode.FILL_OR_DROP]
GATHERS = {
    "rows": (Gather((1,), (0,), (0,)), (1, 4), (3, 1)),
    "windows": (Gather((1, 2), (), (0, 1)), (2, 3), (3, 2)),
    "entries": (Gather((), (0, 1), (0, 1)), (1, 1), (2, 3, 2)),
    "columns first": (Gather((0,), (1,), (1,)), (5, 1), (3, 1)),
    "axes exchanged": (Gather((0, 2), (), (1, 0)), (2, 1), (3, 2)),
    "batched": (Gather((), (1,), (1,), (0,), (0,)), (1, 1), (5, 1)),
}


@pytest.mark.parametrize("dtype", mostly_slow((F64,), (I32, BOOL)), ids=str)
def test_gather(dtype):
    """Indices beyond the operand, in every mode, known and not."""
    rng = np.random.default_rng(0)
    x = normal(dtype, 6, 5, 4)
    cases: dict[str, Case] = {}
    for name, (dims, sizes, shape) in GATHERS.items():
        i = rng.integers(-3, 8, (6, *shape)).astype(np.int32)
        for mode in MODES:
            f = functools.partial(lax.gather, dimension_numbers=dims, slice_sizes=sizes, mode=mode)
            cases[f"{name} {mode}"] = (f, (x, i))
            cases[f"{name} {mode} known"] = (functools.partial(f, start_indices=i[0]), (x,))
        filled = functools.partial(
            lax.gather, dimension_numbers=dims, slice_sizes=sizes, mode=mode, fill_value=1
        )
        cases[f"{name} filled"] = (filled, (x, i))
    compare(cases)


SCATTERS = {
    "rows": (Scatter((1,), (0,), (0,)), (3, 1), (3, 4)),
    "windows": (Scatter((1, 2), (), (0, 1)), (3, 2), (3, 2, 3)),
    "entries": (Scatter((), (0, 1), (0, 1)), (3, 2), (3,)),
    "columns first": (Scatter((0,), (1,), (1,)), (3, 1), (5, 3)),
    "batched": (Scatter((), (1,), (1,), (0,), (0,)), (5, 1), (5,)),
}
BY = {"set": lax.scatter, "add": lax.scatter_add, "mul": lax.scatter_mul, "min": lax.scatter_min,
      "max": lax.scatter_max, "sub": lax.scatter_sub}  # fmt: skip


@pytest.mark.parametrize("size", [(5, 4), (2, 3)], ids=["in memory", "by selection"])
@pytest.mark.parametrize("dtype", mostly_slow((F64,), (I32,)), ids=str)
def test_scatter(dtype, size):
    """Indices beyond the operand are left out, or clamped; equal ones combine in order."""
    rng = np.random.default_rng(0)
    x = normal(dtype, 6, *size)
    cases: dict[str, Case] = {}
    for name, (dims, shape, updates) in SCATTERS.items():
        if size == (2, 3) and name != "entries":
            continue
        i = rng.integers(-2, 7, (6, *shape)).astype(np.int32)
        u = normal(dtype, 6, *updates, seed=1)
        for by, f in BY.items():
            for mode in MODES:
                g = functools.partial(f, dimension_numbers=dims, mode=mode)
                cases[f"{name} {by} {mode}"] = (lambda x, i, u, g=g: g(x, i, u), (x, i, u))
        known = i[0]
        h = functools.partial(lax.scatter_add, dimension_numbers=dims, mode=mode)
        cases[f"{name} known"] = (lambda x, u, h=h, k=known: h(x, k, u), (x, u))
        cases[f"{name} of known"] = (lambda i, u, h=h, x=x: h(jnp.asarray(x[0]), i, u), (i, u))
        cases[f"{name} kept"] = (lambda x, i, u, h=h: (h(x * 2, i, u), x * 2), (x, i, u))
    compare(cases, ulps=8, absolute=8)


@host_alone
def test_many_entries_are_gathered_and_scattered_by_loops():
    x, i = normal(F64, 2, 200), np.random.default_rng(0).integers(-5, 205, (2, 5000))
    u = normal(F64, 2, 5000, seed=1)
    cases: dict[str, Case] = {
        "gather": (lambda x, i: x[i], (x, i)),
        "rows": (lambda x, i: x.reshape(20, 10)[i[:900] % 20], (x, i)),
        "scatter": (lambda x, i, u: x.at[i].add(u), (x, i, u)),
    }
    compare(cases, ulps=64, absolute=64)


# ------------------------------------------------------------------- order and chance


@pytest.mark.parametrize("n", [0, 1, 5, 20], ids=lambda n: f"{n} entries")
@pytest.mark.parametrize("dtype", mostly_slow((F64, I32), (F32, np.dtype("u1"), BOOL)), ids=str)
def test_sort(dtype, n):
    x, y = normal(dtype, 4, n, 2), normal(I32, 4, n, 2, seed=1) % 3
    if dtype.kind == "f" and n > 3:
        x[0, :4, 0], x[1, 1:4, 1] = (np.nan, -0.0, np.inf, 0.0), (np.nan, -np.inf, np.nan)
        x[2] = np.round(x[2])
    places = lambda x, axis: lax.broadcasted_iota(np.int32, x.shape, axis)  # noqa: E731
    cases: dict[str, Case] = {
        "one": (lambda x: (jnp.sort(x, 0), jnp.sort(x, 1), jnp.argsort(x, 0)), (x,)),
        "last key": (lambda x, y: lax.sort((y, x, places(x, 0)), dimension=0, num_keys=1), (x, y)),
        "two keys": (lambda x, y: lax.sort((y, x, places(x, 0)), dimension=0, num_keys=2), (x, y)),
        "kept": (lambda x: (jnp.sort(x * 2, 0), x * 2) if dtype != BOOL else x, (x,)),
    }
    compare(cases)


def test_places_in_a_sorted_array():
    x = np.array([[-np.inf, -1.5, -0.0, 0.0, 2.0, np.nan]])
    y = np.array([[-1.5, 0.0, -0.0, 1.0, np.nan, np.inf]])
    cases: dict[str, Case] = {
        side: (lambda x, y, side=side: jnp.searchsorted(x, y, side=side), (x, y))
        for side in ("left", "right")
    }
    compare(cases)


@pytest.mark.parametrize("n", [5, 20], ids=lambda n: f"{n} entries")
@pytest.mark.parametrize("dtype", mostly_slow((F64, I32), (F32, np.dtype("u4"))), ids=str)
def test_top_k(dtype, n):
    x = normal(dtype, 4, 3, n)
    x[1] = np.round(x[1]).astype(dtype)
    compare({"top": (lambda x: lax.top_k(x, 3), (x,)), "all": (lambda x: lax.top_k(x, n), (x,))})


def test_random_numbers_are_those_of_jax():
    seeds = np.arange(3, dtype=np.int64)
    data = np.random.default_rng(0).integers(0, 2**32, (3, 2), dtype=np.uint32)

    def noise(seed):
        key = jax.random.key(seed)
        a, b, c = jax.random.split(key, 3)
        return (
            jax.random.normal(a, (3,)),
            jax.random.uniform(b, (2, 2), jnp.float32, -1, 2),
            jax.random.bits(c, (3,), jnp.uint8),
            jax.random.key_data(jax.random.fold_in(a, 7)),
        )

    def drawn(data):
        key = jax.random.wrap_key_data(data)
        return (
            jax.random.randint(key, (3,), -5, 9),
            jax.random.bernoulli(key, 0.3, (4,)),
            jax.random.permutation(key, 5),
            jax.random.categorical(key, jnp.arange(3.0)),
            jax.random.gumbel(key, (2,)),
            jax.random.exponential(key),
            jax.random.bits(key),
        )

    def walk(data):
        """A key that a loop carries, and one that a branch chooses."""

        def step(key, x):
            key, now = jax.random.split(key)
            return key, x + jax.random.normal(now)

        key, ys = lax.scan(step, jax.random.wrap_key_data(data), jnp.arange(4.0))
        other = lax.cond(ys[0] > 0, lambda k: jax.random.fold_in(k, 1), lambda k: k, key)
        keys = jax.vmap(lambda i: jax.random.fold_in(other, i))(jnp.arange(3))
        return ys, jax.random.key_data(other), jax.vmap(jax.random.normal)(keys)

    def old(data):
        a, b = jax.random.split(data)
        return jax.random.normal(a, (2,)), jax.random.key_data(b)

    cases: dict[str, Case] = {"seed": (noise, (seeds,)), "draw": (drawn, (data,)),
                              "walk": (walk, (data,)), "raw": (old, (data,))}  # fmt: skip
    compare(cases, ulps=64)


# ------------------------------------------------------------------- products and factorisations


@pytest.mark.parametrize("dtype", mostly_slow((F64, I32), (F32,)), ids=str)
def test_products(dtype):
    a, b = normal(dtype, 2, 3, 4, 5), normal(dtype, 2, 4, 3, 5, seed=1)
    m, w = normal(dtype, 2, 12, 14), normal(dtype, 2, 14, 11, seed=2)
    x, y = normal(dtype, 2, 40, seed=3), normal(dtype, 2, 40, 26, seed=4)
    cases: dict[str, Case] = {
        "batched": (lambda a, b: jnp.einsum("ijk,jik->ij", a, b), (a, b)),
        "two axes": (lambda a, b: jnp.einsum("ijk,jlk->il", a, b), (a, b)),
        "outer": (lambda a, b: jnp.einsum("i,j->ij", a[0, 0], b[0, 0]), (a, b)),
        "dot": (lambda a, b: a[0, 0] @ b[0, 0], (a, b)),
        "looped": (lambda m, w: m @ w, (m, w)),
        "looped in tiles": (lambda m: m.T @ m, (m,)),
        "row times matrix": (lambda x, y: x @ y, (x, y)),
        "matrix times column": (lambda x, y: y.T @ x, (x, y)),
        "looped dot": (lambda y: y.ravel() @ y.T.ravel(), (y,)),
        "looped batch": (lambda a, b: jnp.einsum("ijk,jlm->jikm", a, b), (a, b)),
        "mixed": (lambda a, w: lax.dot_general(a[0], w[:5].astype(F64), (((1,), (0,)), ((), ())),
                                               preferred_element_type=F64), (a, w)),
    }  # fmt: skip
    compare(cases, ulps=64, absolute=64)


def definite(n: int, batch: int = 2) -> np.ndarray:
    x = normal(F64, batch, n, n)
    return x @ x.swapaxes(1, 2) + np.eye(n)


@pytest.mark.parametrize("n", mostly_slow((4,), (1, 11)), ids=lambda n: f"{n} rows")
def test_factorisations(n):
    a, x, y = definite(n), normal(F64, 2, n, n, seed=1), normal(F64, 2, n, 3, seed=2)
    tall = normal(F64, 2, n + 2, n, seed=3)
    cases: dict[str, Case] = {
        "cholesky": (jnp.linalg.cholesky, (a,)),
        "not definite": (jnp.linalg.cholesky, (-a,)),
        "lu": (lax.linalg.lu, (x,)),
        "lu tall": (lax.linalg.lu, (tall,)),
        "lu wide": (lambda t: lax.linalg.lu(t.T), (tall,)),
        "solve": (lambda x, y: (jnp.linalg.solve(x, y), jnp.linalg.solve(x.T, y[:, 0])), (x, y)),
        "inverse": (lambda x: (jnp.linalg.inv(x), jnp.linalg.det(x)), (x,)),
        "definite solve": (
            lambda a, y: jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(a), True), y), (a, y)),
        "qr": (lambda x: tuple(jnp.linalg.qr(x)), (tall,)),
        "qr full": (lambda x: tuple(jnp.linalg.qr(x, "complete")), (tall,)),
        "qr wide": (lambda x: tuple(jnp.linalg.qr(x.T)), (tall,)),
        "mapped": (lambda x, y: jnp.linalg.solve(jnp.stack([x, 2 * x]), jnp.stack([y, y])), (x, y)),
        "gradient": (jax.grad(lambda x, y: (jnp.linalg.solve(x, y) ** 2).sum()), (x, y)),
    }  # fmt: skip
    for options in itertools.product((True, False), repeat=4):
        left, lower, transpose, unit = options
        f = functools.partial(lax.linalg.triangular_solve, left_side=left, lower=lower,
                              transpose_a=transpose, unit_diagonal=unit)  # fmt: skip
        cases[f"triangular {options}"] = (f, (a, y if left else y.swapaxes(1, 2)))
    compare(cases, ulps=1e5, absolute=1e5)


def test_singular_and_single_precision_factorisations():
    x = np.array([[[1, 2], [2, 4]], [[0, 1], [1, 0]], [[0, 0], [0, 0]]], np.float64)
    a = definite(3).astype(F32)
    cases: dict[str, Case] = {
        "singular": (lambda x: lax.linalg.lu(x)[1:], (x,)),
        "permuted": (lambda x: jnp.linalg.solve(x, jnp.ones(2)), (x[1:2],)),
        "single": (lambda a: (jnp.linalg.cholesky(a), jnp.linalg.inv(a)), (a,)),
    }
    compare(cases, ulps=64, absolute=64)


def of_eigenvalues(a: jax.Array) -> tuple:
    """What the signs of eigenvectors do not change."""
    w, v = jnp.linalg.eigh(a)
    return w, (v * w) @ v.T, (v * jnp.tanh(w)) @ v.T, v.T @ v


def of_singular_values(a: jax.Array) -> tuple:
    u, s, vt = jnp.linalg.svd(a, full_matrices=False)
    whole = jnp.linalg.svd(a)
    bases = [x.T @ x for x in (whole[0], whole[2])]
    return s, jnp.linalg.svd(a, compute_uv=False), (u * s) @ vt, (u * jnp.tanh(s)) @ vt, *bases


def of_pivots(a: jax.Array) -> tuple:
    q, r, p = lax.linalg.qr(a, pivoting=True, full_matrices=False)
    back = jnp.zeros_like(a).at[:, p].set(q @ r)
    return p, jnp.abs(jnp.diagonal(r)), back, lax.linalg.qr(a, pivoting=True)[0].T[0] ** 2


@pytest.mark.parametrize("n", mostly_slow((2,), (1, 3, 9, 14)), ids=lambda n: f"{n} rows")
def test_spectra(n):
    """Eigenvalues and singular values of matrices full, short of rank, diagonal, zero, graded."""
    x, tall = normal(F64, 5, n, n, seed=1), normal(F64, 5, n + 2, n, seed=2)
    short = tall.copy()
    short[:, :, n // 2 :] = short[:, :, :1]  # equal columns
    x[1], short[1] = np.diag(np.arange(n) - 1.0), 0.0
    x[2], short[2] = 0.0, short[2] * 10.0 ** -np.arange(n)
    x[3] = np.eye(n)
    symmetric = x + x.swapaxes(1, 2)
    wide = short.swapaxes(1, 2)
    cases: dict[str, Case] = {
        "eigh": (of_eigenvalues, (symmetric,)),
        "upper": (lambda a: lax.linalg.eigh(a, lower=False, symmetrize_input=False)[1], (x,)),
        "svd": (of_singular_values, (x,)),
        "svd tall": (of_singular_values, (tall,)),
        "svd short of rank": (of_singular_values, (short,)),
        "svd wide": (of_singular_values, (wide,)),
        "qr with pivots": (of_pivots, (tall,)),
        "qr with pivots, wide": (of_pivots, (tall.swapaxes(1, 2),)),
        "nan": (lambda a: (jnp.linalg.eigvalsh(a), jnp.linalg.svd(a)[1]), (x * np.nan,)),
        "slope": (jax.grad(lambda a: jnp.tanh(jnp.linalg.eigvalsh(a)).sum()), (symmetric[4:],)),
        "pinv": (jnp.linalg.pinv, (tall,)),
    }
    compare(cases, ulps=1e5, absolute=1e3)
    single: dict[str, Case] = {
        "eigh": (of_eigenvalues, (symmetric.astype(F32),)),
        "svd": (of_singular_values, (short.astype(F32),)),
    }
    compare(single, ulps=1e3, absolute=1e3)


def test_spectra_of_many_rows():
    """Whose rotations are a loop."""
    x = normal(F64, 2, 9, 9)
    cases: dict[str, Case] = {
        "eigh": (jnp.linalg.eigvalsh, (x,)),
        "svd": (lambda a: jnp.linalg.svd(a[:7], compute_uv=False), (x,)),
    }
    compare(cases, ulps=1e3, absolute=1e2)


# ------------------------------------------------------------------- control


def carried(shape: tuple) -> Iterator[Case]:
    """Loops that keep and change arrays in place, whose old values may be read later."""
    x, i = normal(F64, 3, *shape), np.array([0, 2, 5], np.int32)

    def swap(x, i):  # two carries change places
        return lax.fori_loop(0, i, lambda k, c: (c[1] + 1, c[0].at[k].set(-1.0)), (x, x))

    def shared(x, i):  # two carries begin as one array
        a = jnp.zeros_like(x).at[i].set(x[0])
        turn = lambda k, c: (c[0].at[k].add(1.0), c[1].at[k].mul(2.0))  # noqa: E731
        return lax.fori_loop(0, 3, turn, (a, a))

    def spread(x, i):  # a carry that is one number everywhere
        turn = lambda k, c: c.at[k].add(x[k])  # noqa: E731
        return lax.fori_loop(0, 2, turn, jnp.broadcast_to(x[:1], x.shape))

    def read_too(x, i):  # a scan walks through the array that its carry begins as
        a = jnp.zeros_like(x).at[i].set(x[0])

        def step(c, row):
            return c.at[i].add(1.0).at[0].add(row.sum()), c[0]

        return lax.scan(step, a, a)

    def constant_too(x, i):  # a loop reads the array that its carry begins as
        a = jnp.zeros_like(x).at[i].set(x[0])
        return lax.fori_loop(0, i, lambda k, c: c.at[k].add(1.0) + a[k], a)

    def kept(x, i):  # the old array is read after the change
        def turn(k, c):
            new = c.at[k].set(c[k + 1] * 2)
            return new + c

        return lax.fori_loop(0, 2, turn, x), x

    def history(x, i):
        def step(c, row):
            new = c.at[i].add(row)
            return new, (c, new[0])

        return lax.scan(step, x, x, reverse=True)

    def branch(x, i):
        change = lambda c, k: c.at[k].set(0.0)  # noqa: E731
        turn = lambda k, c: lax.cond(k == i, change, lambda c, k: c, c, k)  # noqa: E731
        return lax.fori_loop(0, 4, turn, x), x

    for f in (swap, shared, spread, read_too, constant_too, kept, history, branch):
        yield f, (x, i)


def test_arrays_that_loops_change():
    cases = {f"{f.__name__} {shape}": (f, args) for shape in ((6,), (12,), (6, 60))
             for f, args in carried(shape)}  # fmt: skip
    compare(cases, ulps=64, absolute=64)


def test_control():
    x, n = normal(F64, 4, 3), np.array([0, 1, 2, 7], np.int32)
    flag = np.array([True, False, True, False])
    inc = lambda x: x + 1  # noqa: E731
    cases: dict[str, Case] = {
        "switch": (lambda x, n: lax.switch(n, [inc, jnp.sin, lambda x: x[::-1]], x), (x, n)),
        "cond": (lambda x, f: lax.cond(f, jnp.exp, lambda x: -x, x), (x, flag)),
        "known cond": (lambda x: lax.cond(True, inc, lambda x: -x, x), (x,)),
        "while": (lambda x, n: lax.while_loop(
            lambda c: c[0] < n, lambda c: (c[0] + 1, c[1] * 1.5, c[1]), (0, x, x)), (x, n)),
        "no turns": (lambda x: lax.scan(lambda c, y: (c + y, c), x[0], x[:0]), (x,)),
        "scan": (lambda x: lax.scan(lambda c, y: (c * y + 1, (c, y)), x[0], x, reverse=True), (x,)),
        "map": (lambda x: lax.map(lambda y: y**2, x), (x,)),
        "associative": (lambda x: lax.associative_scan(jnp.multiply, x), (x,)),
        "nested": (lambda x, n: lax.scan(lambda c, y: lax.scan(
            lambda d, z: (d + z * y, d), c, x), x[0], x), (x, n)),
        "remat": (jax.grad(jax.checkpoint(lambda x: jnp.sin(jnp.sin(x)).sum())), (x,)),
        "gradient of scan": (jax.grad(lambda x: lax.scan(
            lambda c, y: (c * jnp.sin(y), c), x[0], x)[0]), (x,)),
        "linear solve": (lambda x: lax.custom_linear_solve(
            lambda v: 2 * v, x, lambda _, b: b / 2, lambda _, b: b / 2), (x,)),
    }  # fmt: skip
    compare(cases, ulps=16)


def test_custom_derivatives_and_gradients():
    @jax.custom_jvp
    def f(x):
        return x**2

    f.defjvp(lambda xs, ts: (f(*xs), 3 * ts[0] * xs[0]))

    @jax.custom_vjp
    def g(x):
        return x**3

    g.defvjp(lambda x: (x**3, x), lambda x, ct: (5 * x * ct,))
    x = normal(F64, 3)
    compare({"both": (lambda x: (f(x), g(x), jax.grad(f)(x), jax.grad(g)(x)), (x,))})


# ------------------------------------------------------------------- size


@host_alone
def test_large_arrays_are_worked_through_by_loops():
    x, data = normal(F64, 2, 60, 40), np.arange(4, dtype=np.uint32).reshape(2, 2)
    x[1, 3, 4] = np.nan
    cases: dict[str, Case] = {
        "arg": (lambda x: (x.argmax(0), x.argmin(1), x.ravel().argmax()), (x,)),
        "sums": (lambda x: (x.cumsum(0), lax.cummax(x, axis=1, reverse=True),
                            lax.cumsum(x, axis=0, reverse=True)), (x,)),
        "reductions": (lambda x: (x.sum(0), x.max(1), x.prod(), x.min()),  # XLA loses the nan
                       (np.nan_to_num(x),)),
        "sincos": (lambda x: tuple(sincos(x)), (x,)),
        "random": (lambda data: (jax.random.bits(data, (700,)),
                                 jax.random.uniform(data, (25, 30), jnp.float64)), (data,)),
        "entries": (lambda x: jnp.where(x > 0, jnp.clip(x, -0.5, 0.7), x.sum()), (x,)),
        "sort": (lambda x: (jnp.sort(x, 0), lax.top_k(x, 4)[1]), (x[:1],)),
    }  # fmt: skip
    for name, (f, args) in cases.items():
        assert written(f, *args)[0].statements < 700, name
    compare(cases, ulps=512, absolute=512)


def mlp(x, w0, b0, w1, b1, w2, b2):
    x = jnp.tanh(w0 @ x + b0)
    x = jnp.tanh(w1 @ x + b1)
    return w2 @ x + b2


def test_a_network_is_a_few_hundred_statements():
    sizes = (20, 128, 128, 6)
    x, args = normal(F32, 2, 20), []
    for k, (n, m) in enumerate(itertools.pairwise(sizes)):
        args += [normal(F32, 2, m, n, seed=2 * k) / np.float32(n**0.5), normal(F32, 2, m, seed=k)]
    program, _, _ = written(mlp, x, *args)
    assert program.statements < 1000
    compare({"network": (mlp, (x, *args))}, ulps=64, absolute=64)


@host_alone
def test_what_is_not_known_is_named():
    with pytest.raises(Unsupported, match="complex64"):
        on_host(lambda x: jnp.abs(x.astype(jnp.complex64)), normal(F32, 2))
    with pytest.raises(Unsupported, match="callback"):
        on_host(lambda x: jax.pure_callback(np.sin, x, x), normal(F32, 2))
    with pytest.raises(Unsupported, match="debug_print"):
        on_host(lambda x: (jax.debug.print("{}", x), x)[1], normal(F32, 2))
