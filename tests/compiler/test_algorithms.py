"""Every public algorithm as a thread: its emitted C against XLA, and the path taken on a GPU."""

from __future__ import annotations

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.shared.robots import as_model, compiled, states
from rbjax.dynamics.drivers.choice import on_threads
from tests.compiler.host import COMPILER, many_on_host
from tests.dynamics.test_limbs import CART, walker
from tests.robots import robot
from tests.test_registry import REGISTRY
from tests.tolerances import F32_MAX, F64_IDENTITY, F64_PARITY, relative_error

BATCH = 3
FEW = ("forward_dynamics", "inverse_dynamics", "integrate", "jacobian", "frame_velocity")
ROBOTS = {
    "small": (lambda: robot("small", "unrolled"), {"body": "hand"}, {"site": "tip"}),
    "double_pendulum": (lambda: robot("double_pendulum", "unrolled"), {}, {}),
    "limbs": (lambda: walker(text=CART), {"body": 3}, {"site": "hand1"}),
}
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")


def given(sample, names: tuple[str, ...]) -> list[np.ndarray]:
    """Three of each named array."""
    q, v = sample.states(2 * BATCH)
    rng, m = np.random.default_rng(0), sample.model
    bodies = m.bodies
    drawn = {
        "q": q[:BATCH],
        "q1": q[BATCH:],
        "v": v[:BATCH],
        "a": rng.normal(size=(BATCH, m.nv)),
        "ctrl": rng.uniform(-0.4, 0.4, (BATCH, m.nu)),
        "wrenches": rng.normal(size=(BATCH, m.nb, 6)),
        "mass": np.asarray(bodies.mass) * rng.uniform(0.5, 2, (BATCH, m.nb)),
        "com": np.asarray(bodies.com) + rng.normal(size=(BATCH, m.nb, 3)),
        "point": rng.normal(size=(BATCH, 3)),
    }
    return [drawn[name] for name in names]


def of_a_sample(name: str, on: str):
    """An algorithm as a function of arrays, and arguments for a batch."""
    load, body, site = ROBOTS[on]
    sample, entry = load(), REGISTRY[name]
    rest = {**entry.rest}
    if "body" in rest:
        rest |= {"body": sample.model.body_names[3]} if body["body"] == 3 else body
    if "site" in rest:
        rest |= site

    def f(*arrays):
        return jax.tree.leaves(entry.function(sample.model, *arrays, **rest))

    return f, given(sample, entry.arrays)


def agree(got, want, tolerance: float = F64_IDENTITY) -> None:
    for g, w in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert g.dtype == w.dtype
        assert relative_error(g, w, batch_dims=1).max() <= tolerance


def by_xla(f, args):
    return jax.jit(jax.vmap(f))(*args)


PARTS = [
    ("small", FEW),
    *(
        pytest.param(on, [n for n in REGISTRY if on != "small" or n not in FEW][k::4],
                     marks=pytest.mark.slow)
        for on in ("small", "limbs") for k in range(4)
    ),
]  # fmt: skip


@needs_compiler
@pytest.mark.parametrize(("on", "names"), PARTS)
def test_emitted_c(on, names):
    cases = [of_a_sample(name, on) for name in names]
    for (f, args), got in zip(cases, many_on_host(cases, ("-O0",)), strict=True):
        agree(got, by_xla(f, args))


# ------------------------------------------------------------------- robots of the figures


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda", "humanoid", "g1"])
def test_large_robots_in_both_precisions(name):
    """With the driver of threads; f32 against f64, whose reference is XLA's."""
    reference = compiled(name)
    model = on_threads(as_model(reference), np.float32)
    args = states(reference, BATCH)

    def dynamics(q, v, a):
        return [
            rb.forward_dynamics(model, q, v, a), rb.inverse_dynamics(model, q, v, a),
            rb.mass_matrix(model, q),
        ]  # fmt: skip

    def derivatives(q, v, a):
        return rb.inverse_dynamics_derivatives(model, q, v, a)

    def gradient(q, v, a):
        return jax.vjp(lambda *x: rb.inverse_dynamics(model, *x), q, v, a)[1](jnp.cos(a))

    single = [x.astype(np.float32) for x in args]
    fs = (dynamics, derivatives, gradient)
    wants = [by_xla(f, args) for f in fs]
    got = many_on_host([(f, a) for f in fs for a in (args, single)], ("-O0",))
    for want, double, f32 in zip(wants, got[::2], got[1::2], strict=True):
        agree(double, want, F64_PARITY)
        for g, w in zip(jax.tree.leaves(f32), jax.tree.leaves(want), strict=True):
            assert g.dtype == np.float32
            assert relative_error(g, w, batch_dims=1).max() <= F32_MAX


# ------------------------------------------------------------------- the path of a GPU


@pytest.fixture
def switch(monkeypatch):
    """Whether there is a GPU, for those who ask."""

    def turn(on: bool) -> None:
        jax.clear_caches()
        for name in ("dynamics.tracing.algorithm", "motion.rollout"):
            module = importlib.import_module(f"rbjax.{name}")
            monkeypatch.setattr(module, "kernels_available", lambda: on)

    yield turn
    monkeypatch.undo()
    jax.clear_caches()


def everything(names, on: str):
    """Values, one of them eager, and derivatives of a batch, forward and in reverse."""
    cases = {name: of_a_sample(name, on) for name in names}

    def some(args):
        found = {}
        for name, (f, _) in cases.items():
            mapped, xs = jax.vmap(f), args[name]
            value, rate = jax.jvp(mapped, xs, jax.tree.map(jnp.cos, xs))
            bars = jax.tree.map(jnp.sin, value)
            shared = jax.vmap(f, (*[0] * (len(xs) - 1), None))
            last = [*xs[:-1], xs[-1][0]]
            found[name] = {
                "value": value, "jvp": rate, "vjp": jax.vjp(mapped, *xs)[1](bars),
                "one": f(*(x[0] for x in xs)),
            }  # fmt: skip
            if len(xs) > 1:
                found[name]["shared"] = jax.vjp(shared, *last)[1](bars)
        return found

    f, xs = cases[names[0]]
    eager = f(*(x[0] for x in xs)), jax.vmap(f)(*xs)
    run = jax.jit(some)
    return eager, run({name: xs for name, (_, xs) in cases.items()})


# a derivative of derivatives is a program of a minute
LARGE = ("forward_dynamics_derivatives", "inverse_dynamics_derivatives")
MOST = [n for n in REGISTRY if n not in LARGE and n not in FEW]
GPU = [
    ("double_pendulum", ["forward_dynamics"]),
    pytest.param("small", ["jacobian"], marks=pytest.mark.slow),
    *(pytest.param("small", names, marks=pytest.mark.slow)
      for names in (FEW, MOST[::3], MOST[1::3], MOST[2::3])),
    pytest.param("limbs", ["forward_dynamics", "mass_matrix"], marks=pytest.mark.slow),
]  # fmt: skip


@pytest.mark.parametrize(("on", "names"), GPU)
def test_the_path_of_a_gpu(on, names, switch):
    switch(False)
    want = everything(names, on)
    switch(True)
    f, xs = of_a_sample(names[0], on)
    assert "threads[" in str(jax.make_jaxpr(jax.vmap(f))(*xs))
    for g, w in zip(jax.tree.leaves(everything(names, on)), jax.tree.leaves(want), strict=True):
        assert g.dtype == w.dtype and relative_error(g, w) <= F64_IDENTITY


def test_a_rollout_takes_it_too(switch):
    model = rb.load("cart_pole")
    state = rb.State(jnp.ones((4, 2)), jnp.ones((4, 2)))

    def last(kernel=None):
        return lambda q: rb.rollout(model, rb.State(q, state.v), None, 0.01, steps=3,
                                    kernel=kernel).q  # fmt: skip

    switch(True)
    assert "threads[" in str(jax.make_jaxpr(last())(state.q))
    assert "threads[" not in str(jax.make_jaxpr(last(False))(state.q))
    assert relative_error(jax.jit(last())(state.q), jax.jit(last(False))(state.q)) <= F64_IDENTITY
