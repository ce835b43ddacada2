"""Machine code that XLA calls: batches, parts on several threads, derivatives, where it fails."""

import functools
import os
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec

import rbjax as rb
from rbjax.compiler.jax import launch, primitive
from rbjax.compiler.jax.function import compile_threads
from rbjax.compiler.llvm import batch as llvm_batch
from rbjax.compiler.llvm import jit as llvm_jit
from tests.tolerances import F64_TRANSFORM, relative_error

pytestmark = pytest.mark.usefixtures("by_llvm")
RNG = np.random.default_rng(0)
W, X = RNG.normal(size=(5, 3)), RNG.normal(size=(6, 3))


@pytest.fixture
def by_llvm(monkeypatch):
    """A process whose functions of one sample run as machine code."""
    monkeypatch.setattr(launch, "uses_llvm", lambda: True)


def f(x, w):
    return jnp.tanh(w @ x), x[0] > 0


def texts(g, *args) -> str:
    return jax.jit(g).lower(*args).as_text()


def same(g, h, *args) -> None:
    """g by machine code, h by XLA."""
    assert "@rbjax_" in texts(g, *args) and "@rbjax_" not in texts(h, *args)
    found, wanted = jax.jit(g)(*args), jax.jit(h)(*args)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert a.dtype == b.dtype and a.shape == b.shape
        assert relative_error(np.asarray(a, float), np.asarray(b, float)) <= F64_TRANSFORM


def test_one_sample_and_batches():
    g, flip = compile_threads(f), functools.partial(jax.vmap, in_axes=(1, None), out_axes=(1, 0))
    same(g, f, X[0], W)
    same(jax.vmap(g, (0, None)), jax.vmap(f, (0, None)), X, W)
    same(flip(g), flip(f), X.T, W)
    many = np.stack([W, -W])
    pairs = [jax.vmap(jax.vmap(h, (0, None)), (None, 0)) for h in (g, f)]
    same(*pairs, X, many)
    assert jax.jit(jax.vmap(g, (0, None)))(X[:0], W)[0].shape == (0, 5)


@pytest.mark.parametrize("samples", [1, 7, 5000])
def test_parts_on_several_threads(monkeypatch, samples):
    """The sum over the batch, too, whose parts keep a row each."""
    monkeypatch.setattr(llvm_batch, "OPERATIONS_A_PART", 100)
    primitive._kernel.cache_clear()
    x = RNG.normal(size=(samples, 3))

    def total(g, w):
        return (jax.vmap(g, (0, None))(x, w)[0] ** 2).sum()

    for _ in range(3):
        same(*(jax.value_and_grad(functools.partial(total, g)) for g in (compile_threads(f), f)), W)
    primitive._kernel.cache_clear()


@pytest.mark.parametrize("samples", [None, 0, 1, 200])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_subnormal_arguments_inside_of_xla(dtype, samples):
    """XLA runs programs with flags by which the processor reads subnormal numbers as zeros."""
    tiny, least = np.finfo(dtype).tiny, np.finfo(dtype).smallest_subnormal
    some = np.array([0, least, 5 * least, tiny / 3, tiny, 4 * tiny, 1, 1e30, np.inf], dtype)
    y, x = (a.ravel() for a in np.meshgrid([*some, *-some], [*some, *-some]))
    if samples is None:  # the first of many, as a single sample
        run = jax.jit(rb.threads(jax.lax.atan2))
        got = np.array([run(a, b) for a, b in zip(y[:60], x[:60], strict=True)])
    else:
        y, x = y[40 : 40 + samples], x[40 : 40 + samples]
        got = jax.jit(jax.vmap(rb.threads(jax.lax.atan2)))(y, x)
    want = np.arctan2(y, x)[: len(got)]
    # the result of the largest ratios is subnormal itself
    np.testing.assert_allclose(got, want, rtol=4 * np.finfo(dtype).eps, atol=tiny)
    if samples != 200:
        return
    x = np.resize(some[1:-1], 64)
    many = lambda f: np.asarray(jax.jit(jax.vmap(rb.threads(f)))(x), np.float64)  # noqa: E731
    eps = 4 * np.finfo(dtype).eps
    np.testing.assert_allclose(many(jnp.log), np.log(x.astype(float)), rtol=eps)
    np.testing.assert_allclose(many(jnp.cbrt), np.cbrt(x.astype(float)), rtol=eps)
    wanted = x.astype(float) ** -0.25
    np.testing.assert_allclose(many(lambda x: jax.lax.pow(x, dtype(-0.25))), wanted, rtol=eps)


#: functions that jax 0.12 traces to primitives of a higher level, of which each is a function
HIGH = {
    "searchsorted": lambda x: jnp.searchsorted(jnp.sort(x), x, side="right"),
    "searchsorted in rows": lambda x: jnp.searchsorted(jnp.sort(x), jnp.outer(x, x)),
    "nonzero": lambda x: jnp.nonzero(x > 0, size=4, fill_value=-1)[0] + x[0],
    "einsum": lambda x: jnp.einsum("i,j,j->i", x, x, jnp.sin(x)),
    "ldexp": lambda x: jnp.ldexp(x, jnp.arange(6, dtype=jnp.int32)),
    "frexp": lambda x: jnp.frexp(x)[0] * 3 + jnp.frexp(x)[1],
    "remat": jax.checkpoint(lambda x: jnp.sin(jnp.sin(x))),
    "custom_jvp": jax.nn.relu,
    "interp": lambda x: jnp.interp(x, jnp.arange(6.0), jnp.cumsum(x)),
}


@pytest.mark.parametrize("name", HIGH)
def test_functions_of_many_primitives(name):
    g, x = HIGH[name], RNG.normal(size=(5, 6)) * 3
    same(jax.vmap(compile_threads(g)), jax.vmap(g), x)
    if name not in ("searchsorted", "searchsorted in rows"):
        total = lambda h: jax.grad(lambda x: (jax.vmap(h)(x) ** 2).sum())  # noqa: E731
        same(total(compile_threads(g)), total(g), x)


def test_derivatives_and_loops():
    """Inside of XLA's own loop; a gradient in f32; a hessian."""
    step = compile_threads(lambda x, w: jnp.sin(w @ x)[:3])

    def march(step, w):
        return jax.lax.scan(lambda x, _: (step(x, w), x), jnp.asarray(X[0]), None, 4)[1]

    plain = lambda x, w: jnp.sin(w @ x)[:3]  # noqa: E731
    same(functools.partial(march, step), functools.partial(march, plain), W)
    same(*(jax.jacrev(functools.partial(march, g)) for g in (step, plain)), W)
    same(*(jax.hessian(lambda x, g=g: g(x, jnp.asarray(W)).sum()) for g in (step, plain)), X[0])


def test_rows_without_entries():
    """Recorded rows of nothing: the derivative of a loop may keep such."""

    def g(x):
        return jax.lax.scan(lambda c, row: (c + row.sum() + x[0], None), x[1], np.zeros((3, 0)))[0]

    same(jax.vmap(compile_threads(g)), jax.vmap(g), X)


def test_rollouts_and_gradients_are_those_of_xla(monkeypatch):
    model = rb.load("cart_pole")
    state = rb.State(jnp.asarray(X[:, :2]), jnp.asarray(X[:, 1:]))
    u = jnp.asarray(RNG.normal(size=(10, 1)))

    def end(kernel, mass, state, u):
        m = model.replace(bodies=model.bodies.replace(mass=mass))
        out = rb.rollout(m, state, u, 0.01, save_every=5, kernel=kernel)
        return (out.q**2).sum(), out.q

    one, other = (
        jax.value_and_grad(functools.partial(end, kernel), (0, 2), has_aux=True)
        for kernel in (True, False)
    )
    monkeypatch.setattr(launch, "uses_llvm", lambda: True)
    found = jax.jit(one)(model.bodies.mass, state, u)
    monkeypatch.setattr(launch, "uses_llvm", lambda: False)
    wanted = jax.jit(other)(model.bodies.mass, state, u)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert relative_error(a, b) <= F64_TRANSFORM


def test_it_is_the_function_for_a_cpu():
    def g(x):
        return jax.lax.platform_dependent(x, cuda=lambda x: -x, default=lambda x: 2 * x)

    assert jax.jit(compile_threads(g))(3.0) == 6.0 == rb.compile(g, 0.0)(3.0)


@pytest.mark.slow
def test_a_program_of_another_process_is_found_again(tmp_path):
    """JAX keeps the compiled program on disk; its machine code is registered by name."""
    code = """
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
from rbjax.compiler.jax.function import compile_threads
g = jax.jit(jax.vmap(compile_threads(lambda x: jnp.cos(x) * 3)))
np.testing.assert_allclose(g(jnp.arange(4.0)), 3 * np.cos(np.arange(4.0)), rtol=1e-6)
"""
    env = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "RBJAX_CPU": "llvm"}
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    assert list(tmp_path.glob("jit*-cache")) and list((tmp_path / "rbjax-threads").glob("*.o"))


def test_a_sharded_batch_stays_where_it_is():
    mesh = jax.make_mesh((jax.device_count(),), ("data",))
    x = jax.device_put(X, NamedSharding(mesh, PartitionSpec()))
    found = jax.jit(jax.vmap(compile_threads(lambda x: x.sum())))(x)
    np.testing.assert_allclose(found, X.sum(1), rtol=F64_TRANSFORM)


def test_export_refuses_it():
    """An exported program would call code that another process does not have."""
    g = jax.jit(compile_threads(lambda x: jnp.sin(x)))
    with pytest.raises(ValueError, match=r"custom call target|stable"):
        jax.export.export(g)(1.0)


# ------------------------------------------------------------------- failures


def test_what_llvm_lacks_runs_under_xla():
    def norm(x):
        return jax.pure_callback(np.linalg.norm, jax.ShapeDtypeStruct((), x.dtype), x)

    primitive._warn.cache_clear()
    with pytest.warns(UserWarning, match="no kernel for pure_callback"):
        assert jax.jit(compile_threads(norm))(jnp.array([3.0, 4.0])) == 5


def test_without_llvmlite_it_is_said_once(monkeypatch):
    def missing():
        raise llvm_jit.NoCompiler("llvmlite is missing")

    monkeypatch.undo()
    monkeypatch.setenv(launch.VARIABLE, "llvm")
    monkeypatch.setattr(llvm_jit, "_llvm", missing)
    caches = (launch.uses_llvm, launch.host_kernels_work)
    for cache in caches:
        cache.cache_clear()
    try:
        with pytest.warns(UserWarning, match="llvmlite is missing.*run under XLA"):
            assert not launch.uses_llvm()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert not launch.uses_llvm()
            assert jax.jit(compile_threads(lambda x: x + 1))(1.0) == 2
    finally:
        monkeypatch.undo()
        for cache in caches:
            cache.cache_clear()


def test_a_back_end_that_is_none(monkeypatch):
    monkeypatch.undo()
    monkeypatch.setenv(launch.VARIABLE, "fortran")
    launch.uses_llvm.cache_clear()
    try:
        with pytest.raises(rb.InputError, match="RBJAX_CPU: got 'fortran', expected one of"):
            launch.uses_llvm()
    finally:
        launch.uses_llvm.cache_clear()


@pytest.mark.parametrize("size", [5, 9])
def test_long_samples_beyond_whole_vectors_are_a_part_of_their_own(size):
    x, turns = jnp.arange(1.0, size + 1), 80_000
    total = lambda x: jax.lax.fori_loop(0, turns, lambda i, y: y + x, x)  # noqa: E731
    run = jax.jit(jax.vmap(compile_threads(total)))
    np.testing.assert_allclose(run(x), (turns + 1) * x, rtol=1e-13)


def test_the_call_says_that_its_handler_is_typed():
    """XLA of jax 0.11 loses JAX's own note of it in some programs (`custom_call`)."""
    lowered = jax.jit(jax.vmap(compile_threads(lambda x: x * jnp.sin(x)))).lower(jnp.ones((4, 3)))
    (call,) = [line for line in lowered.as_text().splitlines() if "rbjax_" in line]
    assert "api_version = 4" in call and "mhlo" not in call
