"""Samples as lanes of vectors: programs against XLA, layouts, sums, and functions of
mathematics."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.special
from jax import lax

from rbjax.compiler.ir.program import BatchLayout
from rbjax.compiler.ir.statements import Loop, Reserve, walk
from rbjax.compiler.llvm.batch import write_parts
from rbjax.compiler.lower.write import write_program
from rbjax.compiler.passes.analysis import find_divergence
from tests.compiler import random_programs
from tests.compiler.host import by_vectors, by_xla, part_function, written
from tests.compiler.test_algorithms import PARTS, agree, of_a_sample
from tests.compiler.test_algorithms import by_xla as one_by_xla
from tests.tolerances import F64_TRANSFORM, relative_error

# ------------------------------------------------------------------- programs


def differences(seeds: range, samples: int, lanes: int) -> list[str]:
    cases = [
        (random_programs.program(seed), random_programs.arguments(seed, samples)) for seed in seeds
    ]
    wrong = []
    found = by_vectors(cases, lanes, samples)
    for seed, gs, ws in zip(seeds, found, by_xla(cases), strict=True):
        for k, (g, w) in enumerate(zip(gs, ws, strict=True)):
            if not np.allclose(g, w, rtol=1e-8, atol=1e-8, equal_nan=True):
                wrong.append(f"program {seed}, result {k}: {np.abs(g - w).max()}")
    return wrong


@pytest.mark.parametrize(("samples", "lanes"), [(5, 4), (11, 8)])
def test_random_programs(samples, lanes):
    seeds = range(100 * lanes, 100 * lanes + 6)
    assert not (wrong := differences(seeds, samples, lanes)), wrong


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 600, 20))
def test_hundreds_of_random_programs(first):
    samples, lanes = [(5, 4), (11, 8), (3, 2), (16, 16)][first // 20 % 4]
    assert not (wrong := differences(range(first, first + 20), samples, lanes)), wrong


@pytest.mark.parametrize(("on", "names"), [
    PARTS[0], *(pytest.param(*p.values, marks=pytest.mark.slow) for p in PARTS[1:])
])  # fmt: skip
def test_algorithms(on, names):
    cases = [of_a_sample(name, on) for name in names]
    for (f, args), got in zip(cases, by_vectors(cases, 4), strict=True):
        agree([x[: len(args[0])] for x in got], one_by_xla(f, args))


# ------------------------------------------------------------------- layouts


def placed(x: np.ndarray, n: int, axes: tuple) -> tuple[np.ndarray, BatchLayout]:
    """An array with the batch first (n axes), its axes moved to these places; None keeps the first
    sample of an axis."""
    for k, axis in enumerate(axes):
        x = x.take([0], k) if axis is None else x
    x = x.squeeze(tuple(k for k, axis in enumerate(axes) if axis is None))
    there = [axis for axis in axes if axis is not None]
    x = np.ascontiguousarray(np.moveaxis(x, range(len(there)), there))
    return x, BatchLayout(x.shape, axes)


def of_samples(f, batch, operands, axes, outs, lanes, summed=()):
    """f of each sample by vectors, and by XLA, batch first. outs: places of the results' axes."""
    n = len(batch)
    one = [jax.ShapeDtypeStruct(x.shape[n:], x.dtype) for x in operands]
    closed = jax.make_jaxpr(f)(*one)
    given = [placed(x, n, a) for x, a in zip(operands, axes, strict=True)]
    results = []
    for k, aval in enumerate(closed.out_avals):
        shape = list(aval.shape)
        if not (summed and summed[k]):
            for axis, size in sorted(zip(outs[k], batch, strict=True)):
                shape.insert(axis, size)
        results.append(BatchLayout(tuple(shape), () if summed and summed[k] else outs[k]))
    program = write_program(closed, batch, [lay for _, lay in given], results, summed)
    made = write_parts(program, lanes)
    found = [
        np.full((made.count, *lay.shape) if summed and summed[k] else lay.shape, 77, a.dtype)
        for k, (lay, a) in enumerate(zip(results, closed.out_avals, strict=True))
    ]
    part_function(made)[0]([*(x for x, _ in given), *found])
    got = [
        y.sum(0) if summed and summed[k] else np.moveaxis(y, outs[k], range(n))
        for k, y in enumerate(found)
    ]
    run, wants = jax.jit(f), []
    for index in np.ndindex(*batch):
        here = [tuple(0 if a is None else i for i, a in zip(index, ax, strict=True)) for ax in axes]
        wants.append(run(*(x[i] for x, i in zip(operands, here, strict=True))))
    want = [np.stack(ys).reshape(*batch, *ys[0].shape) for ys in zip(*wants, strict=True)]
    if summed:
        want = [y.sum(tuple(range(n))) if s else y for y, s in zip(want, summed, strict=True)]
    for g, w in zip(got, want, strict=True):
        assert g.dtype == w.dtype and g.shape == w.shape
        assert relative_error(g.astype(float), w.astype(float)) <= F64_TRANSFORM
    return program


def mixture(x, w, i):
    """Reads and writes at indices that are the same in every lane, and at others."""

    def turn(k, c):
        return c.at[k].add(w[k] * x[0, 1]).at[i[0]].mul(0.5 + w[i[1]])

    y = lax.fori_loop(0, 4, turn, x[1])
    z = jnp.where(y > 0, jnp.sin(y), w[i[0]])
    return z, (y > w[0]), x.T @ y[:3], i + 1


def drawn(batch: tuple[int, ...]) -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    return [rng.normal(size=(*batch, 3, 4)), rng.normal(size=(*batch, 4)),
            rng.integers(0, 4, (*batch, 2)).astype(np.int32)]  # fmt: skip


@pytest.mark.parametrize(("batch", "axes", "outs"), [
    ((11,), [(2,), (None,), (0,)], [(0,), (1,), (0,), (1,)]),
    ((3, 7), [(0, 1), (None, 1), (0, 2)], [(0, 1), (1, 2), (0, 2), (2, 0)]),
    ((3, 8), [(1, 3), (0, None), (None, 1)], [(1, 0), (0, 1), (1, 2), (0, 1)]),
    pytest.param((5, 1, 2), [(2, 0, 1), (0, None, None), (0, 2, 1)], [(0, 1, 2)] * 4,
                 marks=pytest.mark.slow),
    pytest.param((2, 3, 4), [(0, 2, 4), (None, None, 1), (3, 1, 0)], [(0, 1, 3), (2, 1, 0)] * 2,
                 marks=pytest.mark.slow),
    pytest.param((9,), [(0,), (0,), (1,)], [(1,), (0,), (1,), (0,)], marks=pytest.mark.slow),
], ids=lambda x: str(x) if isinstance(x, tuple) else "")  # fmt: skip
def test_layouts(batch, axes, outs):
    of_samples(mixture, batch, drawn(batch), axes, outs, 4)


@pytest.mark.parametrize("size", [4, 7, 300])
def test_sums_over_the_batch(size):
    """Whose parts each have a row; samples that run twice count once."""
    x, w, i = drawn((size,))
    x, w, i = np.round(4 * x) / 4, np.round(4 * w), i

    def f(x, w, i):
        def turn(k, c):
            return c.at[k % 4].add(x[1] * w[i[0]] * k)

        heavy = lax.fori_loop(0, 2500, lambda k, c: c * 0.999 + 0.1, x[0, 0])
        return lax.fori_loop(0, 6, turn, jnp.zeros((4, 4))), heavy, i

    axes = [(0,), (None,), (0,)]
    program = of_samples(f, (size,), [x, w, i], axes, [(0,)] * 3, 4, (True, False, True))
    assert size < 300 or write_parts(program, 4).count > 1


# ------------------------------------------------------------------- what differs


def test_what_all_lanes_share_is_scalar():
    def f(x, n):
        def turn(k, c):
            return c.at[k].set(jnp.sin(c[k] * k)), jnp.arange(6.0) * k

        table = lax.fori_loop(0, 6, lambda k, c: c.at[k].set(k * 0.5), jnp.zeros(6))
        mine = lax.fori_loop(0, 6, lambda k, c: c.at[k].add(x * table[k]), jnp.zeros(6))
        other = lax.while_loop(lambda c: c[0] < n, lambda c: (c[0] + 1, c[1].at[c[0]].add(1.0)),
                               (0, jnp.zeros(6)))  # fmt: skip
        return mine.sum() + other[1][2], table

    x, n = np.arange(5.0), np.array([0, 3, 6, 2, 5])
    program, _, _ = written(f, x, n)
    found = find_divergence(program.builder.block, [*program.operands, *program.results])
    local = [s.array for s in walk(program.builder.block) if isinstance(s, Reserve)]
    assert [found.of(a) for a in local] == [False, True, True]
    for loop in walk(program.builder.block):
        assert not isinstance(loop, Loop) or not found.of(loop.counter)
    (got,), want = by_vectors([(f, (x, n))], 4), jax.jit(jax.vmap(f))(x, n)
    agree(got, want)


def test_counters_of_loops_are_scalar():
    """Each lane runs its own number of turns. A counter that is read after its loop, or that goes
    on in the next turn of an outer loop, differs between lanes."""

    def own(x, n):  # n turns, of which the last ones are those of few lanes
        return lax.fori_loop(0, n, lambda k, c: c.at[k].add(x * k), jnp.zeros(9)), 0.0

    def nested(x, n):  # the inner loop begins anew in each turn
        def turn(k, c):
            inner = lambda j, c: c.at[j].add(x + k)  # noqa: E731
            return lax.fori_loop(0, (n + k) % 5, inner, c)

        return lax.fori_loop(0, n, turn, jnp.zeros(9)), 0.0

    def read(x, n):
        goes, turn = lambda c: c[0] < n, lambda c: (c[0] + 2, c[1].at[c[0]].add(x))
        k, c = lax.while_loop(goes, turn, (0, jnp.zeros(9)))
        return c, k * x

    def goes_on(x, n):  # an inner loop that adds to a counter of the outer one
        def turn(k, c):
            goes = lambda c: (c[0] < n) & (c[0] < 3 * k)  # noqa: E731
            return lax.while_loop(goes, lambda c: (c[0] + 1, c[1].at[c[0]].add(x * k)), c)

        return lax.fori_loop(0, n, turn, (0, jnp.zeros(9)))[1], 0.0

    n = np.array([0, 3, 8, 1, 5, 8, 2])
    x = np.random.default_rng(0).normal(size=len(n))
    for f, scalars in ((own, 1), (nested, 2), (read, 0), (goes_on, 1)):
        program, _, _ = written(f, x, n)
        found = find_divergence(program.builder.block, [*program.operands, *program.results])
        assert len(found.counters) == scalars and not found.counters & found.different
        for lanes in (4, 8):
            (got,), want = by_vectors([(f, (x, n))], lanes), jax.jit(jax.vmap(f))(x, n)
            agree(got, want)


def test_lanes_part_and_meet():
    """Loops and branches whose conditions differ, nested, with arrays that outlive them."""

    def f(x, n, flag):
        def inner(c):
            k, y, a = c
            a = lax.cond(y[k % 3] > x[1], lambda a: a.at[k % 4].add(y[0]), lambda a: a * 0.9, a)
            y = lax.fori_loop(0, k % 3, lambda j, y: y.at[j].mul(0.7), y)
            return k + 1, y, a

        k, y, a = lax.while_loop(lambda c: c[0] < n, inner, (0, x, jnp.zeros(4)))
        b = lax.cond(flag, lambda: lax.switch(k, [lambda: y, lambda: y * 2, lambda: x], ),
                     lambda: x // jnp.where(k == 0, 1.0, k))  # fmt: skip
        safe = lax.cond(n > 2, lambda: 100 // n, lambda: -n)
        return a, b, k, a[(n * 3) % 4], safe

    rng = np.random.default_rng(0)
    args = rng.normal(size=(13, 3)), rng.integers(0, 8, 13), rng.random(13) > 0.5
    for lanes in (2, 8):
        (got,), want = by_vectors([(f, args)], lanes), jax.jit(jax.vmap(f))(*args)
        agree(got, want)


def test_few_samples_are_scalar():
    program, _, _ = written(lambda x: x * 2, np.arange(3.0))
    assert "<4 x double>" not in write_parts(program, 4).text
    assert "<2 x double>" in write_parts(program, 2).text
    assert "double>" in write_parts(written(lambda x: x * 2, np.arange(64.0))[0]).text


# ------------------------------------------------------------------- mathematics

#: units in the last place from the true value in f64, of what the formulas find
ULPS = {
    "sin": 0.8, "cos": 0.8, "tan": 2, "exp": 1, "exp2": 1, "expm1": 1.4, "log": 0.8, "log1p": 1.5,
    "tanh": 2.3, "sinh": 2.1, "cosh": 1.3, "atan": 0.9, "asin": 1.7, "acos": 1.7, "atanh": 2,
    "asinh": 1.9, "acosh": 2.3, "cbrt": 0.9, "erf": 1.5, "erfc": 3.2,
}  # fmt: skip
#: the same in f32: the formulas are in f64; C's library beyond them
SINGLE = 0.6
PRIMITIVES = {name: getattr(lax, f"{name}_p") for name in ULPS}
EDGES = np.array([0.0, -0.0, 1, -1, np.inf, -np.inf, np.nan, 2, -2, 1e-310, -1e-310, 1e308, -1e308,
                  5e-324, 0.5, -0.5])  # fmt: skip
NUMPY = {"atan": "arctan", "asin": "arcsin", "acos": "arccos", "atanh": "arctanh",
         "asinh": "arcsinh", "acosh": "arccosh"}  # fmt: skip


def numbers(name: str, count: int) -> np.ndarray:
    """Arguments of every size, near where a function is small, and where its formulas change."""
    rng = np.random.default_rng(0)
    sizes = rng.choice([-1, 1], count) * 10.0 ** rng.uniform(-300, 15, count)
    near = np.concatenate([rng.uniform(-1, 1, count), rng.uniform(-100, 100, count)])
    one = 1 - 10.0 ** rng.uniform(-16, 0, count)
    quarters = np.pi / 2 * np.concatenate([np.arange(1, count), np.arange(1, count) * 1571])
    x = np.concatenate([sizes, near, one, rng.uniform(-745, 709, count), quarters])
    match name:
        case "asin" | "acos" | "atanh":
            return x[abs(x) <= 1]
        case "log":
            return abs(x)
        case "log1p":
            return x[x > -1]
        case "acosh":
            return 1 + abs(x)
    return x


def worst(name: str, x: np.ndarray, got: np.ndarray) -> float:
    """The largest error in units in the last place, of results that are normal numbers."""
    f = (lambda x: mpmath.mpf(2) ** x) if name == "exp2" else getattr(mpmath, name)
    limits, most = np.finfo(x.dtype), 0.0
    with mpmath.workprec(200):
        for a, y in zip(x, got, strict=True):
            want = f(mpmath.mpf(float(a)))
            if isinstance(want, mpmath.mpf) and limits.tiny < abs(want) < limits.max:
                unit = mpmath.mpf(float(np.spacing(x.dtype.type(abs(float(want))))))
                most = max(most, float(abs(mpmath.mpf(float(y)) - want) / unit))
    return most


@pytest.mark.parametrize("count", [40, pytest.param(4000, marks=pytest.mark.slow)])
def test_mathematics(count):
    for name, ulps in ULPS.items():
        x = numbers(name, count)
        single = x.astype(np.float32)
        single = single[np.isfinite(single) & (abs(single) > 0)]
        f = PRIMITIVES[name].bind if name != "exp2" else jnp.exp2
        found = by_vectors([(f, (x,)), (f, (single,))], 8)
        assert worst(name, x, found[0]) <= ulps, name
        assert worst(name, single[::3], found[1][::3]) <= SINGLE, name
        (got,) = by_vectors([(f, (EDGES,))], 8)
        with np.errstate(all="ignore"):
            functions = scipy.special if name.startswith("erf") else np
            want = getattr(functions, NUMPY.get(name, name))(EDGES)
        np.testing.assert_allclose(got, want, rtol=1e-14, err_msg=name)
        assert (np.signbit(got) == np.signbit(want))[~np.isnan(want)].all(), name


def test_arctangents_of_two():
    y, x = (a.ravel() for a in np.meshgrid(EDGES, EDGES))
    rng = np.random.default_rng(1)
    ys, xs = rng.normal(size=(2, 300)) * 10.0 ** rng.uniform(-300, 308, (2, 300))
    y, x = np.concatenate([y, ys, rng.normal(size=300)]), np.concatenate([x, xs, ys])
    (got,) = by_vectors([(jnp.arctan2, (y, x))], 8)
    want = np.arctan2(y, x)
    np.testing.assert_allclose(got, want, rtol=1e-15 / 2)  # each within 1.1 and 1 of its last place
    assert (np.signbit(got) == np.signbit(want))[~np.isnan(want)].all()


@pytest.mark.parametrize("count", [60, pytest.param(4000, marks=pytest.mark.slow)])
def test_powers(count):
    """Of numbers of every size and near 1, to exponents that bring results near both limits."""
    rng = np.random.default_rng(2)
    near = 1 + rng.normal(size=count) * 10.0 ** rng.uniform(-12, -1, count)
    x = np.concatenate([10.0 ** rng.uniform(-307, 308, count), near])
    y = rng.uniform(-745, 709, x.size) / np.log(x)
    y[::4] = rng.normal(size=y[::4].size) * 3
    edges = [a.ravel() for a in np.meshgrid([*EDGES, 3.0, -3.0, 0.3], [*EDGES, 3.0, -3.0, 0.3])]
    few = [np.clip(a[:40], 1e-30, 1e30).astype("f4") for a in (x, y)]
    cases = [(lax.pow, (x, y)), (lax.pow, few), (lax.pow, edges)]
    got, single, at_edges = by_vectors(cases, 8)
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(at_edges, np.power(*edges), rtol=1e-15)
        assert (np.signbit(at_edges) == np.signbit(np.power(*edges)))[~np.isnan(at_edges)].all()
        np.testing.assert_allclose(single, np.power(*few), 2e-7)
    with mpmath.workprec(200):
        for a, b, z in zip(x, y, got, strict=True):
            want = mpmath.power(float(a), float(b))
            if np.finfo(float).tiny < want < np.finfo(float).max:
                assert abs(mpmath.mpf(float(z)) - want) <= 0.85 * np.spacing(float(want))


def test_functions_without_a_formula_are_c_s():
    x = np.linspace(0.1, 3, 9)
    (got,) = by_vectors([(lax.lgamma, (x,))], 8)
    np.testing.assert_allclose(got, [math.lgamma(float(a)) for a in x], rtol=1e-14, atol=1e-15)
