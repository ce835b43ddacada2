"""What is lowered for CUDA, without a GPU: custom calls, kernels' sources, and PTX on disk."""

from __future__ import annotations

import math
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import rbjax as rb
from rbjax.compiler.cuda import driver, nvrtc, stores
from rbjax.compiler.cuda import kernels as cuda
from rbjax.compiler.cuda.c_source import Printer
from rbjax.compiler.cuda.kernels import Kernel, kernel
from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.program import BatchLayout, Written, batch_first
from rbjax.compiler.jax import launch
from rbjax.compiler.jax.function import compile_threads
from rbjax.compiler.lower.write import write_program
from tests.compiler.block import emulated
from tests.compiler.host import COMPILER, many_on_host, written
from tests.compiler.lowering import lowered
from tests.tolerances import F64_TRANSFORM, relative_error

RNG = np.random.default_rng(0)
W, X = RNG.normal(size=(5, 3)), RNG.normal(size=(200, 3))


def f(x, w=W):
    return jnp.tanh(w @ x)


# ------------------------------------------------------------------- lowering


@pytest.fixture
def gpu(gpu, monkeypatch):
    """The same with a stand-in for NVRTC."""
    monkeypatch.setattr(launch, "ptx", lambda source, capability: "PTX")


def calls(g, *args) -> int:
    return lowered(g, *args).count(launch.GPU_KERNEL)


def total(x, w):
    return (jax.vmap(compile_threads(f), (0, None))(x, w) ** 2).sum()


@pytest.mark.parametrize(
    ("g", "args", "count"),
    [
        (jax.vmap(compile_threads(f)), (X,), 1),
        (jax.vmap(jax.grad(lambda x: compile_threads(f)(x).sum())), (X,), 1),
        (jax.vmap(jax.jacfwd(compile_threads(f))), (X,), 1),
        (jax.grad(total, (0, 1)), (X, W), 2),
        (jax.vmap(compile_threads(jax.grad(lambda x: f(x).sum()))), (X,), 1),
        (jax.vmap(compile_threads(lambda x: compile_threads(f)(x).sum())), (X,), 1),
        (jax.vmap(compile_threads(f)), (X[:0],), 0),
    ],
    ids=["values", "grad", "jacfwd", "grad of a sum", "grad inside", "threads inside", "empty"],
)  # fmt: skip
def test_a_kernel_a_derivative(gpu, g, args, count):
    assert calls(g, *args) == count


def test_what_is_closed_over_may_lie_on_a_mesh(gpu):
    """JAX then moves arrays to the mesh."""
    where = NamedSharding(Mesh(np.array(jax.devices()[:1]), ("a",)), PartitionSpec())
    model, x = rb.load("cart_pole"), jnp.asarray(X[:, :2])
    s, mass = jax.device_put((jnp.float64(2.0), model.bodies.mass), where)

    def rolled(mass, x):
        heavier = model.replace(bodies=model.bodies.replace(mass=mass))
        return rb.rollout(heavier, rb.State(x, x), steps=2, kernel=True).q.sum()

    def scaled(s, x):
        return jax.vmap(compile_threads(lambda x: jax.lax.scan(
            lambda c, _: (s * c + c.sum(), None), x, None, 3)[0]))(x).sum()  # fmt: skip

    assert calls(jax.grad(rolled, (0, 1)), mass, x) == 2
    assert calls(jax.grad(scaled, (0, 1)), s, x) == 1


def test_integers_and_their_derivatives(gpu):
    def g(x, n):
        return x[n] * n, n + 1, x.sum()

    def back(x, n):
        found = jax.vmap(compile_threads(g))(x, n)
        return (found[0] ** 2).sum()

    n = np.arange(200, dtype=np.int32) % 3
    assert calls(jax.vmap(compile_threads(g)), X, n) == 1
    assert calls(jax.grad(back), X, n) == 2
    h = jax.vmap(compile_threads(g))
    assert calls(lambda x: jax.jvp(lambda x: h(x, n)[0], (x,), (x,))[1], X) > 0


@pytest.mark.parametrize("name", ["igamma", "tridiagonal_solve", "complex64"])
def test_what_no_thread_knows_is_said_once(gpu, name):
    def g(x):
        if name == "complex64":
            return jnp.abs(jnp.fft.fft(x))
        if name == "igamma":
            return jax.scipy.special.gammainc(1 + x * x, x * x)
        return jax.lax.linalg.tridiagonal_solve(x, 4 + x * x, x, x[:, None])

    x = X.astype(np.float32)
    with pytest.warns(UserWarning, match=f"no kernel for .*{name}"):
        text = lowered(jax.vmap(compile_threads(g)), x)
    assert launch.GPU_KERNEL not in text
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lowered(jax.vmap(compile_threads(lambda x: g(-x))), x)


def test_without_kernels_xla(monkeypatch):
    monkeypatch.setattr(launch, "kernels_work", lambda: False)
    assert calls(jax.vmap(compile_threads(f)), X) == 0


def test_where_kernels_fail_it_is_said(monkeypatch):
    def missing():
        raise nvrtc.CompileError("found no libnvrtc")

    monkeypatch.setattr(nvrtc, "library", missing)
    monkeypatch.setattr(launch, "capability", lambda: "9.0")
    monkeypatch.setattr(launch, "oldest_gpu", lambda: jax.local_devices()[0])
    monkeypatch.setattr(launch, "launch_kernel", lambda *_: launch.ptx(launch.SELF_TEST, "9.0"))
    nvrtc.version.cache_clear()
    launch.kernels_work.cache_clear()
    try:
        with pytest.warns(UserWarning, match=r"found no libnvrtc.*rbjax\[cuda\]"):
            assert not launch.kernels_work()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert not launch.kernels_work()
    finally:
        launch.kernels_work.cache_clear()


def test_a_rollout_is_one_kernel(gpu):
    model = rb.load("cart_pole")
    state = rb.State(jnp.zeros((8, 2)), jnp.ones((8, 2)))

    def last(us):
        return rb.rollout(model, state, us, 0.01, kernel=True).q

    us = jnp.zeros((4, 1))
    assert calls(last, us) == 1
    assert calls(jax.grad(lambda us: (last(us) ** 2).sum()), us) == 2


# ------------------------------------------------------------------- PTX on disk


def test_ptx_is_kept_beside_jax_s_cache(monkeypatch, tmp_path):
    compiled = []
    monkeypatch.setattr(nvrtc, "_compile", lambda source, arch: compiled.append(arch) or source[:3])
    monkeypatch.setattr(nvrtc, "version", lambda: "12.9")
    before = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path))
        assert [nvrtc.ptx("source", "9.0") for _ in range(2)] == ["sou", "sou"]
        assert compiled == ["compute_90"]
        nvrtc.ptx("source", "8.6")
        nvrtc.ptx("another", "9.0")
        assert compiled == ["compute_90", "compute_86", "compute_90"]
        kept = list((tmp_path / "rbjax-threads").iterdir())
        assert len(kept) == 3 and all(p.suffix == ".ptx" for p in kept)
        jax.config.update("jax_compilation_cache_dir", None)
        nvrtc.ptx("source", "9.0")
        assert len(compiled) == 4
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.parametrize("version", ["12.9", "13.0"])
def test_kernels_compiled_quickly(version, monkeypatch):
    monkeypatch.setattr(nvrtc, "version", lambda: version)
    new = version == "13.0"
    with nvrtc.fast_compile():
        assert (nvrtc.options() != nvrtc.OPTIONS) == new
        with nvrtc.fast_compile(False):
            assert nvrtc.options() == nvrtc.OPTIONS
    assert nvrtc.options() == nvrtc.OPTIONS


class Driver:
    """What stands for libcuda: each call succeeds, but for those of `fails`."""

    def __init__(self, fails=""):
        self.calls, self.fails = [], fails

    def __getattr__(self, name):
        return lambda *args: self.calls.append(name) or int(name == self.fails)


@pytest.mark.parametrize("fails", ["", "cuCtxSetCurrent", "cuModuleLoadData"])
def test_the_driver_compiles_long_ptx_once_beside_other_work(fails, monkeypatch):
    libcuda = Driver(fails)
    monkeypatch.setattr(driver, "_driver", lambda: libcuda)
    monkeypatch.setattr(driver, "_compiled", set())
    monkeypatch.delenv("CUDA_CACHE_DISABLE", raising=False)
    long = "x" * driver.LONG
    assert driver.compile_ahead("short", lambda: 0) is None
    driver.compile_ahead(long, lambda: 0).join()
    assert driver.compile_ahead(long, lambda: 0) is None
    assert ("cuModuleLoadData" in libcuda.calls) == (fails != "cuCtxSetCurrent")
    assert ("cuModuleUnload" in libcuda.calls) == (not fails)
    assert libcuda.calls[-1] == "cuDevicePrimaryCtxRelease"
    monkeypatch.setenv("CUDA_CACHE_DISABLE", "1")  # what it compiles would be lost
    assert driver.compile_ahead(2 * long, lambda: 0) is None


# ------------------------------------------------------------------- sources


def emitted(g, layouts, batch, summed=(), last=False) -> tuple[Kernel, list]:
    """The kernel of g, its operands as layouts, its results batch first, last, or summed."""
    closed = jax.make_jaxpr(g)(*(jax.ShapeDtypeStruct(x.sample, np.float64) for x in layouts))
    avals = closed.out_avals
    summed = tuple(summed) or (False,) * len(avals)
    n = len(batch)
    outs = []
    for a, s in zip(avals, summed, strict=True):
        places = tuple(range(a.ndim, a.ndim + n) if last else range(n))
        shape = (*a.shape, *batch) if last else (*batch, *a.shape)
        outs.append(BatchLayout(a.shape, ()) if s else BatchLayout(shape, places))
    code = kernel(write_program(closed, batch, layouts, outs, summed))
    return code, [jax.ShapeDtypeStruct(lay.shape, a.dtype)
                  for lay, a in zip(outs, avals, strict=True)]  # fmt: skip


def test_rows_are_staged_where_they_are_neither_short_nor_long_and_are_read():
    def g(x, y, z, w, unread):
        return [x.sum() + z.sum() + y * w, 2 * y]

    shared = BatchLayout((20,), (None,))
    layouts = [*(BatchLayout((200, n), (0,)) for n in (8, 20, 129)), shared]
    layouts.append(BatchLayout((200, 30), (0,)))
    source = emitted(g, layouts, (200,))[0].source
    assert re.findall(r"load_rows<double,(\d+),(\d+)>", source) == [("20", "21")]
    assert source.count("__shared__ double all_s1[") == 1
    assert re.findall(r"store_rows<double,(\d+),(\d+)>\(v[01]", source) == [("20", "21")] * 2
    assert source.count("__shared__ uint4") == 1  # one tile for both results
    batch_last = [*(BatchLayout((n, 200), (1,)) for n in (8, 20, 129)), shared]
    batch_last.append(BatchLayout((30, 200), (1,)))
    source = emitted(g, batch_last, (200,), last=True)[0].source
    assert not re.search(r"(fetch|leave|flush)<double", source)


@pytest.mark.parametrize(("in_turn", "read"), [(False, False), (True, False), (False, True)])
def test_only_what_is_written_at_once_leaves_through_the_tile(in_turn, read):
    """Two results share a warp's tile: entries in turn, or one that is read again, would meet."""
    b = Builder()
    both = [b.external_array(np.float32, 3, "result") for _ in range(2)]
    places = [(array, k) for array in both for k in range(3)]
    for array, k in sorted(places, key=lambda x: x[1]) if in_turn else places:
        b.store(array, None, k, np.float32(k))
    if read:
        for array in both:
            b.load(array, None, 0)
    layout = BatchLayout((64, 3), (0,))
    program = Written(b, (), tuple(both), ((), (layout, layout)), (64,), (False, False))
    assert ("uint4 tiles[" in kernel(program).source) == (not in_turn and not read)


def test_sums_are_taken_in_the_block():
    code, _ = emitted(
        lambda x: [x, (x * x).sum()], [BatchLayout((200, 3), (0,))], (200,), (False, True)
    )
    assert code.parts == math.ceil(200 / 32) and code.summed == (False, True)
    assert re.findall(r"over_warp<double>\(.*?y(\d)\[", code.source) == ["1"]


def program(x, y, z, w):
    """Short, staged and long rows, and what is shared; streamed (also from a loop), updated and
    summed results."""
    updated = jnp.zeros(40).at[jnp.arange(40) % 7].add(jnp.tile(x, 8))
    total = jax.lax.fori_loop(0, 20, lambda i, s: s + y[i] * z[i], 0.0)
    turns = jax.lax.scan(lambda s, a: (s + a, jnp.stack([s + a * k for k in range(40)])), 0.0, x)[1]
    return [jnp.sin(y) * w, jnp.concatenate([z, y]) * total, updated, y[:9] * x[0], turns[::-1],
            x * total]  # fmt: skip


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize(
    "batch", [(200,), (3, 53), *(pytest.param(b, marks=pytest.mark.slow) for b in [(1,), (256,)])]
)
@pytest.mark.parametrize("last", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_kernel_s_threads_together(batch, last):
    """Staging, streams and sums, with a block's threads at once; the last block is not full."""
    n, levels = len(batch), range(len(batch))
    args = [RNG.normal(size=(*batch, *s)) for s in ((5,), (20,), (130,))]
    w = RNG.normal(size=20)
    shared = BatchLayout((20,), (None,) * n)
    if last:
        args = [np.moveaxis(x, -1, 0) for x in args]
        layouts = [BatchLayout(x.shape, tuple(1 + k for k in levels)) for x in args]
    else:
        layouts = [BatchLayout(x.shape, tuple(levels)) for x in args]
    summed = (False, False, False, True, False, True)
    code, shapes = emitted(program, [*layouts, shared], batch, summed, last)
    got = emulated(code, [*args, w], shapes)
    mapped = program
    for _ in levels:
        mapped = jax.vmap(mapped, (*(-1 if last else 0,) * 3, None), -1 if last else 0)
    axes = tuple(range(-n, 0)) if last else tuple(levels)
    want = mapped(*args, w)
    want = [x.sum(axes) if s else x for x, s in zip(want, summed, strict=True)]
    for a, b in zip(got, want, strict=True):
        assert relative_error(a, b) <= F64_TRANSFORM


def leaving(x, n):
    """Rows that are staged whole: in order, in loops, under conditions, read again; and short."""
    looped = jax.lax.scan(lambda c, k: (c + x[0], c * k), x[1], jnp.arange(13.0))[1]
    updated = jnp.zeros(12).at[jnp.arange(12) * n[0] % 5].add(jnp.tile(x, 2))
    chosen = jax.lax.cond(n[1] > 0, lambda: jnp.arange(10) * x[2], lambda: jnp.tile(x, 2)[1:11])
    single = jnp.sin(jnp.tile(x, 2)[:9]).astype(jnp.float32)
    return [looped, updated, chosen, single, jnp.arange(11, dtype=jnp.int32) + n[0],
            jnp.arange(14) > n[1], x[:0], x[:3] * x[0], x.sum()]  # fmt: skip


def long_rows(x, n):
    """Rows that leave piece by piece, of several types; one that is written in a loop does not."""
    row = jnp.tile(x, 48) * jnp.arange(288)
    looped = jax.lax.scan(lambda c, k: (c + x[0], c * k), x[1], jnp.arange(129.0))[1]
    return [row[:281], row[:129].astype(jnp.float32), (row > 0)[:141], row[:20], looped,
            jnp.arange(132, dtype=jnp.int32) * n[0]]  # fmt: skip


slow = pytest.mark.slow
CASES = [
    pytest.param(leaving, {}, 200, marks=slow),
    (leaving, {}, 20),
    (leaving, {"SHARED_BYTES": 12 * 1024}, 40),
    (long_rows, {}, 200),
    pytest.param(long_rows, {"TILE": 32}, 200, marks=slow),
    pytest.param(long_rows, {"TILE": 64}, 20, marks=slow),
    (long_rows, {"SHARED_BYTES": 1024}, 40),
]


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize(("g", "constants", "size"), CASES)
def test_results_leave(monkeypatch, g, constants, size):
    """The last block, or the first warp, is not full; with little shared memory, few are staged."""
    for name, value in constants.items():
        monkeypatch.setattr(cuda if name == "SHARED_BYTES" else stores, name, value)
    args = RNG.normal(size=(size, 6)), RNG.integers(-9, 9, (size, 2), dtype=np.int32)
    one = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in args]
    closed = jax.make_jaxpr(g)(*one)
    outs = [batch_first(a.shape, (size,)) for a in closed.out_avals]
    ins = [batch_first(x.shape, (size,)) for x in one]
    code = kernel(write_program(closed, (size,), ins, outs))
    shapes = [jax.ShapeDtypeStruct((size, *a.shape), a.dtype) for a in closed.out_avals]
    for got, want in zip(emulated(code, args, shapes), jax.vmap(g)(*args), strict=True):
        assert got.dtype == want.dtype
        np.testing.assert_allclose(got, want, rtol=1e-6 if got.dtype == np.float32 else 1e-13)


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
def test_staged_rows_are_memory():
    """Entries are written under a condition, read again and written again, in loops; each thread
    has a row of its own, those beyond the batch too."""
    b, size, n = Builder(), 40, 12
    x, y = b.external_array(np.float64, 1, "operand"), b.external_array(np.float64, n, "result")
    number = b.load(x, None, 0)
    for k in reversed(range(n)):
        b.store(y, None, k, np.float64(k))
    with b.when(b.op("lt", bool, number, np.float64(7))):
        b.store(y, None, 3, np.float64(100))
    with b.loop(5) as k:
        value = b.op("add", np.float64, b.load(y, k, 1), number)
        b.store(y, k, 0, b.op("add", np.float64, b.load(y, k, 0), value))
    ins, outs = batch_first((), (size,)), batch_first((n,), (size,))
    code = kernel(Written(b, (x,), (y,), ((ins,), (outs,)), (size,), (False,)))
    assert "store_rows<double,12,13>(r0" in code.source
    numbers = np.arange(size, dtype=np.float64)
    want = np.tile(np.arange(float(n)), (size, 1))
    want[:7, 3] = 100
    for k in range(5):
        want[:, k] += want[:, k + 1] + numbers
    (got,) = emulated(code, [numbers], [jax.ShapeDtypeStruct(want.shape, want.dtype)])
    np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("size", [*range(9, 41), 128])
def test_rows_meet_few_conflicts(size):
    """At most two threads of a warp meet a bank of shared memory."""
    pitch = stores.whole_rows(np.dtype(np.float32), size).pitch
    assert max(np.bincount(np.arange(32) * pitch % 32)) <= 2


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
def test_elementwise_loops_run_in_groups():
    """Loops over arrays in memory: groups of 16 entries, and one loop for all axes.

    The 600 entries of a sum along a scan are 37 groups of 16 turns and one of 8. The 14 by 6
    entries of an array that the loop also indexes by a variable are 5 groups of 16 and one of 4.
    """

    def copied(x):
        def step(total, k):
            total = total + k * jnp.sin(x)
            return total, total[0]

        return jax.lax.scan(step, jnp.zeros_like(x), jnp.arange(3.0))

    def indexed(x):
        def step(k, y):
            y = x[0] * y.at[k, 1].add(2.0) + y
            return y.at[k % 3].set(0.0)

        zeros = jax.lax.dynamic_update_slice(jnp.ones((14, 6)), jnp.zeros((14, 6)), (0, 0))
        return jax.lax.fori_loop(0, 9, step, zeros + x.reshape(14, 6))

    r = np.random.default_rng(0)
    for f, size, last in ((copied, 600, 8), (indexed, 84, 4)):
        x = r.normal(size=(2, size))
        source = "\n".join(Printer({}).lines(written(f, x)[0].builder.block))
        assert re.search(r"\+=16\)\{", source) and re.search(rf"\+={last}\)\{{", source)
        assert "<6;" not in source
        got = many_on_host([(f, (x,))])[0]
        for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(jax.vmap(f)(x)), strict=True):
            assert relative_error(a, b) < F64_TRANSFORM
