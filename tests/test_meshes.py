"""Batches on a mesh of explicit axes, as `jax.make_mesh` makes it; eight simulated devices."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P
from jax.tree_util import Partial

import rbjax as rb
from rbjax.compiler.jax.function import compile_threads
from tests.eight_devices import check, on_eight_devices
from tests.test_registry import MODEL, REGISTRY, samples
from tests.tolerances import F64_TRANSFORM, relative_error

BATCH = P("batch")
SIZE = 8 * 40


def line():
    mesh = jax.make_mesh((8,), ("batch",))
    assert mesh.axis_types == (AxisType.Explicit,)
    return mesh


def placed(mesh, xs, spec=BATCH):
    return jax.device_put(tuple(map(jnp.asarray, xs)), NamedSharding(mesh, spec))


def cart_pole(mesh, *more, spec=BATCH, size=SIZE):
    """The model, and a batch of q, v and arrays of these shapes."""
    rng = np.random.default_rng(0)
    shapes = ((size, 2), (size, 2), *more)
    return rb.load("cart_pole"), *placed(mesh, [rng.normal(size=s) for s in shapes], spec)


def heavier(model, mass):
    return model.replace(bodies=model.bodies.replace(mass=mass))


def act(w, t, x):
    """A policy of all that JAX keeps programs and rules for."""
    y = jax.lax.scan(lambda c, _: (jnp.tanh(w.T @ (w @ c)), None), x.q, None, length=2)[0]
    return jax.nn.relu(jax.jit(lambda y: w @ y)(y)) + jax.nn.softplus(y[:1]) * jnp.cos(t)


def child_algorithms():
    mesh = line()
    model, q, v = cart_pole(mesh)
    where = NamedSharding(mesh, BATCH)

    def both(q, v, mass=model.bodies.mass):
        m = heavier(model, mass)
        return jax.vmap(lambda q, v: (rb.mass_matrix(m, q), rb.forward_dynamics(m, q, v, v)))(q, v)

    def loss(*args):
        return sum((x**2).sum() for x in both(*args))

    check("values, mesh set", both, (q, v), sharding=where, sums=0, mesh=mesh)
    check("gradient", jax.grad(loss, (0, 1)), (q, v), sharding=where)
    check("by shared masses", jax.grad(loss, 2), (q, v, model.bodies.mass), sums=1)
    for x, y in zip(both(q, v), jax.jit(both)(q, v), strict=True):  # outside of any program
        assert x.sharding.is_equivalent_to(where, x.ndim)
        assert relative_error(x, y) <= F64_TRANSFORM
    with jax.set_mesh(mesh):
        there = rb.load("cart_pole")  # its numbers lie on the mesh
    mass_matrix, on_one = (jax.vmap(functools.partial(rb.mass_matrix, m)) for m in (there, model))
    check("a model there", mass_matrix, (q,), on_one, where, mesh=mesh)

    two = jax.make_mesh((4, 2), ("a", "b"))
    for spec in P("a"), P(("a", "b")):
        _, q, v = cart_pole(two, spec=spec)
        check(str(spec), both, (q, v), sharding=NamedSharding(two, spec), sums=0)

    (w,) = placed(mesh, [np.ones((1, 2))], P())
    f = compile_threads(lambda w, x: act(w, 0.0, rb.State(x, x)))
    out = jax.vmap(f, (None, 0))(w, cart_pole(mesh)[1])
    assert out.sharding.is_equivalent_to(where, 2)
    assert np.isfinite(out).all()


def child_rollouts(kernel):
    mesh = line()
    model, q, v, us = cart_pole(mesh, (SIZE, 4, 1))
    mass, where = model.bodies.mass, NamedSharding(mesh, BATCH)
    shared, weights = placed(mesh, [np.ones((4, 1)), np.ones((1, 2))], P())

    def rolled(q, v, ctrls, mass=mass):
        m = heavier(model, mass)
        out = rb.rollout(m, rb.State(q, v), ctrls, 0.01, steps=4, kernel=kernel)
        return out.q, out.v

    def loss(q, v, ctrls, mass=mass):
        return (rolled(q, v, ctrls, mass)[0][:, -1] ** 2).sum()

    def by_weights(w, q, v):
        return loss(q, v, Partial(act, w))

    check("values, mesh set", rolled, (q, v, us), sharding=where, sums=0, mesh=mesh)
    everywhere = jax.sharding.reshard((q, v), NamedSharding(mesh, P()))
    check("controls alone", rolled, (*everywhere, us), sharding=where, sums=0)
    check("own", jax.grad(loss, (0, 1, 2)), (q, v, us), sharding=where, sums=0)
    # XLA's vmap adds up the gradients of arrays that samples share in each step, inside the loop;
    # on threads they are added up once, after it (`child_rollouts_on_threads`)
    check("shared", jax.grad(loss, (2, 3)), (q, v, shared, mass))
    for w in jnp.ones((1, 2)), weights:
        check("weights", jax.grad(by_weights), (w, q, v))
    closed = jax.jit(lambda u: rolled(q, v, u))  # over a batch
    for out in rolled(q, v, us), closed(us), closed(shared):
        assert out[0].sharding.is_equivalent_to(where, 3)
    policy = functools.partial(act, weights)  # what it reads is operands, but not within a program
    assert relative_error(rolled(q, v, policy)[0], rolled(q, v, Partial(act, weights))[0]) == 0
    with pytest.raises(rb.InputError, match=r"closes over .* explicit axes.*tree_util.Partial"):
        jax.jit(lambda q: rolled(q, v, policy))(q)


def child_simulate():
    mesh = line()
    model, q, v = cart_pole(mesh, size=8)
    (w,) = placed(mesh, [np.ones((1, 2))], P())

    def one(w, q, v):
        control = Partial(act, w)
        out = rb.simulate(model, rb.State(q, v), jnp.linspace(0, 0.02, 3), control, dt=0.01)
        return out.q

    many = jax.vmap(one, (None, 0, 0))
    check("simulate", many, (w, q, v), sharding=NamedSharding(mesh, BATCH))


def child_registry():
    """Every algorithm in one program."""
    mesh = line()
    names = sorted({name for entry in REGISTRY.values() for name in entry.arrays} - {"mass", "com"})

    def everything(*xs):
        given = dict(zip(names, xs, strict=True))
        out = {}
        for name, entry in REGISTRY.items():
            arrays = [given[n] for n in entry.arrays if n in given]
            if arrays:
                f = functools.partial(entry.function, MODEL, **entry.rest)
                out[name] = jax.vmap(f)(*arrays)
        return out

    xs = placed(mesh, samples(tuple(names), n=SIZE))
    check("algorithms", everything, xs, sharding=NamedSharding(mesh, BATCH), sums=0)


def child_rollouts_on_threads():
    child_rollouts(True)


def child_motions_on_lanes():
    child_simulate()
    child_rollouts(False)


def test_algorithms():
    on_eight_devices(child_algorithms)


@pytest.mark.slow  # tests/compiler/test_sharding.py has a rollout
def test_motions():
    on_eight_devices(child_motions_on_lanes)


@pytest.mark.slow
def test_rollouts_on_threads():
    on_eight_devices(child_rollouts_on_threads)


@pytest.mark.slow
def test_every_algorithm():
    on_eight_devices(child_registry)
