"""Motion in parallel over time: segments that are simulated side by side until they are one motion.

    s_1 = x_0,   s_(k+1) <- f_k(s_k)   for all k at once, again and again
f_k simulates segment k from its start s_k. After j sweeps the first j segments are those of the one
motion, whatever the starts were, so K sweeps of K segments always end, and take as long as the
motion at once. A motion that forgets its start, as that of damped joints under servos does, is
there much earlier: an error shrinks in every sweep by what the motion forgets in a segment. Sweeps
end when no start moves by more than rounding. Slopes obey the same equation made linear, along the
motion that was found: their sweeps follow.
A GPU runs a sample a thread, and few samples leave it idle: 8,000 periods of a leg are 250 of 32.

Source: Gander, *50 years of time parallel time integration*, 2015 (Picard iterations over windows);
Song, Meng, Liao & Ermon, *Accelerating feedforward computation via parallel nonlinear equation
solving*, ICML 2021.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from rbjax.compiler.jax.launch import has_gpu

#: threads that a GPU runs as fast as one
THREADS = 8192
#: periods of a segment at least, and segments at most
SHORTEST, MOST = 64, 32
#: a start that moves by so many roundings, relative to the largest number of its kind, stays
ROUNDINGS = 256

#: (theta, start of a segment, its commands) -> (its end, what it shows at each command)
Segment = Callable[[Any, Any, Any], tuple[Any, Any]]


def segments(periods: int, samples: int) -> int:
    """Into how many segments a motion is cut, of which so many samples are simulated; 1: it runs at
    once, as on a CPU, whose cores are busy with few samples."""
    if not has_gpu():
        return 1
    return max(1, min(MOST, periods // SHORTEST, THREADS // samples))


def in_segments(segment: Segment, theta: Any, first: Any, commands: Any, count: int) -> Any:
    """What `segment` shows at each of the commands (N, ...), cut into `count` segments.

    Args:
        segment: of one sample, traced; its first argument after theta is a pair (k, carry) of the
            place of its first command and of what it starts from.
        theta: numbers that all segments share.
        first: what the first one starts from, floats.
        commands: (N, ...).
        count: of segments.
    """
    N = jax.tree.leaves(commands)[0].shape[0]
    length = -(-N // count)
    filled = length * count - N
    places = np.arange(count) * length

    def cut(x: jax.Array) -> jax.Array:
        x = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (filled, *x.shape[1:]))])
        return x.reshape(count, length, *x.shape[1:])

    @jax.jit  # traced once for all its uses
    def sweep(theta: Any, starts: Any, commands: Any) -> tuple[Any, Any]:
        def one(k: Any, start: Any, commands: Any) -> tuple[Any, Any]:
            return segment(theta, (k, start), commands)

        return jax.vmap(one)(jnp.asarray(places), starts, commands)

    shown = _settled(sweep, theta, first, jax.tree.map(cut, commands))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:N], shown)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _settled(sweep: Callable, theta: Any, first: Any, commands: Any) -> Any:
    """What the segments show when they are one motion."""
    return _swept(functools.partial(_ended, sweep, theta, commands), first, commands)[1]


def _ended(sweep: Callable, theta: Any, commands: Any, starts: Any) -> tuple[Any, Any]:
    return sweep(theta, starts, commands)


def _settled_jvp(sweep: Callable, primals: Any, tangents: Any) -> tuple[Any, Any]:
    theta, first, commands = primals
    starts, shown = _swept(functools.partial(_ended, sweep, theta, commands), first, commands)
    leaves, tree = jax.tree.flatten((theta, commands))
    moves = jax.tree.leaves(tangents[::2], is_leaf=lambda x: isinstance(x, SymbolicZero))
    moving = [k for k, d in enumerate(moves) if not isinstance(d, SymbolicZero)]

    def ended(some: list[Any], starts: Any) -> tuple[Any, Any]:
        every = list(leaves)
        for k, x in zip(moving, some, strict=True):
            every[k] = x
        theta, commands = jax.tree.unflatten(tree, every)
        return sweep(theta, starts, commands)

    def slope(dstarts: Any) -> tuple[Any, Any]:
        at, along = [leaves[k] for k in moving], [moves[k] for k in moving]
        return jax.jvp(ended, (at, starts), (along, dstarts))[1]

    def known(d: Any) -> Any:
        return jnp.zeros(d.shape, d.dtype) if isinstance(d, SymbolicZero) else d

    dfirst = jax.tree.map(known, tangents[1], is_leaf=lambda x: isinstance(x, SymbolicZero))
    return shown, _swept(slope, dfirst, commands)[1]


_settled.defjvp(_settled_jvp, symbolic_zeros=True)


def _swept(f: Callable[[Any], tuple[Any, Any]], first: Any, commands: Any) -> tuple[Any, Any]:
    """The starts, and what is shown from there: sweeps of f until the starts stay."""
    count = jax.tree.leaves(commands)[0].shape[0]
    starts = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), first)

    def again(value: Any) -> Any:
        k, _, starts, _ = value
        ends, shown = f(starts)
        moved = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:-1]]), first, ends)
        still = [_stays(a, b) for a, b in zip(*map(jax.tree.leaves, (starts, moved)), strict=True)]
        return k + 1, jnp.all(jnp.stack(still)), moved, shown

    def goes_on(value: Any) -> Any:
        return (value[0] < count) & ~value[1]

    shown = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(f, starts)[1])
    begun = (jnp.zeros((), int), jnp.zeros((), bool), starts, shown)
    return jax.lax.while_loop(goes_on, again, begun)[2:]


def _stays(before: jax.Array, after: jax.Array) -> jax.Array:
    """Whether starts (K, ...) moved by no more than rounding; what is not finite has moved."""
    size = jnp.max(jnp.abs(after), initial=0.0)
    near = jnp.abs(after - before) <= ROUNDINGS * jnp.finfo(after.dtype).eps * size
    return jnp.isfinite(size) & jnp.all(near)
