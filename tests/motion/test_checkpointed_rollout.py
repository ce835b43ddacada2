"""Rollouts as threads: values and gradients of a plain scan, and those of `kernel=False`."""

from __future__ import annotations

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import jaxpr_as_fun

import rbjax as rb
from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import traced
from rbjax.compiler.jax.saved import SavedVjp
from rbjax.dynamics.tracing.operations import operation_count
from rbjax.forces.inputs import Inputs
from rbjax.model import State
from rbjax.motion.checkpointed_rollout import CheckpointedRollout, checkpoint_interval
from rbjax.motion.field import Field
from rbjax.motion.integrators import semi_implicit_euler
from tests.compiler.host import COMPILER, many_on_host
from tests.tolerances import F64_IDENTITY, F64_TRANSFORM, relative_error

threaded = importlib.import_module("rbjax.motion.threaded")
STEPS, BATCH, N, NU = 12, 5, 3, 2
RNG = np.random.default_rng(0)
OTHER, Q, V = RNG.normal(size=N), RNG.normal(size=(BATCH, N)), RNG.normal(size=(BATCH, N))
US = RNG.normal(size=(BATCH, STEPS, NU))
#: save_every, k, and whether the residuals of the steps are kept
KEPT = [
    (12, 4, False), (4, 1, True), (4, 4, False), (4, 2, False), (1, 1, False), (12, 1, False),
    (12, 12, False), (1, 1, True),
]  # fmt: skip
SLOW = pytest.mark.slow


def agree(got, want, tolerance: float = F64_TRANSFORM) -> None:
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
        assert relative_error(a, b) <= tolerance


# ------------------------------------------------------------------- March against a scan


def step(i, q, v, u, w):
    swing = checkpoint_name(jnp.sin(q), "factors")
    v = v + 0.1 * (swing * swing * w + u.sum() - 0.01 * i * v)
    return [q + 0.1 * v, v]


def undriven(i, q, v, w):
    return step(i, q, v, jnp.zeros(NU), w)


def checkpointed(save_every: int, k: int, keep_residuals: bool = False, driven: bool = True):
    shapes = [(N,), (N,), *[(NU,)] * driven, (N,)]
    avals = [jax.ShapeDtypeStruct(s, jnp.float64) for s in shapes]
    one = traced(step if driven else undriven, jax.ShapeDtypeStruct((), jnp.int32), *avals)
    return CheckpointedRollout(one, 2, STEPS, save_every, driven, k, keep_residuals).program()


def scanned(save_every: int):
    def f(q, v, us, w):
        def once(c, x):
            c = tuple(step(x[0], *c, x[1], w))
            return c, c

        _, paths = jax.lax.scan(once, (q, v), (jnp.arange(STEPS, dtype=jnp.int32), us))
        starts = zip((q, v), paths, strict=True)
        return [jnp.concatenate([x[None], path[save_every - 1 :: save_every]])
                for x, path in starts]  # fmt: skip

    return f


def weighed(f):
    """A sum over the batch to which every kept state contributes with another weight."""

    def loss(w, q, v, us):
        axes = (0, 0, 0 if us.ndim == 3 else None, None)
        qs, vs = jax.vmap(f, axes)(q, v, us, w)
        return (jnp.sin(qs) * jnp.arange(qs.shape[1])[:, None]).sum() + (vs[:, -1] ** 2).sum()

    return loss


@pytest.mark.parametrize(
    ("save_every", "k", "keep_residuals"),
    [*KEPT[:2], *(pytest.param(*x, marks=SLOW) for x in KEPT[2:])],
)
def test_a_checkpointed_rollout_is_a_scan(save_every, k, keep_residuals):
    program, want = checkpointed(save_every, k, keep_residuals), scanned(save_every)

    @jax.jit
    def both(w, q, v, us):
        found = []
        for f in (lambda *args: run(program, args), want):
            gradient = jax.value_and_grad(weighed(f), (0, 1, 2, 3))
            own, shared = gradient(w, q, v, us), gradient(w, q, v, us[0])
            some = jax.grad(weighed(f), 2)(w, q, v, us)
            forward = jax.jvp(jax.vmap(f, (0, 0, 0, None)), (q, v, us, w), (v, q, us, w))
            found.append([own, shared, some, forward])
        return found

    agree(*both(OTHER, Q, V, US), F64_IDENTITY)


@pytest.mark.parametrize("k", [3, pytest.param(1, marks=SLOW)])
def test_a_checkpointed_rollout_without_controls(k):
    program, want = checkpointed(6, k, driven=False), scanned(6)

    def last(f):
        def loss(w):
            qs, _ = jax.vmap(lambda q, v: f(q, v, w))(Q, V)
            return (qs[:, -1] ** 2).sum()

        return jax.jit(jax.value_and_grad(loss))

    got = last(lambda *args: run(program, args))
    agree(got(OTHER), last(lambda q, v, w: want(q, v, jnp.zeros((STEPS, NU)), w))(OTHER))


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("kept", [KEPT[:2], pytest.param(KEPT[2:], marks=SLOW)])
def test_emitted_states_and_cotangents(kept):
    w = np.tile(OTHER, (BATCH, 1))
    cases, wants = [], []
    for save_every, k, keep_residuals in kept:
        program, plain = checkpointed(save_every, k, keep_residuals), scanned(save_every)
        states = jax.vmap(plain)(Q, V, US, w)
        bars = [RNG.normal(size=x.shape) for x in states]
        keeping = program.forward_with_residuals((True,) * 4)
        found = jax.vmap(keeping)(Q, V, US, w)
        agree(found[:2], states)
        assert found[-1].shape == ((BATCH, STEPS, N) if keep_residuals else found[-1].shape)
        pull = program.transposed((True,) * 4, (True, True))
        cases += [(program, (Q, V, US, w)), (keeping, (Q, V, US, w))]
        cases.append((pull, (Q, V, US, w, *found[program.first_residual :], *bars)))

        def back(q, v, us, w, *bars, plain=plain):
            return jax.vjp(plain, q, v, us, w)[1](list(bars))

        wants += [states, found, jax.vmap(back)(Q, V, US, w, *bars)]
    for got, want in zip(many_on_host(cases), wants, strict=True):
        agree(list(got), list(want), F64_IDENTITY)


def test_a_step_leaves_what_is_named():
    """The acceleration and the factors, which are no zeros, and no more."""
    model = rb.load("arm7")
    one = [jax.ShapeDtypeStruct((7,), jnp.float64)] * 2
    field = Field(model)

    def step_of(q, v):
        return jax.tree.leaves(semi_implicit_euler(field, 0.0, State(q, v), Inputs(), 0.01))

    step = traced(step_of, *one)
    pull = SavedVjp.of(step, (True, True))
    assert pull is SavedVjp.of(step, (True, True))
    assert 14 < pull.residuals.size <= 7 + 7 * 7 and pull.bytes == 8 * pull.residuals.size
    q, v, bars = Q[0, [0] * 7], V[0, [1] * 7], [jnp.arange(7.0), jnp.ones(7)]
    *new, left = pull.forward(q, v)
    agree(new, step(q, v))
    agree(pull([q, v], left, bars), list(jax.vjp(lambda *x: step(*x), q, v)[1](bars)))
    slower = jax.make_jaxpr(lambda *x: jax.vjp(lambda *x: step(*x), *x)[1](bars))(q, v)
    faster = jax.make_jaxpr(lambda q, v, left: pull([q, v], left, bars))(q, v, left)
    counts = [operation_count(jaxpr_as_fun(f), *f.in_avals).total for f in (slower, faster)]
    assert counts[1] < 0.8 * counts[0]


def test_what_is_kept_fits_into_the_memory():
    for save_every in (1, 7, 24, 100):
        for budget in (0, 100, 399, 400, 1e9):
            k = checkpoint_interval(save_every, 4 * save_every, 4, budget)
            assert save_every % k == 0
            divisors = [d for d in range(1, save_every + 1) if save_every % d == 0]
            fit = [d for d in divisors if 4 * save_every // d * 4 <= budget]
            assert k == (min(fit) if fit else save_every)


# ------------------------------------------------------------------- rollouts

SAMPLES, MARCHED = 3, 6


def given(scene: str):
    model, key = rb.load(scene), jax.random.key(0)
    state = jax.vmap(model.random_state)(jax.random.split(key, SAMPLES))
    us = 0.3 * jax.random.normal(key, (SAMPLES, MARCHED, model.nu))
    return model, state, us, 0.1 * jax.random.normal(key, (model.nu, model.nv))


def heavier(model, mass):
    return model.replace(bodies=model.bodies.replace(mass=mass))


def size(path: rb.Trajectory):
    return (path.q**2).sum() + jnp.sin(path.v).sum()


def compare(f, *args) -> None:
    """f(kernel, *args), with True and with False."""
    got, want = (
        jax.jit(lambda *a, kernel=kernel: f(kernel, *a))(*args) for kernel in (True, False)
    )
    agree(got, want, F64_IDENTITY)


def mostly_slow(*quick: str) -> list:
    """Robots and integrators with their checks: the slow ones are marked."""
    return [
        ("cart_pole", "semi_implicit_euler", quick),
        pytest.param("cart_pole", "variational_midpoint", quick, marks=SLOW),
        pytest.param("quadrotor", "variational_midpoint", (), marks=SLOW),
        pytest.param("cart_pole", "semi_implicit_euler", (), marks=SLOW),
        pytest.param("cart_pole", "rk4", (), marks=SLOW),
        pytest.param("arm7", "semi_implicit_euler", (), marks=SLOW),
        pytest.param("quadrotor", "semi_implicit_euler", (), marks=SLOW),
    ]


@pytest.mark.parametrize(("scene", "integrator", "some"), mostly_slow("own controls"))
def test_controls_and_masses(scene, integrator, some):
    model, state, us, _ = given(scene)

    def f(kernel, q, v, us, mass):
        def loss(q, v, us, mass, memory=2.0**31):
            return size(rb.rollout(
                heavier(model, mass), rb.State(q, v), us, 0.01, integrator=integrator,
                save_every=3, kernel=kernel, memory=memory,
            ))  # fmt: skip

        def one(mass, q, v, us):
            return loss(q, v, us, mass)

        along = jax.tree.map(jnp.cos, (q, v, us, mass))
        masses = mass * jnp.linspace(0.5, 2, SAMPLES)[:, None]
        every = {
            "own controls": lambda: jax.value_and_grad(loss, (0, 1, 2, 3))(q, v, us, mass),
            "shared controls": lambda: jax.grad(loss, (2, 3))(q, v, us[0], mass),
            "little memory": lambda: jax.grad(lambda us: loss(q, v, us, mass, 1.0))(us),
            "own masses": lambda: jax.vmap(jax.grad(one))(masses, q, v, us),
            "one sample": lambda: jax.grad(loss)(q[0], v[0], us[0], mass),
            "forward": lambda: jax.jvp(loss, (q, v, us, mass), along),
        }
        return [every[name]() for name in some or every]

    compare(f, state.q, state.v, us, model.bodies.mass)


@pytest.mark.parametrize(("scene", "integrator", "some"), mostly_slow("batch"))
@pytest.mark.parametrize("where", ["in the thread", "between the steps"])
def test_a_policy(scene, integrator, some, where, monkeypatch):
    if where == "between the steps":
        monkeypatch.setattr(threaded, "POLICY_UP_TO", 0)
    model, state, _, weights = given(scene)

    def f(kernel, q, v, weights, mass):
        def loss(q, v, weights, mass, memory=2.0**31):
            return size(rb.rollout(
                heavier(model, mass), rb.State(q, v), lambda t, s: weights @ jnp.tanh(s.v) + t,
                0.01, steps=MARCHED, integrator=integrator, save_every=3, kernel=kernel,
                memory=memory,
            ))  # fmt: skip

        every = {
            "batch": lambda: jax.value_and_grad(loss, (0, 1, 2, 3))(q, v, weights, mass),
            "little memory": lambda: jax.grad(lambda w: loss(q, v, w, mass, 1.0))(weights),
            "one sample": lambda: jax.grad(loss, 2)(q[0], v[0], weights, mass),
            "forward": lambda: jax.jvp(
                lambda w: loss(q, v, w, mass), (weights,), (jnp.cos(weights),)
            ),
        }
        return [every[name]() for name in some or every]

    compare(f, state.q, state.v, weights, model.bodies.mass)


def test_eager_states():
    """Outside of jit, of one state and of a batch."""
    model, state, us, _ = given("cart_pole")
    for s, u in ((state, us), (jax.tree.map(lambda x: x[0], state), us[0])):
        got, want = (
            rb.rollout(model, s, u, 0.01, steps=MARCHED, kernel=kernel) for kernel in (True, False)
        )
        agree(got, want)
