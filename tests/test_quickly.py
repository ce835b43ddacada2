"""`quick_jit` gives what `jax.jit` gives: every rule, loops, branches, derivatives, keys."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests import quickly
from tests.quickly import quick_jit
from tests.tolerances import relative_error

X = np.random.default_rng(0).normal(size=(3, 4))


@pytest.fixture(autouse=True)
def _evaluated(monkeypatch):
    monkeypatch.setattr(quickly, "by_xla", False)


@jax.custom_jvp
def cube(x):
    return x**3


cube.defjvp(lambda x, t: (cube(*x), 3 * x[0] ** 2 * t[0]))


def shapes(x):
    parts = [*jnp.split(x, [1, 3], axis=1), x.T, x[::2, 1:], x[None, :, 0], jnp.stack([x, -x], 1)]
    row = jnp.concatenate([p.ravel() for p in parts])
    padded = lax.pad(x, 7.0, ((1, 2, 1), (0, 1, 0)))
    more = jnp.tile(x, (2, 1)), x.astype(jnp.float32), lax.iota(int, 5), jnp.take(x, 2, 0)
    return row, padded, more


def arithmetic(x):
    kept = jnp.where(x > 0, x, jnp.abs(x) / 3) ** 2 + jnp.sqrt(x * x + 1) - jnp.sin(x)
    sums = x.sum(0), x.max(1), x.min(), (x > 0).any(0), (x < 9).all(), x @ x.T, x[0] @ x[1]
    return kept, sums, cube(x), x.at[1, 2].add(3.0), jnp.maximum(x, 0.1) / 0.0, (5 * x).astype(int)


def loops(x):
    total, path = lax.scan(lambda c, y: (c + y, c * y), x[0], x, reverse=True)
    grown = lax.while_loop(lambda c: (c < 5).all(), lambda c: c + jnp.abs(x).max(), x)
    each = jax.vmap(lambda y: lax.while_loop(lambda c: c.sum() < 9, lambda c: c + 1.0, y))(x)
    chosen = [lax.cond(x[k, 0] > 0, jnp.sin, jnp.cos, x) for k in range(3)]
    return total, path, grown, each, chosen, lax.switch(jnp.int32(7), [jnp.sin, jnp.exp], x)


def derivatives(x):
    def f(x):
        return (cube(jnp.tanh(x)) * lax.scan(lambda c, y: (c * y.sum(), c), 1.0, x)[0]).sum()

    return jax.grad(f)(x), jax.jvp(f, (x,), (x,)), jax.grad(jax.checkpoint(f))(x)


def random(x):
    return jax.random.normal(jax.random.split(jax.random.key(0))[1], x.shape) + x


@pytest.mark.parametrize("f", [shapes, arithmetic, loops, derivatives, random])
def test_what_jit_gives(f, monkeypatch) -> None:
    monkeypatch.setattr(quickly, "LOOPS", np.inf)
    got, want = quick_jit(f)(X), jax.jit(f)(X)
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert isinstance(a, jax.Array) and a.dtype == b.dtype and a.shape == b.shape
        finite = np.isfinite(b)
        np.testing.assert_array_equal(np.asarray(a)[~finite], np.asarray(b)[~finite])
        assert relative_error(np.where(finite, a, 0), np.where(finite, b, 0)) <= 1e-15


def test_arguments_that_stay_and_programs_around() -> None:
    times = functools.partial(quick_jit, static_argnums=0)(lambda n, x, *, more: n * x + more)
    np.testing.assert_array_equal(times(3, X, more=1.0), 3 * X + 1.0)
    np.testing.assert_array_equal(jax.vmap(lambda x: times(2, x, more=x))(X), 3 * X)


def test_long_loops_are_compiled(monkeypatch) -> None:
    monkeypatch.setattr(quickly, "_evaluator", None)  # nothing can be evaluated
    count = quick_jit(lambda x: lax.fori_loop(0, 1000, lambda _, c: c + 1.0, x))
    np.testing.assert_allclose(count(X), X + 1000)
