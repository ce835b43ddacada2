"""A batch that is sharded over devices stays sharded, on eight simulated ones."""

from __future__ import annotations

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

import rbjax as rb
from rbjax.compiler.jax.function import compile_threads
from tests.eight_devices import check, mesh, on_eight_devices
from tests.tolerances import F64_TRANSFORM, relative_error

threaded_rollout, places = (
    importlib.import_module(f"rbjax.{name}")
    for name in ("motion.threaded", "dynamics.tracing.devices")
)


def f(x, w):
    return jnp.tanh(w @ x)


def loss(h):
    return lambda x, w: (jax.vmap(h, (0, None))(x, w) ** 2).sum()


def mapped(h):
    return jax.vmap(h, (0, None))


def child_functions():
    devices, both = mesh(), P(("a", "b"))
    rng = np.random.default_rng(0)
    W, X = jnp.asarray(rng.normal(size=(5, 3))), jnp.asarray(rng.normal(size=(16, 3)))
    g = compile_threads(f)
    for spec in (P("a"), both):
        where = NamedSharding(devices, spec)
        x = jax.device_put(X, where)
        check("values", mapped(g), (x, W), mapped(f), where, 0)
        check("gradient, own and shared", jax.grad(loss(g), (0, 1)), (x, W),
              jax.grad(loss(f), (0, 1)), where, 1, spread=1)  # fmt: skip
        check("jacfwd", mapped(jax.jacfwd(g)), (x, W), mapped(jax.jacfwd(f)), where, 0)

    closed = compile_threads(lambda x: f(x, W))
    check("of what is closed over", jax.vmap(closed), (x,), lambda x: mapped(f)(x, W), where, 0)

    last = NamedSharding(devices, P(None, ("a", "b")))
    check("batch last", lambda x: jax.vmap(g, (-1, None), -1)(x, W), (jax.device_put(X.T, last),),
          lambda x: jax.vmap(f, (-1, None), -1)(x, W), last, 0)  # fmt: skip

    def pairs(h):
        return jax.vmap(jax.vmap(h, (0, None)), (None, 0))

    ws = jax.device_put(jnp.stack([W, -W]), NamedSharding(devices, P("b")))
    x = jax.device_put(X, NamedSharding(devices, P("a")))
    check("two axes", pairs(g), (x, ws), pairs(f), NamedSharding(devices, P("b", "a")), 0)

    # both axes of the batch are sharded over one axis of the mesh: one of them moves
    a, ws = NamedSharding(devices, P("a")), jnp.stack([W, -W, 2 * W, 3 * W])
    for one, other in ((a, a), (NamedSharding(devices, both), a), (a, NamedSharding(devices, P()))):
        x, w = jax.device_put(X, one), jax.device_put(ws, other)
        got = jax.jit(pairs(g))(x, w)
        assert relative_error(got, jax.jit(pairs(f))(X, ws)) <= F64_TRANSFORM
        slopes = [jax.jit(jax.grad(lambda x, w, h=h: (pairs(h)(x, w) ** 2).sum(), (0, 1)))(x, w)
                  for h in (g, f)]  # fmt: skip
        for p, q in zip(*slopes, strict=True):
            assert relative_error(p, q) <= F64_TRANSFORM

    def own(h):
        return jax.shard_map(mapped(h), mesh=devices, in_specs=(both, P()), out_specs=both)

    where = NamedSharding(devices, both)
    x = jax.device_put(X, where)
    check("shard_map", own(g), (x, W), mapped(f), where, 0)
    total = jax.shard_map(
        lambda x, w: jax.lax.psum(loss(g)(x, w), ("a", "b")),
        mesh=devices, in_specs=(both, P()), out_specs=P(),
    )  # fmt: skip
    check("its gradient", jax.grad(total, (0, 1)), (x, W), jax.grad(loss(f), (0, 1)), where,
          spread=1)  # fmt: skip


def rollouts():
    """A batch of carts over eight devices, and a loss of rollouts, with its gradient."""
    model, where = rb.load("cart_pole"), NamedSharding(mesh(), P(("a", "b")))
    state = jax.vmap(model.random_state)(jax.random.split(jax.random.key(0), 16))
    q, v = jax.device_put((state.q, state.v), where)
    masses, us = model.bodies.mass, jnp.zeros((4, 1))

    def loss(mass, q, v, us, kernel):
        heavier = model.replace(bodies=model.bodies.replace(mass=mass))
        out = rb.rollout(heavier, rb.State(q, v), us, 0.01, kernel=kernel)
        return (out.q[:, -1] ** 2).sum(), out.q

    def rolled(kernel):
        gradient = jax.grad(loss, (0, 1, 3), has_aux=True)

        def f(q, v):
            (mass, q_bar, u_bar), path = gradient(masses, q, v, us, kernel)
            return path, q_bar, mass, u_bar

        return f

    return model, (q, v), where, loss, rolled


def child_rollouts():
    model, (q, v), where, _, rolled = rollouts()
    check("rollout", rolled(True), (q, v), rolled(False), where, spread=2)

    def by_weights(kernel):
        def total(w, q, v):
            def policy(t, x):
                return jnp.tanh(w @ x.q)

            out = rb.rollout(model, rb.State(q, v), policy, 0.01, steps=4, kernel=kernel)
            return (out.q[:, -1] ** 2).sum()

        return jax.grad(total)

    threaded_rollout.POLICY_UP_TO = 0  # a network between the steps
    check("by weights", by_weights(True), (jnp.ones((1, 2)), q, v), by_weights(False), sums=1)


def child_in_shard_map():
    model, (q, v), where, loss, rolled = rollouts()
    devices, both = where.mesh, where.spec
    masses, us = model.bodies.mass, jnp.zeros((4, 1))

    def rolled_there(q, v):
        def total(mass, q, v):
            return jax.lax.psum(loss(mass, q, v, us, True)[0], ("a", "b"))

        own = jax.shard_map(total, mesh=devices, in_specs=(P(), both, both), out_specs=P())
        mass, q_bar = jax.grad(own, (0, 1))(masses, q, v)
        return q_bar, mass

    def own_masses(kernel):
        def one(mass, q, v):
            return loss(mass, q[None], v[None], us, kernel)[0]

        return lambda *x: jax.vmap(jax.grad(one, (0, 1)))(*x)

    each = jax.device_put(masses * (1 + q[:, :1] ** 2), where)
    own = jax.shard_map(own_masses(True), mesh=devices, in_specs=(both,) * 3, out_specs=both)
    check("own masses in shard_map", own, (each, q, v), own_masses(False), where, 0)
    check("in shard_map", rolled_there, (q, v), lambda q, v: rolled(False)(q, v)[1:3], where,
          spread=1)  # fmt: skip


def test_memory_is_that_of_each_device(monkeypatch):
    """A batch as large again on two devices keeps as many states a sample as on one."""
    model, steps = rb.load("cart_pole"), 100
    us = jnp.zeros((steps, 1))

    def kept(size, devices):
        monkeypatch.setattr(places, "devices", lambda: devices)

        def loss(q):
            out = rb.rollout(model, rb.State(q, q), us, save_every=steps, kernel=True)
            return (out.q**2).sum()

        text = str(jax.make_jaxpr(jax.grad(loss))(jax.ShapeDtypeStruct((size, 2), jnp.float64)))
        return next(n for n in (100, 50, 25) if f"[{n},2,{size}]" in text)

    n = places.memory_share() // places.devices() // 2**12  # 2**19 without a GPU
    assert [kept(n, 1), kept(2 * n, 1), kept(2 * n, 2), kept(4 * n, 2)] == [100, 50, 100, 50]


def child():
    child_functions()
    child_rollouts()


@pytest.mark.slow
def test_functions_and_rollouts():
    on_eight_devices(child)


@pytest.mark.slow
def test_rollouts_in_shard_map():
    on_eight_devices(child_in_shard_map)
