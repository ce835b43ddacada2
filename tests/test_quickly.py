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


def parts(x):
    far, order = jnp.array([0, 7, 0]), jnp.argsort(x[:, 0])
    taken = x[order], x.at[far].get(), x.at[far].get(mode="fill", fill_value=3.0), x[..., ::-1]
    pairs = x[jnp.array([[0, 2], [1, 1]]), jnp.array([0, 3])]
    pairs = pairs, jnp.take_along_axis(x, x.argsort(), 1)
    changed = x.at[far].add(2.0), x.at[1:, 2:].multiply(3.0), x.at[:, 1].min(0.0), jnp.roll(x, 1, 1)
    each = jax.vmap(lambda a, k: (a[k], a.at[k].set(2.0)))(x, jnp.array([0, 1, 9]))
    start = jnp.int32(1), jnp.int32(5)  # beyond: moved inside
    moved = lax.dynamic_slice(x, start, (2, 2)), lax.dynamic_update_slice(x, x[:2, :2], start)
    return taken, pairs, changed, each, moved


def more_arithmetic(x):
    powers = x**5, x**-3, jnp.abs(x) ** x, jnp.arctan2(x, -x), 2.5 * jnp.exp(1.0)
    along = jnp.cumsum(x, 1), lax.cumsum(x, 0, reverse=True), lax.cummax(x, 0), jnp.prod(x, 0)
    kinds = jnp.sort(x), jnp.argmax(x, 1), jnp.sign(x), jnp.round(x), x % 0.3, x.clip(-0.1, 0.2)
    products = jnp.einsum("bij,bj->bi", x[:, None] * x[:, :, None], x), jnp.linalg.inv(x @ x.T)
    return powers, along, kinds, products, jnp.interp(x, jnp.sort(x[0]), x[1]), jnp.median(x)


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


@pytest.mark.parametrize(
    "f", [shapes, parts, arithmetic, more_arithmetic, loops, derivatives, random]
)
def test_what_jit_gives(f, monkeypatch) -> None:
    monkeypatch.setattr(quickly, "TIMES", np.inf)
    got = quick_jit(f)(X), f(jnp.asarray(X))
    monkeypatch.setattr(quickly, "by_xla", True)
    want = jax.jit(f)(X)
    for a, b in zip(jax.tree.leaves(got), 2 * jax.tree.leaves(want), strict=True):
        assert isinstance(a, jax.Array) and a.dtype == b.dtype and a.shape == b.shape
        assert a.weak_type == b.weak_type
        finite = np.isfinite(b)
        np.testing.assert_array_equal(np.asarray(a)[~finite], np.asarray(b)[~finite])
        assert relative_error(np.where(finite, a, 0), np.where(finite, b, 0)) <= 1e-15


def test_arguments_that_stay_and_programs_around() -> None:
    times = functools.partial(quick_jit, static_argnums=0)(lambda n, x, *, more: n * x + more)
    np.testing.assert_array_equal(times(3, X, more=1.0), 3 * X + 1.0)
    np.testing.assert_array_equal(jax.vmap(lambda x: times(2, x, more=x))(X), 3 * X)


def test_what_says_something_about_devices_or_compilation_is_compiled(monkeypatch) -> None:
    here, given = jax.device_put(X, jax.devices()[0]), jnp.array(X)
    monkeypatch.setattr(quickly, "_evaluated", None)  # nothing can be evaluated
    np.testing.assert_array_equal(jax.jit(lambda x: 2 * x)(here), 2 * X)
    np.testing.assert_array_equal(jax.jit(lambda x: 3 * x, donate_argnums=0)(given), 3 * X)
    free = jax.jit(lambda x: 5 * x, compiler_options={"xla_backend_optimization_level": 0})
    np.testing.assert_array_equal(free(X), 5 * X)


def test_long_loops_are_compiled(monkeypatch) -> None:
    monkeypatch.setattr(quickly, "_evaluator", None)  # nothing can be evaluated
    count = quick_jit(lambda x: lax.fori_loop(0, 1000, lambda _, c: c + 1.0, x))
    np.testing.assert_allclose(count(X), X + 1000)
