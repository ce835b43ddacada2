"""Small programs by machine code, as users run them: each family of rules beside XLA, quickly.

All functions of a family are one program, for one sample (`jit`), and for a batch whose lanes take
different branches. The long runs of the same rules are in the other files of this folder.
"""

from __future__ import annotations

import functools
import warnings
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from jax import lax
from jax.scipy.linalg import solve_triangular
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

import rbjax as rb
from rbjax.compiler.cuda import driver, nvrtc
from rbjax.compiler.jax import explain, function, launch, primitive, sharding
from rbjax.compiler.jax.function import compile_threads, with_multi_kernel
from tests.robots import QUICK
from tests.tolerances import F64_TRANSFORM

RNG = np.random.default_rng(0)
X = RNG.normal(size=(9, 5))
X[1:3] = abs(X[1:3])


@pytest.fixture(autouse=True)
def by_llvm(monkeypatch):
    """A process whose functions of one sample run as machine code, and fall back only with an
    error."""
    monkeypatch.setattr(launch, "uses_llvm", lambda: True)
    primitive._warn.cache_clear()


def same(f, *args, tolerance: float = 100 * F64_TRANSFORM, alone: bool = True) -> None:
    """f by machine code is f by XLA, for a batch and, if `alone`, for one sample."""
    one = [x[0] for x in args]
    for g, xs in ((f, one), (jax.vmap(f), args))[not alone :]:
        h = jax.vmap(compile_threads(f)) if g is not f else compile_threads(f)
        text = jax.jit(h).lower(*xs)
        assert "@rbjax_" in text.as_text()
        got, want = text.compile(QUICK)(*xs), jax.jit(g, compiler_options=QUICK)(*xs)
        for k, (a, b) in enumerate(zip(*map(jax.tree.leaves, (got, want)), strict=True)):
            assert a.dtype == b.dtype and a.shape == b.shape
            np.testing.assert_allclose(a, b, tolerance, tolerance, err_msg=f"result {k}")


# ------------------------------------------------------------------- control flow


def test_control_flow():
    def f(x):
        n = jnp.abs(x * 4).astype(jnp.int32)
        swapped = lambda c: (c[1], c[0] + c[1], c[2] - 1)  # noqa: E731
        yield lax.while_loop(lambda c: c[2] > 0, swapped, (x[0], x[1], n[0]))
        yield lax.cond(x[0] > 0, lambda x: jnp.sin(x), lambda x: x[::-1], x)
        yield lax.switch(n[1] % 3, [lambda x: x, lambda x: -x, lambda x: x * x], x)
        yield lax.scan(lambda c, y: (c * 0.5 + y, (c, y > c)), x[0], x)
        yield lax.scan(lambda c, y: (c + y, c), x[0], x, reverse=True)
        yield lax.fori_loop(0, n[2], lambda i, c: c + jnp.cos(c * i), x)
        yield lax.fori_loop(0, 7, lambda i, c: c.at[i % 5].add(c[(i + 1) % 5]), x)
        yield lax.scan(lambda c, _: (lax.cond(c[0] > 0, jnp.negative, jnp.exp, c), c), x, None, 4)
        yield lax.while_loop(lambda c: (c < 9).all(), lambda c: c + 1 + lax.fori_loop(
            0, 2, lambda i, y: y * y, c * 0.1), x[:2])  # fmt: skip
        yield lax.select_n(n % 3, x, -x, 2 * x)
        yield jnp.where((x > 0) & ~(x > 1), x, jnp.clip(x, -0.5, 0.5))

    same(lambda x: list(f(x)), X)


# ------------------------------------------------------------------- reductions


def test_reductions():
    def f(x):
        y, n = x.reshape(-1)[:4].reshape(2, 2), jnp.round(x * 3).astype(jnp.int32)
        for axis in (None, 0, 1):
            places = jnp.argmax, jnp.argmin
            yield [g(y, axis) for g in (jnp.sum, jnp.prod, jnp.max, jnp.min, *places)]
            yield [g(y > 0, axis) for g in (jnp.any, jnp.all)]
        yield [g(n) for g in (jnp.sum, jnp.max, jnp.prod, jnp.bitwise_or.reduce,
                              jnp.bitwise_and.reduce, jnp.bitwise_xor.reduce)]  # fmt: skip
        yield [g(x) for g in (jnp.cumsum, jnp.cumprod, lax.cummax, lax.cummin, lax.cumlogsumexp)]
        yield [g(x, reverse=True) for g in (lax.cumsum, lax.cummax)]
        yield jax.nn.logsumexp(x), jax.nn.softmax(x), x.var(), jnp.linalg.norm(x)
        yield jnp.median(x)
        yield lax.associative_scan(lambda a, b: a * 0.5 + b, x)
        yield jnp.outer(x, x).sum(0), jnp.einsum("i,j->ij", x, x)[1], x @ x

    same(lambda x: list(f(x)), X)


def test_reductions_in_loops():
    """Of arrays whose entries are too many to be written one by one."""
    x = RNG.normal(size=(5, 200))

    def f(x):
        n = (x * 3).astype(jnp.int32)
        yield [g(x) for g in (jnp.sum, jnp.max, jnp.min, jnp.argmax, jnp.argmin, jnp.cumsum)]
        yield [g(x.reshape(20, 10), 1) for g in (jnp.sum, jnp.max, jnp.argmin)]
        yield n.sum(), (x > 2).any(), lax.cummax(x), (x > 9).all()

    same(lambda x: list(f(x)), x, alone=False)


# ------------------------------------------------------------------- gather and scatter


def test_gather_and_scatter():
    def f(x):
        n = (jnp.abs(x * 7)).astype(jnp.int32) % 7 - 1  # some of them outside
        y = jnp.stack([x, 2 * x, -x])
        yield x[n], y[n % 3, n], y[:, n], jnp.take(x, n, mode="clip"), jnp.take(x, n, mode="fill")
        yield jnp.take_along_axis(y, n[None, :3] % 5, 1), y[1, ::2], y[::-1, n[0]]
        a = x.at[n]
        yield a.set(x), a.add(x), a.mul(x), a.min(0.1), a.max(0.1), a.get(mode="fill", fill_value=7)
        yield y.at[n[0]].set(1.0), y.at[:, n[1]].add(x[:3]), y.at[n % 3, n].add(x)
        yield lax.dynamic_slice(y, (n[0], n[1]), (2, 3))
        yield lax.dynamic_update_slice(y, y[:2, :2] * 9, (n[0], n[2]))
        yield lax.dynamic_index_in_dim(y, n[3], 0), jnp.roll(x, 2), jnp.pad(x, (1, 2), "edge")
        yield jnp.concatenate([x, x[::-1]]), jnp.repeat(x, 2), jnp.tile(x, 2), y.T[2:4]
        yield lax.pad(x, 0.5, [(1, -1, 2)]), jnp.flip(y, 1), jnp.triu(y), jnp.diag(x)[1]

    same(lambda x: list(f(x)), X)


# ------------------------------------------------------------------- sorting


def test_sorting():
    def f(x):
        y = jnp.round(x)
        yield jnp.sort(x), jnp.argsort(y), jnp.sort(x, descending=True), jnp.lexsort((x, y))
        yield lax.top_k(x, 3), jnp.searchsorted(jnp.sort(x), y), jnp.unique(y, size=5)
        yield jnp.sort(jnp.stack([x, -x]), 0), jnp.sort((y * 2).astype(jnp.int32)), jnp.nanmedian(x)

    same(lambda x: list(f(x)), X)


# ------------------------------------------------------------------- factorisations


@pytest.mark.parametrize("n", [3, 9])
def test_factorisations(n):
    """Written entry by entry, and with loops over the columns."""
    few = n == 3
    A, b = RNG.normal(size=(5, n, n)), RNG.normal(size=(5, n, 2))

    def f(A, b):
        S = A @ A.T + n * jnp.eye(n)
        L = jnp.linalg.cholesky(S)
        yield L, jnp.linalg.solve(A, b), jax.scipy.linalg.cho_solve((L, True), b)
        yield (jnp.linalg.slogdet(A), jnp.linalg.inv(S), lax.linalg.lu(A)) if few else ()
        for how in ({}, {"trans": 1}, {"unit_diagonal": True})[: 3 if few else 1]:
            yield solve_triangular(L, b, lower=True, **how), solve_triangular(L.T, b, **how)
        yield lax.linalg.triangular_solve(L, b.T, lower=True)
        Q, R = jnp.linalg.qr(A)
        yield Q @ R, jnp.abs(R), Q.T @ Q, jnp.linalg.det(A)
        if not few:
            return
        yield jax.scipy.linalg.qr(A, pivoting=True)[1:], jnp.linalg.lstsq(A[:, :2], b)[0]
        w, V = jnp.linalg.eigh(S)
        yield w, (V * w) @ V.T, jnp.linalg.svd(A, compute_uv=False)
        yield jax.scipy.linalg.expm(A * 0.01)
        u, s, v = jnp.linalg.svd(A[:, :2], full_matrices=False)
        yield (u * s) @ v

    same(lambda *xs: list(f(*xs)), A, b, tolerance=1e-10, alone=False)


def test_what_is_not_positive_definite_or_singular():
    def f(x):
        A = jnp.outer(x[:3], x[:3])
        return jnp.linalg.cholesky(A - jnp.eye(3)), jnp.linalg.det(A * 0), lax.linalg.lu(A * 0)[1:]

    same(f, X)


# ------------------------------------------------------------------- random numbers


def test_random_numbers():
    seeds = np.arange(9, dtype=np.uint32)

    def f(seed):
        key = jax.random.key(seed)
        one, two = jax.random.split(key)
        yield jax.random.key_data(jax.random.fold_in(one, seed))
        yield jax.random.bits(two, (3,), "uint8")
        yield jax.random.uniform(one, (3,)), jax.random.normal(two, (2, 2))
        yield jax.random.randint(one, (3,), 0, 10), jax.random.bernoulli(two, 0.3, (4,))
        yield jax.random.permutation(one, 5), jax.random.categorical(two, jnp.arange(3.0))
        yield jax.random.key_data(jax.random.split(key, 3)), jax.random.exponential(one)
        yield jax.random.key_data(jax.random.clone(key))
        yield jax.random.key_data(jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(3)))

    same(lambda seed: list(f(seed)), seeds)


# ------------------------------------------------------------------- mathematics


def test_elementwise_functions():
    def f(x):
        n, k = (x * 9).astype(jnp.int32), jnp.arange(5, dtype=jnp.int32) % 4
        for g in (jnp.sin, jnp.tan, jnp.exp2, jnp.expm1, jnp.tanh, jnp.sinh, jnp.cosh, jnp.cbrt,
                  jnp.arctan, jnp.arcsinh, jnp.sign, jnp.floor, jnp.ceil, jnp.round, jnp.square,
                  jnp.isfinite, jax.nn.sigmoid, lax.erf, lax.erfc, lax.lgamma, lax.digamma,
                  lax.neg):  # fmt: skip
            yield g(x)
        y = jnp.abs(x) + 0.1
        for g in (jnp.log, jnp.log1p, jnp.sqrt, lax.rsqrt, lambda y: lax.erf_inv(jnp.tanh(y)),
                  jnp.arccosh, lambda y: y**2.5, lambda y: y**-3):  # fmt: skip
            yield g(y + (g is jnp.arccosh))
        yield jnp.arctan2(x, y), jnp.hypot(x, y), lax.nextafter(x, y), jnp.fmod(x, y), x % y
        yield x // y, jnp.copysign(x, -y), jnp.maximum(x, y), jnp.power(y, x), jnp.nan_to_num(x / 0)
        yield n // 3, n % 3, lax.rem(n, k + 1), n << k, n >> k, lax.shift_right_logical(n, k)
        yield n & k, n | k, n ^ k, ~n, lax.population_count(n), lax.clz(n), abs(n), -n, lax.sign(n)
        yield x.astype(jnp.float32), x.astype(jnp.int8), (x * 300).astype(jnp.uint8), n > k, n == k
        yield lax.bitcast_convert_type(x, jnp.int64), n.astype(bool)
        yield lax.integer_pow(x, 5), lax.clamp(-0.2, x, 0.3), jnp.arcsin(jnp.tanh(x)), n * 1.5

    same(lambda x: list(f(x)), X, tolerance=1e-13)


# ------------------------------------------------------------------- derivatives


def test_derivatives():
    def f(x, A):
        def step(c, y):
            return jnp.tanh(A @ c) + y, jnp.where(c[0] > 0, c.sum(), c[1])

        end, out = lax.scan(step, x, jnp.stack([x, -x]))
        far = lax.cond(x[0] > 0, jnp.sin, jnp.cos, end).at[1].mul(x[2])
        return (far**2).sum() + out[0] * jnp.linalg.solve(A + 9 * jnp.eye(5), x)[0]

    A = RNG.normal(size=(9, 5, 5))
    g = lambda h: jax.value_and_grad(h, (0, 1))  # noqa: E731
    got = jax.jit(jax.vmap(g(compile_threads(f))), compiler_options=QUICK)(X, A)
    want = jax.jit(jax.vmap(g(f)), compiler_options=QUICK)(X, A)
    for a, b in zip(*map(jax.tree.leaves, (got, want)), strict=True):
        np.testing.assert_allclose(a, b, 1e-11, 1e-11)
    shared = lambda h: jax.grad(lambda A: jax.vmap(h, (0, None))(X, A).sum())  # noqa: E731
    got, want = (jax.jit(shared(h), compiler_options=QUICK)(A[0]) for h in (compile_threads(f), f))
    np.testing.assert_allclose(got, want, 1e-11, 1e-11)
    curve = lambda h: jax.hessian(lambda x: h(x, A[0]))  # noqa: E731
    got, want = (jax.jit(curve(h), compiler_options=QUICK)(X[0]) for h in (compile_threads(f), f))
    np.testing.assert_allclose(got, want, 1e-10, 1e-10)


def test_inside_of_a_thread():
    """The primitives of Equinox and lineax, and errors that a thread cannot raise."""

    def f(x):
        A = jnp.diag(jnp.abs(x) + 1)
        solved = lx.linear_solve(lx.MatrixLinearOperator(A), x, lx.LU()).value
        checked = eqx.error_if(solved, solved[0] > 1e9, "too large")
        body = lambda c: (c[0] + 1, c[1] * 0.5)  # noqa: E731
        loop = eqx.internal.while_loop(lambda c: c[0] < 4, body, (0, checked), kind="lax")
        return loop, eqx.internal.unvmap_any(x > 1), jax.vmap(compile_threads(jnp.sin))(x)

    one = X[0]
    got, want = rb.compile(f, one)(one), f(one)
    for a, b in zip(*map(jax.tree.leaves, (got, want)), strict=True):
        np.testing.assert_allclose(a, b, 1e-12)


# ------------------------------------------------------------------- what needs a GPU


def test_several_kernels_on_a_gpu_are_one_function(monkeypatch):
    monkeypatch.setattr(function, "has_gpu", lambda: True)
    monkeypatch.setattr(launch, "kernels_work", lambda: True)
    monkeypatch.setattr(launch, "capability", lambda: "9.0")
    monkeypatch.setattr(launch, "ordinal", lambda: 0)
    monkeypatch.setattr(launch, "ptx", lambda source, capability: "PTX")
    a = jnp.asarray(2.0)
    g = with_multi_kernel(lambda x: a * jnp.sin(x), lambda x: a * (jnp.sin(x) + 0), 10)
    np.testing.assert_allclose(jax.jit(jax.vmap(g))(X), 2 * np.sin(X), 1e-14)
    lower = lambda x: jax.jit(jax.vmap(g)).trace(x).lower(lowering_platforms=("cuda",))  # noqa: E731
    assert launch.GPU_KERNEL not in lower(X).as_text()  # few samples: several kernels of XLA
    assert launch.GPU_KERNEL in lower(np.tile(X, (3, 1))).as_text()


class Nvrtc:
    """What stands for libnvrtc: it compiles what has no "error" in it."""

    def __init__(self):
        self.options, self.destroyed = [], 0

    def nvrtcVersion(self, major, minor):
        major._obj.value, minor._obj.value = 13, 1

    def nvrtcCreateProgram(self, program, source, *_):
        self.source = source
        return 0

    def nvrtcCompileProgram(self, program, count, words):
        self.options = [words[k].decode() for k in range(count)]
        return int(b"error" in self.source)

    def nvrtcGetPTXSize(self, program, size):
        size._obj.value = 4
        return int(b"status" in self.source)

    def nvrtcGetPTX(self, program, buffer):
        buffer.value = b"PTX"
        return 0

    def nvrtcGetProgramLogSize(self, program, size):
        size._obj.value = 10
        return 0

    def nvrtcGetProgramLog(self, program, buffer):
        buffer.value = b"line 1"
        return 0

    def nvrtcDestroyProgram(self, program):
        self.destroyed += 1


def test_ptx_by_nvrtc(monkeypatch):
    library = Nvrtc()
    monkeypatch.setattr(nvrtc, "library", lambda: library)
    nvrtc.version.cache_clear()
    try:
        assert nvrtc.version() == "13.1"
        assert nvrtc._compile("fine", "compute_90") == "PTX"
        assert library.options[0] == "--gpu-architecture=compute_90"
        with nvrtc.fast_compile():
            nvrtc._compile("fine", "compute_90")
        assert library.options[-1] == "--Ofast-compile=max"
        with pytest.raises(nvrtc.CompileError, match="does not compile a kernel: line 1"):
            nvrtc._compile("error", "compute_90")
        with pytest.raises(nvrtc.CompileError, match="status 1"):
            nvrtc._compile("status", "compute_90")
        assert library.destroyed == 4
    finally:
        nvrtc.version.cache_clear()


def test_a_library_that_is_not_there(monkeypatch):
    def missing(name):
        raise OSError(name)

    monkeypatch.setattr(nvrtc.ctypes, "CDLL", missing)
    nvrtc.library.cache_clear()
    try:
        with pytest.raises(nvrtc.CompileError, match=r"found no libnvrtc.*rbjax\[cuda\]"):
            nvrtc.library()
        with pytest.raises(nvrtc.CompileError, match="found no CUDA driver"):
            driver.limits("9.0")
    finally:
        nvrtc.library.cache_clear()


def test_explain_with_a_gpu(monkeypatch):
    """Shares of the limits, from resources and a time that stand for a GPU's."""
    monkeypatch.setattr(launch, "has_gpu", lambda: True)
    for name, value in (("kernels_work", True), ("capability", "9.0"), ("ordinal", 0)):
        monkeypatch.setattr(launch, name, lambda value=value: value)
    monkeypatch.setattr(explain, "ptx", lambda *_: "PTX")
    monkeypatch.setattr(explain.driver, "resources", lambda *_: driver.Resources(40, 16, 0))
    monkeypatch.setattr(explain.driver, "limits", lambda *_: driver.PeakRates(1e12, 1e12))
    found = explain.explain(lambda x: jnp.tanh(x).sum(), jnp.ones(3), batch=64)
    assert found.registers == 40 and found.of_instructions > 0 and found.of_bandwidth > 0
    assert "40 registers, 16 bytes of local memory" in str(found)
    assert "no GPU" in str(explain.Explanation(1, 1, 1, 1, 1))


# ------------------------------------------------------------------- several devices


def test_the_part_of_a_device():
    """What a device of a mesh computes; the mesh has one device, the shardings name its axes."""
    mesh = Mesh(np.array(jax.devices()[:1]).reshape(1, 1), ("a", "b"))
    batch, ins, outs = (4, 6), [(0, 1), (0, None)], [(0, 1), (None, None), (None, 0)]

    def part(batch):
        def run(x, y):
            z = x * y[:, None]
            return [z, z.sum(), z.sum(0)]

        return run

    whole = sharding.shard_batch(part, batch, ins, outs, ([2, 1], [2, 0, 1]))
    x, y = RNG.normal(size=(4, 6)), RNG.normal(size=4)

    def of(*specs):
        return [SimpleNamespace(sharding=NamedSharding(mesh, s)) for s in specs]

    for specs, over in (
        ((P("a"), P("a")), ("a", None)), ((P("a", "b"), P()), ("a", "b")),
        ((P(("a", "b")), P()), (("a", "b"), None)), ((P(), P("b")), ("b", None)),
        ((P("a"), P("b")), ("a", None)), ((P(None, "b"), P("b")), (None, "b")),
    ):  # fmt: skip
        found, run, results, operands = whole.partition(mesh, of(*specs), None)
        assert found is mesh and operands[0].spec == P(*over) and operands[1].spec == P(over[0])
        assert results[0].spec == P(*over) and results[1].spec == P()
        local = jax.shard_map(run, mesh=mesh, in_specs=tuple(s.spec for s in operands),
                              out_specs=tuple(s.spec for s in results))  # fmt: skip
        for a, b in zip(local(x, y), part(batch)(x, y), strict=True):
            np.testing.assert_allclose(a, b, 1e-14)
    rule = sharding._rule(len(batch), ins, outs, ([2, 1], [2, 0, 1]))
    assert rule == "B0 B1, B0 -> B0 B1, , B1"


def test_nothing_warns():
    """No family above falls back to XLA: a warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(jax.vmap(functools.partial(compile_threads(jnp.sin))))(X)
