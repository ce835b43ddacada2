"""Batches under XLA on the CPU, where lanes as long as the whole batch would be slow.

A lane of the whole batch outgrows the cache, so a large batch runs in chunks
(benchmarks/results/cpu-thresholds-*.json has the widths). Derivatives are those of the plain
function. (Programs of one sample need no chunks: `rbjax.compiler`.)
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.tracing.custom_rules import jvp_of, with_jvp
from rbjax.dynamics.tracing.devices import on_each_device, parted

#: the most samples in a chunk on the CPU: more outgrow the cache
CPU_CHUNK = 240
#: lanes a multiple of this apart share places of the first cache: up to twice as slow
ALIASED = 128


def with_rule(f: Callable, rule: Callable) -> Callable:
    """f, whose `vmap` is `rule(size, axes, *args)`. Each argument has its batch first (0 in axes)
    or none (None); results have the batch first. No reverse mode, which custom_vmap lacks."""
    once = jax.custom_batching.custom_vmap(f)

    @once.def_vmap
    def _(size, batched, *args):
        axes = jax.tree.map(lambda b: 0 if b else None, tuple(batched))
        out = rule(size, axes, *args)
        return out, jax.tree.map(lambda _: True, out)

    return once


def in_chunks(f: Callable[[list], Any]) -> Callable[[list], Any]:
    """f, whose `vmap` on the CPU runs in chunks; derivatives are those of f."""
    if jax.default_backend() != "cpu":
        return f

    def rule(size, axes, args):
        return chunks(jax.vmap(f, in_axes=axes), args, axes[0], size)

    return with_jvp(with_rule(f, rule), lambda *at: jvp_of(f, *at))


def divided(size: int) -> tuple[int, int]:
    """The number of chunks of a batch, and the samples of each, rounded up from an equal share.

    >>> divided(1024), divided(256), divided(128)
    ((5, 208), (2, 144), (1, 128))
    """
    count = max(1, -(-size // CPU_CHUNK))
    if count == 1:
        return 1, size
    chunk = -(-size // (16 * count)) * 16  # whole vectors
    chunk += 0 if chunk % ALIASED else 16
    return -(-size // chunk), chunk


def chunks(many: Callable, args: list, axes: list[int | None], size: int, out_axis: int = 0) -> Any:
    """many(args) on slices of a batch, one after another; every device runs its own samples.

    Args:
        many: takes the arguments in the given layout, with any number of samples.
        args: arrays, with the batch at the axis given in `axes`.
        axes: 0, -1, or None (no batch), one for each argument.
        size: of the batch.
        out_axis: the batch axis of every result.
    """

    def one_after_another(args: list) -> Any:
        size = next(x.shape[a] for x, a in zip(args, axes, strict=True) if a is not None)
        return _chunks(many, args, axes, size, out_axis)

    return on_each_device(one_after_another, args, axes, size, out_axis)(args)


def _chunks(many: Callable, args: list, axes: list[int | None], size: int, out_axis: int) -> Any:
    """`chunks` on one device. Each slice's result is written to its place. The last slice repeats
    samples of its neighbour to have full length. (Padding would copy the result.)"""
    count, chunk = divided(size)
    if count == 1:
        return many(args)
    starts = np.minimum(chunk * np.arange(count), size - chunk)

    def split(x: jax.Array, axis: int) -> jax.Array:
        x = jnp.moveaxis(x, axis, 0)
        if size % chunk:
            x = jnp.concatenate([x[: chunk * (count - 1)], x[-chunk:]])
        return parted(x, axis, count)

    slices = [split(x, a) for x, a in zip(args, axes, strict=True) if a is not None]

    @functools.partial(jax.jit, inline=True)  # traced once for both the shapes and the loop
    def run(some: list) -> Any:
        rest = iter(some)
        return many([x if a is None else next(rest) for x, a in zip(args, axes, strict=True)])

    def whole(x: jax.ShapeDtypeStruct) -> jax.Array:  # varies as x does, inside `shard_map`
        shape = (*x.shape[:-1], size) if out_axis else (size, *x.shape[1:])
        return jax.lax.full_like(x, 0, shape=shape)

    def once(out: Any, x: tuple) -> tuple[Any, None]:
        start, some = x
        place = functools.partial(
            jax.lax.dynamic_update_slice_in_dim, start_index=start, axis=out_axis
        )
        return jax.tree.map(place, out, run(some)), None

    one = jax.eval_shape(lambda xs: run([x[0] for x in xs]), slices)
    places = jax.tree.map(whole, one)
    return jax.lax.scan(once, places, (jnp.asarray(starts), slices))[0]
