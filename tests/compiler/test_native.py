"""`rb.compile`: the emitted LLVM IR against XLA, its arguments, its cache and its fallback."""

from __future__ import annotations

import contextlib
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.shared.robots import as_model, compiled, states
from rbjax.compiler.llvm import jit as llvm_jit
from rbjax.compiler.llvm import numpy_call
from tests.compiler import random_programs
from tests.compiler.host import by_llvm
from tests.compiler.host import by_xla as together
from tests.compiler.test_algorithms import PARTS, agree, by_xla, of_a_sample
from tests.tolerances import F32_MAX, F64_PARITY, F64_TRANSFORM, relative_error

TOGETHER = 20


def differences(seeds: range) -> list[str]:
    cases = [(random_programs.program(seed), random_programs.arguments(seed)) for seed in seeds]
    wrong = []
    for seed, gs, ws in zip(seeds, by_llvm(cases), together(cases), strict=True):
        for k, (g, w) in enumerate(zip(gs, ws, strict=True)):
            if not np.allclose(g, w, rtol=1e-8, atol=1e-8, equal_nan=True):
                wrong.append(f"program {seed}, result {k}: {np.abs(g - w).max()}")
    return wrong


def test_random_programs():
    assert not (wrong := differences(range(TOGETHER))), wrong


@pytest.mark.slow
@pytest.mark.parametrize("first", range(TOGETHER, 1000, TOGETHER))
def test_a_thousand_random_programs(first):
    assert not (wrong := differences(range(first, first + TOGETHER))), wrong


# ------------------------------------------------------------------- algorithms


@pytest.mark.parametrize(("on", "names"), PARTS)
def test_algorithms(on, names):
    cases = [of_a_sample(name, on) for name in names]
    for (f, args), got in zip(cases, by_llvm(cases), strict=True):
        agree(got, by_xla(f, args))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda", "humanoid", "g1"])
def test_large_robots_in_both_precisions(name):
    reference = compiled(name)
    model, args = as_model(reference), states(reference, 2)

    def f(q, v, a):
        return [
            rb.forward_dynamics(model, q, v, a), rb.inverse_dynamics(model, q, v, a),
            rb.mass_matrix(model, q), rb.inverse_dynamics_derivatives(model, q, v, a),
        ]  # fmt: skip

    want = by_xla(f, args)
    single = [x.astype(np.float32) for x in args]
    double, f32 = by_llvm([(f, args), (f, single)])
    agree(double, want, F64_PARITY)
    for g, w in zip(jax.tree.leaves(f32), jax.tree.leaves(want), strict=True):
        assert g.dtype == np.float32 and relative_error(g, w, batch_dims=1).max() <= F32_MAX


def test_a_step_and_a_rollout_of_states():
    model = rb.load("cart_pole")
    state = jax.tree.map(np.asarray, rb.State(jnp.array([0.1, 0.4]), jnp.array([1.0, -0.3])))
    u = np.zeros(model.nu)

    def f(state, u):
        last = rb.rollout(model, state, None, 0.01, steps=20)
        return {"next": rb.step(model, state, u, 0.01), "last": (last.q[-1], last.v)}

    run = rb.compile(f, state, u)
    assert run.native
    got, want = run(state, u), jax.jit(f)(state, u)
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for g, w in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert type(g) is np.ndarray and g.dtype == w.dtype
        assert relative_error(g, w) <= F64_TRANSFORM


def test_a_policy_with_derivatives_and_loops():
    rng = np.random.default_rng(0)
    weights = [rng.normal(size=s) / 4 for s in ((16, 6), (16, 16), (3, 16))]

    def policy(x):
        for w in weights[:-1]:
            x = jnp.tanh(w @ x)
        return weights[-1] @ x

    def f(x, n):
        def turn(c):
            k, y, total = c
            return k + 1, y.at[k % 6].add(0.1 * policy(y)[k % 3]), total + (y**2).sum()

        k, y, total = jax.lax.while_loop(lambda c: (c[0] < n) & (c[2] < 50), turn, (0, x, 0.0))
        slopes = jax.jacfwd(policy)(y), jax.grad(lambda x: (policy(x) ** 2).sum())(y)
        return k, total > 50, slopes, jax.lax.scan(lambda c, a: (c + a, c * a), 0.0, y)[1]

    x = rng.normal(size=6)
    run, want = rb.compile(f, x, 0), jax.jit(f)
    assert run.native
    for n in (0, 3, 9):
        for g, w in zip(jax.tree.leaves(run(x, n)), jax.tree.leaves(want(x, n)), strict=True):
            assert g.dtype == w.dtype
            assert relative_error(g, w) <= F64_TRANSFORM


def test_large_arrays_lie_in_the_workspace():
    def f(x):
        def turn(k, y):
            return y.at[(7 * k) % 5000].add(y[k] * 0.5)

        return jax.lax.fori_loop(0, 3000, turn, x)

    x = np.random.default_rng(0).normal(size=5000)
    run = rb.compile(f, x)
    assert run.native
    assert relative_error(run(x), jax.jit(f)(x)) <= F64_TRANSFORM


# ------------------------------------------------------------------- arguments and results


@pytest.fixture(scope="module")
def double():
    def f(x, y):
        return {"twice": 2 * x["a"], "sum": x["a"].sum() + y}

    run = rb.compile(f, {"a": np.zeros((2, 3))}, np.float32(1))
    assert run.native
    return run


def test_arguments_are_converted(double):
    x = np.arange(12.0).reshape(2, 6)[:, ::2]
    for given in (x, np.asfortranarray(x), jnp.asarray(x), x.astype(np.int32),
                  x.view(np.matrix), x.astype(">f8")):  # fmt: skip
        got = double({"a": given}, 3)
        assert (got["twice"] == 2 * x).all() and got["sum"] == x.sum() + 3
        assert got["sum"].shape == () and got["sum"].dtype == np.float64


def test_few_arguments_and_results():
    assert (rb.compile(lambda: jnp.arange(3) * 2)() == [0, 2, 4]).all()
    assert rb.compile(lambda x: None, 1.0)(2.0) is None
    assert rb.compile(lambda x, none: (x > 1, 7, none), 1.0, None)(2.0, None) == (True, 7, None)
    nothing = rb.compile(lambda x: (x * 2, x.sum()), np.zeros((0, 3)))(np.ones((0, 3)))
    assert nothing[0].shape == (0, 3) and nothing[1] == 0


def test_random_numbers_of_a_key_s_data():
    def f(data):
        return jax.random.normal(jax.random.wrap_key_data(data), (3,))

    data = np.asarray(jax.random.key_data(jax.random.key(3)))
    run = rb.compile(f, data)
    assert run.native and relative_error(run(data), f(data)) <= F64_TRANSFORM


def test_equal_types_of_another_name_are_converted():
    run = rb.compile(lambda x: x + 1, np.zeros(2, np.int64))
    assert (run(np.array([3, 4], np.longlong)) == [4, 5]).all()


def test_results_are_new_arrays(double):
    first = double({"a": np.ones((2, 3))}, 0)
    double({"a": np.zeros((2, 3))}, 0)
    assert (first["twice"] == 2).all()


def test_bad_arguments(double):
    x = np.ones((2, 3))
    with pytest.raises(rb.InputError, match=r"f: x\['a'\] has shape \(3,\), expected \(2, 3\)"):
        double({"a": x[0]}, 0)
    with pytest.raises(rb.InputError, match=r"x\['a'\] is of type complex128, expected float64"):
        double({"a": x * 1j}, 0)
    with pytest.raises(rb.InputError, match="y is of type str, expected float32"):
        double({"a": x}, "one")
    with pytest.raises(rb.InputError, match="structure"):
        double({"b": x}, 0)
    with pytest.raises(rb.InputError, match="structure"):
        double(x)
    plain = rb.compile(lambda i, x: x[i], 0, np.ones(3))
    with pytest.raises(rb.InputError, match="got 1 arguments, expected 2"):
        plain(0)
    with pytest.raises(rb.InputError, match="i is of type float, expected int"):
        plain(0.5, np.ones(3))
    with pytest.raises(rb.InputError, match="x is traced"):
        jax.jit(lambda x: plain(0, x))(np.ones(3))
    with pytest.raises(rb.InputError, match="every example argument must be an array or a number"):
        rb.compile(lambda name, x: x, "base", np.ones(3))
    with pytest.raises(rb.InputError, match="numpy has no dtype key<fry>"):
        rb.compile(jax.random.uniform, jax.random.key(0))
    with pytest.raises(TypeError, match="got int, expected a function"):
        rb.compile(3, np.ones(3))


def test_threads_run_at_the_same_time():
    def f(x):
        return jax.lax.fori_loop(0, 200_000, lambda k, x: jnp.sin(x) + 0.1, x)

    run = rb.compile(f, np.zeros(3))
    xs = np.random.default_rng(0).normal(size=(16, 3))
    want = [run(x) for x in xs]
    with ThreadPoolExecutor(4) as pool:
        got = list(pool.map(run, xs))
    assert (np.array(got) == np.array(want)).all()


def test_the_gil_is_released():
    def f(x):
        return jax.lax.fori_loop(0, 200_000, lambda k, x: jnp.sin(x) + 0.1, x)

    run, before, orders = rb.compile(f, 0.0), sys.getswitchinterval(), []
    sys.setswitchinterval(1000)  # s: only a released GIL lets another thread in
    try:
        while [1, 2] not in orders and len(orders) < 10:  # a busy machine may be late
            turns: list[int] = []
            worker = threading.Thread(target=lambda t=turns: (run(0.0), t.append(2)))
            other = threading.Thread(target=lambda t=turns: t.append(1))
            for thread in (worker, other):
                thread.start()
            for thread in (worker, other):
                thread.join()
            orders.append(turns)
    finally:
        sys.setswitchinterval(before)
    assert [1, 2] in orders


@pytest.mark.parametrize("native", [True, False])
def test_arguments_by_name(native, monkeypatch):
    def f(q, v, k=2.0, *, mode=None):
        return q - k * v

    if not native:
        monkeypatch.setattr(numpy_call, "layout_is_known", lambda: False)
    with pytest.warns(UserWarning) if not native else contextlib.nullcontext():
        two, three = rb.compile(f, 1.0, 2.0), rb.compile(f, 1.0, 2.0, 3.0)
        one = rb.compile(lambda x: {"y": x["a"]}, {"a": 1.0})
    assert two(q=3.0, v=1.0) == two(3.0, v=1.0) == two(v=1.0, q=3.0) == two(3.0, 1.0) == 1
    assert three(3.0, k=4.0, v=1.0) == -1
    assert one(x={"a": 5.0})["y"] == 5
    with pytest.raises(rb.InputError, match="got an unexpected keyword argument 'w'"):
        two(3.0, v=1.0, w=1.0)
    with pytest.raises(rb.InputError, match="missing a required argument: 'v'"):
        two(q=3.0)
    with pytest.raises(rb.InputError, match="multiple values for argument 'q'"):
        two(3.0, q=3.0)
    with pytest.raises(rb.InputError, match="got 3 arguments, expected 2"):
        two(3.0, 1.0, k=1.0)
    with pytest.raises(rb.InputError, match=r"mode by name only; .*close over it"):
        two(3.0, 1.0, mode=1)


# ------------------------------------------------------------------- cache and fallback


def test_objects_are_kept_beside_jax_s_cache(monkeypatch, tmp_path):
    made, before = [], jax.config.jax_compilation_cache_dir
    make = llvm_jit.compile_object
    monkeypatch.setattr(llvm_jit, "compile_object", lambda m, *how: made.append(m) or make(m, *how))
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path))
        for _ in range(2):
            llvm_jit._codes.clear()  # of this process
            run = rb.compile(lambda x: jnp.cos(x) * 3, 0.0)
            assert run(1.0) == np.cos(1.0) * 3
        assert len(made) == 1 and len(list((tmp_path / "rbjax-threads").glob("*.o"))) == 1
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_without_llvmlite_xla_runs_it(monkeypatch):
    def missing():
        raise llvm_jit.NoCompiler("llvmlite is missing")

    def f(x, k):
        return {"y": x[k] * 2}

    llvm_jit._codes.clear()
    monkeypatch.setattr(llvm_jit, "_llvm", missing)
    with pytest.warns(UserWarning, match="llvmlite is missing; f runs under XLA"):
        run = rb.compile(f, np.zeros(3), 0)
    assert not run.native
    got = run(np.arange(3.0), 2)
    assert type(got["y"]) is np.ndarray and got["y"] == 4
    with pytest.raises(rb.InputError, match=r"x has shape \(2,\)"):
        run(np.zeros(2), 1)


def test_with_an_unknown_layout_of_arrays_xla_runs_it(monkeypatch):
    monkeypatch.setattr(numpy_call, "TYPE", numpy_call.DATA)
    numpy_call.layout_is_known.cache_clear()
    try:
        with pytest.warns(UserWarning, match="unknown layout"):
            run = rb.compile(lambda x: x + 1, 1.0)
    finally:
        monkeypatch.undo()
        numpy_call.layout_is_known.cache_clear()
    assert not run.native and run(2.0) == 3
    assert numpy_call.layout_is_known()


def test_what_is_not_supported_runs_under_xla():
    def norm(x):
        return jax.pure_callback(np.linalg.norm, jax.ShapeDtypeStruct((), x.dtype), x)

    with pytest.warns(UserWarning, match="pure_callback, a call back into Python; norm runs"):
        run = rb.compile(norm, np.zeros(2))
    assert run(np.array([3.0, 4.0])) == 5
