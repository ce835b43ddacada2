"""A batch that is sharded over devices stays sharded under XLA: all algorithms, and rollouts."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

import rbjax as rb
from rbjax.dynamics.tracing.devices import on_each_device
from tests.eight_devices import check, mesh, on_eight_devices
from tests.test_registry import MODEL, REGISTRY, samples
from tests.tolerances import F64_TRANSFORM, relative_error

BOTH = P(("a", "b"))
SIZE = 8 * 40


def placed(xs, spec=BOTH):
    return jax.device_put(tuple(map(jnp.asarray, xs)), NamedSharding(mesh(), spec))


def heavier(model, mass):
    return model.replace(bodies=model.bodies.replace(mass=mass))


def child_algorithms():
    """All of them in one program, and their gradient by shared masses."""
    names = sorted({name for entry in REGISTRY.values() for name in entry.arrays} - {"mass", "com"})
    xs = placed(samples(tuple(names), n=SIZE))
    mass, com = (np.asarray(x) for x in (MODEL.bodies.mass, MODEL.bodies.com))

    def everything(model, *xs):
        given = dict(zip(names, xs, strict=True))
        out = {}
        for name, entry in REGISTRY.items():
            arrays = [given[n] for n in entry.arrays if n in given]
            if arrays:
                f = functools.partial(entry.function, model, **entry.rest)
                out[name] = jax.vmap(f)(*arrays)
        return out

    check("algorithms", functools.partial(everything, MODEL), xs,
          sharding=NamedSharding(mesh(), BOTH), sums=0)  # fmt: skip

    def loss(mass, *xs):
        out = everything(heavier(MODEL, mass), *xs)
        return sum((x * x).sum() for name in SOME for x in jax.tree.leaves(out[name]))

    check("by shared masses", jax.grad(loss), (mass, *xs))
    check("by each sample's", jax.vmap(lambda m, c: rb.inertial_parameters(
        MODEL.replace(bodies=MODEL.bodies.replace(mass=m, com=c)))),
        placed((np.tile(mass, (SIZE, 1)), np.tile(com, (SIZE, 1, 1)))), sums=0)  # fmt: skip


SOME = ("forward_dynamics", "inverse_dynamics", "mass_matrix", "forward_kinematics")


@pytest.mark.slow
def test_every_algorithm():
    on_eight_devices(child_algorithms)


def cart_poles():
    """A batch over eight devices: rollouts of it, a policy by weights, a loss by everything."""
    model = rb.load("cart_pole")
    rng = np.random.default_rng(0)
    W = jnp.asarray(rng.normal(size=(1, 4)))
    batch = placed([rng.normal(size=s) for s in ((SIZE, 2), (SIZE, 2), (SIZE, 4, 1))])

    def rolled(q, v, us, mass=model.bodies.mass, **how):
        out = rb.rollout(heavier(model, mass), rb.State(q, v), us, 0.01, **how)
        return out.q, out.v

    def policy(w):
        return lambda t, x: jnp.tanh(w @ jnp.concatenate([x.q, x.v]))

    def loss(q, v, us, w, mass):
        ways = rolled(q, v, us, mass, save_every=2), rolled(q, v, policy(w), mass, steps=4)
        return sum((x[:, -1] ** 2).sum() for x in jax.tree.leaves(ways))

    return model, batch, W, rolled, policy, loss


def by_what_is_shared(name, f, *args):
    """Of arguments that all samples share: one sum over the devices."""

    def total(*x):
        return (f(*x)[0][:, -1] ** 2).sum()

    check(f"by shared masses and {name}", jax.grad(total, (0, 1)), args, sums=1)


def child_rollouts():
    model, (q, v, us), W, rolled, policy, _ = cart_poles()
    where = NamedSharding(mesh(), BOTH)
    check("rollout", rolled, (q, v, us), sharding=where, sums=0)
    check("under a policy", lambda q, v, w: rolled(q, v, policy(w), steps=4), (q, v, W),
          sharding=where, sums=0)  # fmt: skip
    check("along a tangent", lambda q, v, us: jax.jvp(rolled, (q, v, us), (v, q, us)), (q, v, us),
          sharding=where, sums=0)  # fmt: skip

    out = rb.rollout(model, rb.State(q, v), us, 0.01)  # outside of any program
    assert out.q.sharding.is_equivalent_to(where, 3)

    own = jax.shard_map(rolled, mesh=mesh(), in_specs=(BOTH, BOTH, BOTH), out_specs=BOTH)
    check("in shard_map", own, (q, v, us), rolled, where, 0)


def child_gradients():
    """tests/test_meshes.py has quick ones."""
    model, (q, v, us), W, rolled, policy, loss = cart_poles()
    mass, where = model.bodies.mass, NamedSharding(mesh(), BOTH)
    check("by state and controls", jax.grad(lambda *x: loss(*x, W, mass), (0, 1)), (q, v, us),
          sharding=where)  # fmt: skip
    by_what_is_shared("controls", lambda u, m, q, v: rolled(q, v, u, m), us[0], mass, q, v)
    slope = jax.grad(lambda w: (rolled(q, v, policy(w), steps=4)[0] ** 2).sum())
    assert relative_error(slope(W), jax.jit(slope)(W)) <= F64_TRANSFORM
    ways = jax.vmap(lambda u: rolled(q, v, u))
    check("two axes", ways, (jax.device_put(us[:3], NamedSharding(mesh(), P())),), sums=0)
    parted = jax.shard_map(
        lambda *x: jax.lax.psum(loss(*x, W, mass), ("a", "b")),
        mesh=mesh(), in_specs=(BOTH, BOTH, BOTH), out_specs=P(),
    )  # fmt: skip
    check("gradient in shard_map", jax.grad(parted), (q, v, us),
          jax.grad(lambda *x: loss(*x, W, mass)), NamedSharding(mesh(), BOTH))  # fmt: skip
    by_what_is_shared(
        "weights", lambda w, m, q, v: rolled(q, v, policy(w), m, steps=4), W, mass, q, v
    )
    parted = jax.shard_map(
        lambda *x: jax.lax.psum(loss(*x), ("a", "b")),
        mesh=mesh(), in_specs=(BOTH, BOTH, BOTH, P(), P()), out_specs=P(),
    )  # fmt: skip
    shared = jax.grad(parted, (3, 4)), (q, v, us, W, mass), jax.grad(loss, (3, 4))
    check("gradient in shard_map by what is shared", *shared)


@pytest.mark.slow  # tests/test_meshes.py has some
def test_rollouts():
    on_eight_devices(child_rollouts)


@pytest.mark.slow
def test_two_axes_and_gradients():
    on_eight_devices(child_gradients)


@pytest.mark.parametrize("size", [320, 12, 7, 1])
def test_parts_are_the_batch(monkeypatch, size):
    """The same on one device, emulating eight."""
    monkeypatch.setattr("rbjax.dynamics.tracing.devices.devices", lambda: 8)
    x, y = np.arange(2.0 * size).reshape(size, 2), np.array([3.0, 4.0])
    product = lambda a: a[0] * a[1]  # noqa: E731
    got = on_each_device(product, [x, y], [0, None], size)([x, y])
    np.testing.assert_array_equal(got, x * y)
