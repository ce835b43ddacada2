"""A batch that is spread over devices stays spread, on eight simulated ones."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

CHILD = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
jax.config.update("jax_enable_x64", True)
import rbjax as rb
from rbjax.threads.function import threaded
from tests.tolerances import F64_TRANSFORM, relative_error

assert jax.device_count() == 8
mesh = Mesh(np.array(jax.devices()).reshape(4, 2), ("a", "b"))
both, rows = P(("a", "b")), NamedSharding(mesh, P("a"))
rng = np.random.default_rng(0)
W, X = jnp.asarray(rng.normal(size=(5, 3))), jnp.asarray(rng.normal(size=(16, 3)))

def f(x, w):
    return jnp.tanh(w @ x)

def loss(h):
    return lambda x, w: (jax.vmap(h, (0, None))(x, w) ** 2).sum()

def check(what, make, args, want, sharding=None, sums=None):
    '''make(args) is want(args unsharded), without gathering, with the sharding of the results.'''
    compiled = jax.jit(make).lower(*args).compile()
    text, got = compiled.as_text(), compiled(*args)
    expected = want(*jax.tree.map(lambda x: jax.device_put(x, jax.devices()[0]), args))
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert relative_error(a, b) <= F64_TRANSFORM, what
    assert "all-gather" not in text and "all-to-all" not in text, what
    if sums is not None:
        assert text.count(" all-reduce(") + text.count(" all-reduce-start(") == sums, (what, text)
    if sharding is not None:
        first = jax.tree.leaves(got)[0]
        assert first.sharding.is_equivalent_to(sharding, first.ndim), (what, first.sharding)

def mapped(h):
    return jax.vmap(h, (0, None))

g = threaded(f)
for spec in (P("a"), both):
    where = NamedSharding(mesh, spec)
    x = jax.device_put(X, where)
    check("values", mapped(g), (x, W), mapped(f), where, 0)
    check("gradient, own and shared", jax.grad(loss(g), (0, 1)), (x, W), jax.grad(loss(f), (0, 1)),
          where, 1)
    check("jacfwd", mapped(jax.jacfwd(g)), (x, W), mapped(jax.jacfwd(f)), where, 0)

last = NamedSharding(mesh, P(None, both[0]))
check("batch last", lambda x: jax.vmap(g, (-1, None), -1)(x, W), (jax.device_put(X.T, last),),
      lambda x: jax.vmap(f, (-1, None), -1)(x, W), last, 0)

def pairs(h):
    return jax.vmap(jax.vmap(h, (0, None)), (None, 0))

ws = jax.device_put(jnp.stack([W, -W]), NamedSharding(mesh, P("b")))
x = jax.device_put(X, rows)
check("two axes", pairs(g), (x, ws), pairs(f), NamedSharding(mesh, P("b", "a")), 0)

model = rb.load("cart_pole")
state = jax.vmap(model.random_state)(jax.random.split(jax.random.key(0), 16))
masses, us = model.bodies.mass, jnp.zeros((4, 1))

def rolled(kernel):
    def loss(mass, q, v, us):
        heavier = model.replace(bodies=model.bodies.replace(mass=mass))
        out = rb.rollout(heavier, rb.State(q, v), us, 0.01, kernel=kernel)
        return (out.q[:, -1] ** 2).sum(), out.q
    gradient = jax.grad(loss, (0, 1, 3), has_aux=True)
    def f(q, v):
        (mass, q_bar, u_bar), path = gradient(masses, q, v, us)
        return path, q_bar, mass, u_bar
    return f

where = NamedSharding(mesh, both)
q, v = jax.device_put((state.q, state.v), where)
check("rollout", rolled(True), (q, v), rolled(False), where)

def own(h):
    return jax.shard_map(mapped(h), mesh=mesh, in_specs=(both, P()), out_specs=both)

x = jax.device_put(X, where)
check("shard_map", own(g), (x, W), mapped(f), where, 0)
total = jax.shard_map(
    lambda x, w: jax.lax.psum(loss(g)(x, w), ("a", "b")), mesh=mesh, in_specs=(both, P()),
    out_specs=P())
check("its gradient", jax.grad(total, (0, 1)), (x, W), jax.grad(loss(f), (0, 1)), where)

def rolled_there(q, v):
    def loss(mass, q, v):
        heavier = model.replace(bodies=model.bodies.replace(mass=mass))
        out = rb.rollout(heavier, rb.State(q, v), us, 0.01, kernel=True)
        return jax.lax.psum((out.q[:, -1] ** 2).sum(), ("a", "b"))
    own = jax.shard_map(loss, mesh=mesh, in_specs=(P(), both, both), out_specs=P())
    mass, q_bar = jax.grad(own, (0, 1))(masses, q, v)
    return q_bar, mass

check("rollout in shard_map", rolled_there, (q, v), lambda q, v: rolled(False)(q, v)[1:3], where)
print("fine")
"""


def test_a_spread_batch_stays_spread():
    flags = "--xla_force_host_platform_device_count=8"
    child = subprocess.run(
        [sys.executable, "-c", CHILD], capture_output=True, text=True,
        env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert child.stdout == "fine\n", child.stderr
