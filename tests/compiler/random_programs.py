"""Random functions of one sample: arithmetic, indexing, loops, branches and calls, nested."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

Pool = list[jax.Array]


def program(seed: int) -> Callable:
    """f(x (3, 4), y (6,), w (70,), i (3,) of integers) -> a list of arrays, the same for a seed."""

    def f(x, y, w, i):
        rng = np.random.default_rng(seed)
        pool = [x, y, i, w] if seed % 4 == 0 else [x, y, i]
        steps(rng, pool, rng.integers(4, 14), depth=0)
        return [v for v in pool[3:][-5:]] + [pool[0]]

    return f


def arguments(seed: int, batch: int = 3) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    x, y, w = (rng.normal(size=(batch, *shape)) for shape in ((3, 4), (6,), (70,)))
    return x, y, w, rng.integers(-2, 7, (batch, 3)).astype(np.int32)


def steps(rng: np.random.Generator, pool: Pool, count: int, depth: int) -> None:
    """Appends results of random operations on what is in the pool."""
    kinds = [*SIMPLE * 3, *NESTED] if depth < 2 else SIMPLE
    for _ in range(count):
        out = kinds[rng.integers(len(kinds))](rng, pool, depth)
        pool.extend(v for v in (out if isinstance(out, list | tuple) else [out]) if v.size)


def pick(rng: np.random.Generator, pool: Pool, kind: str = "f", ndim: int | None = None):
    found = [v for v in pool if v.dtype.kind == kind and (ndim is None or v.ndim == ndim)]
    if found:
        return found[rng.integers(len(found))]
    return pick(rng, pool, kind).reshape(-1) if ndim == 1 else pick(rng, pool, kind).reshape(1, -1)


def index(rng, pool):
    """An integer that is known, or not."""
    if rng.random() < 0.2:
        return jnp.int32(rng.integers(-2, 8))
    i = pick(rng, pool, "i").reshape(-1)
    return i[rng.integers(i.size)].astype(jnp.int32)


def truth(rng, pool):
    x, y = pick(rng, pool).reshape(-1), pick(rng, pool).reshape(-1)
    return x[rng.integers(x.size)] > y[rng.integers(y.size)] - 0.1


def fitted(rng, value, like):
    """The value, or some of it, in the shape and type of another."""
    if value.shape == like.shape and value.dtype == like.dtype:
        return value
    if like.dtype.kind in "ib":
        return like
    flat = jnp.resize(value.astype(like.dtype), like.shape)
    return jnp.tanh(flat)


# ------------------------------------------------------------------- simple operations


def unary(rng, pool, depth):
    fs = [jnp.sin, jnp.tanh, jnp.negative, jnp.abs, lambda x: jnp.sqrt(jnp.abs(x) + 0.1),
          lambda x: jnp.exp(-x * x), lambda x: jnp.clip(x, -1, 0.5), lambda x: x * 1.5,
          lambda x: jnp.round(x * 2), lambda x: 1 / (2 + jnp.cos(x)),
          lambda x: x**3 / (1 + x**2)]  # fmt: skip
    return fs[rng.integers(len(fs))](pick(rng, pool))


def binary(rng, pool, depth):
    x, y = pick(rng, pool), pick(rng, pool)
    if x.shape != y.shape:
        y = y.reshape(-1)[rng.integers(y.size)]
    fs = [jnp.add, jnp.subtract, lambda x, y: jnp.sin(x * y), jnp.maximum, jnp.minimum,
          lambda x, y: x / (2 + jnp.abs(y)), jnp.arctan2,
          lambda x, y: jnp.where(x > y, x, 2 * y)]  # fmt: skip
    return fs[rng.integers(len(fs))](x, y)


def integer(rng, pool, depth):
    x, y = pick(rng, pool, "i"), pick(rng, pool, "i").reshape(-1)
    y = y[rng.integers(y.size)].astype(x.dtype)
    fs = [jnp.add, jnp.subtract, jnp.multiply, jnp.bitwise_and, jnp.bitwise_xor, jnp.maximum,
          lambda x, y: x // (jnp.abs(y) % 5 + 1), lambda x, y: x % 7,
          lambda x, y: x << (y & 3)]  # fmt: skip
    return fs[rng.integers(len(fs))](x, y)


def to_integer(rng, pool, depth):
    x = pick(rng, pool)
    return jnp.clip(jnp.round(x * 3), -9, 9).astype(rng.choice([np.int32, np.int64]))


def structure(rng, pool, depth):
    x = pick(rng, pool)
    v = pick(rng, pool, ndim=1)
    m = pick(rng, pool, ndim=2)
    fs = [lambda: x.T, lambda: x[::-1], lambda: x.reshape(-1), lambda: v[1:], lambda: m[:, ::-2],
          lambda: jnp.concatenate([v, x.reshape(-1)])[:90], lambda: jnp.stack([v, v * 2]),
          lambda: m[-1], lambda: jnp.pad(v, (1, 2))[:80], lambda: m.reshape(m.shape[1], m.shape[0]),
          lambda: jnp.broadcast_to(v[:4], (2, min(4, v.size))), lambda: jnp.roll(x, 1),
          lambda: m[:1] + m, lambda: v[:, None] * v[:3] if v.size < 20 else v]  # fmt: skip
    if not x.ndim:
        return x[None]
    return fs[rng.integers(len(fs))]()


def reduction(rng, pool, depth):
    x = pick(rng, pool)
    if not x.ndim:
        return x
    axis = int(rng.integers(x.ndim))
    fs = [jnp.sum, jnp.max, jnp.min, jnp.mean, jnp.argmax, jnp.argmin,
          lambda x, axis: jnp.tanh(jnp.cumsum(x, axis)), lambda x, axis: jnp.sort(x, axis),
          lambda x, axis: lax.cummax(x, axis, reverse=True), lambda x, axis: (x > 0).any(axis) * 1,
          lambda x, axis: jnp.argsort(x, axis)]  # fmt: skip
    return fs[rng.integers(len(fs))](x, axis)


def product(rng, pool, depth):
    m, v = pick(rng, pool, ndim=2), pick(rng, pool, ndim=1)
    n = min(m.shape[1], v.size)
    return jnp.tanh(m[:, :n] @ v[:n])


def read(rng, pool, depth):
    v, m, i = pick(rng, pool, ndim=1), pick(rng, pool, ndim=2), index(rng, pool)
    many = pick(rng, pool, "i").reshape(-1)[:9]
    fs = [lambda: v[i], lambda: m[i], lambda: m[:, i], lambda: v[many], lambda: m[many % len(m)],
          lambda: lax.dynamic_slice(m, (i, i * 0), (1, m.shape[1])), lambda: m[i % 3, i],
          lambda: lax.dynamic_slice(v, (i,), (max(v.size - 2, 1),)),
          lambda: v.at[many].get(mode="fill"), lambda: v[many] * v[many],
          lambda: v.at[many].get(mode="clip"),
          lambda: jnp.take_along_axis(m, m.argsort(1), 1)]  # fmt: skip
    return fs[rng.integers(len(fs))]()


def update(rng, pool, depth):
    """A changed array, whose old values stay in the pool."""
    x, i, many = pick(rng, pool), index(rng, pool), pick(rng, pool, "i").reshape(-1)[:9]
    if not x.ndim:
        return x + 1
    row = jnp.resize(pick(rng, pool), x.shape[1:])
    value = pick(rng, pool).reshape(-1)[0]
    fs = [lambda: x.at[i].set(row), lambda: x.at[i].add(row), lambda: x.at[..., i].set(value),
          lambda: lax.dynamic_update_slice(x, x[:1] * 2, (i, *[i * 0] * (x.ndim - 1))),
          lambda: x.at[many].add(value), lambda: x.at[many].max(value, mode="clip"),
          lambda: x.at[many].min(0.1, mode="drop"), lambda: x.at[0].set(row),
          lambda: x.at[i].mul(2), lambda: x.at[i].set(x[0]).at[0].set(x[i])]  # fmt: skip
    return fs[rng.integers(len(fs))]()


SIMPLE = [unary, binary, integer, to_integer, structure, reduction, product, read, update, update]

# ------------------------------------------------------------------- loops, branches, calls


def chosen(rng, pool, most=4):
    return [pool[k] for k in rng.integers(len(pool), size=rng.integers(1, most))]


def body(seed: int, depth: int, pool: Pool, count: int = 4) -> Callable:
    """Random steps on the arguments and on what lies around."""

    def f(*args):
        rng = np.random.default_rng(seed)
        inner = [*args, *pool]
        steps(rng, inner, rng.integers(1, count + 1), depth + 1)
        made = inner[len(args) + len(pool) :]
        return rng, made or [pick(rng, inner)], inner

    return f


def advanced(rng, carry, made, inner):
    """The next carry: updated in place, exchanged, made anew, or as it was."""
    out = []
    for c in carry:
        kind = rng.integers(4)
        if kind == 0 and c.ndim and c.dtype.kind == "f":
            value = jnp.tanh(pick(rng, made + inner)).reshape(-1)[0]
            out.append(c.at[index(rng, inner)].set(value))
        elif kind == 1:
            same = [d for d in carry if d.shape == c.shape and d.dtype == c.dtype]
            out.append(same[rng.integers(len(same))])
        else:
            out.append(fitted(rng, made[rng.integers(len(made))], c))
    return tuple(out)


def scan(rng, pool, depth):
    init, f = tuple(chosen(rng, pool)), body(rng.integers(2**31), depth, list(pool))
    long = [v for v in pool if v.ndim]
    xs = long[rng.integers(len(long))]

    def turn(carry, x):
        inner_rng, made, inner = f(*carry, x)
        return advanced(inner_rng, carry, made, inner), (made[-1], carry[0])

    carry, ys = lax.scan(turn, init, xs[:7], reverse=bool(rng.integers(2)))
    return [*carry, *(y for y in ys if y.size < 300)]


def repeat(rng, pool, depth):
    init, f = tuple(chosen(rng, pool)), body(rng.integers(2**31), depth, list(pool))

    def turn(k, carry):
        inner_rng, made, inner = f(*carry, jnp.asarray(k, jnp.int32))
        return advanced(inner_rng, carry, made, inner)

    count = 3 if rng.random() < 0.5 else index(rng, pool) % 4
    return lax.fori_loop(0, count, turn, init)


def loop(rng, pool, depth):
    init, f = tuple(chosen(rng, pool)), body(rng.integers(2**31), depth, list(pool))
    most = index(rng, pool) % 5

    def turn(carry):
        k, rest = carry
        inner_rng, made, inner = f(*rest, k)
        return k + 1, advanced(inner_rng, rest, made, inner)

    return lax.while_loop(lambda c: c[0] < most, turn, (jnp.int32(0), init))[1]


def branch(rng, pool, depth):
    args = tuple(chosen(rng, pool))
    fs = [body(rng.integers(2**31), depth, list(pool)) for _ in range(3)]

    def case(f):
        def run(*args):
            inner_rng, made, inner = f(*args)
            return advanced(inner_rng, args, made, inner)

        return run

    if rng.random() < 0.5:
        return lax.cond(truth(rng, pool), case(fs[0]), case(fs[1]), *args)
    return lax.switch(index(rng, pool), [case(f) for f in fs], *args)


def call(rng, pool, depth):
    args, f = chosen(rng, pool), body(rng.integers(2**31), depth, list(pool))
    run = lambda *args: f(*args)[1][-3:]  # noqa: E731
    kind = rng.integers(4)
    if kind == 0:
        return jax.checkpoint(run)(*args)
    if kind == 1:
        g = jax.custom_jvp(run)
        g.defjvp(lambda xs, ts: (run(*xs), run(*ts)))
        return g(*args)
    if kind == 2 and args[0].ndim:
        return jax.vmap(lambda x: run(x, *args[1:])[0])(args[0][:3])
    return jax.jit(run)(*args)


NESTED = [scan, repeat, loop, branch, call]
