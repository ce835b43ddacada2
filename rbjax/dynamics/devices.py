"""A batch that is spread over devices stays spread where XLA works through it in a loop.

Slices across the whole batch would make XLA gather it, and what a loop's turns add up for all
samples would be summed over the devices in every turn. So the batch is parted first, into as many
parts as there are devices, which are worked through side by side: where the batch is spread
evenly, a part lies on one device. (Threads on a GPU: `rbjax.threads.sharding`.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def devices() -> int:
    """How many devices a batch may be spread over; inside `shard_map` each has its own batch."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty:
        return jax.device_count()
    return 1 if mesh.manual_axes else mesh.size


def memory_share() -> int:
    """Bytes, an eighth of the memory of all devices; 2 GiB of each that does not state it."""
    limit = (jax.devices()[0].memory_stats() or {}).get("bytes_limit", 2**34)
    return limit // 8 * devices()


def on_each_device(
    f: Callable[[list], Any], args: list, axes: list[int | None], size: int, out_axis: int = 0
) -> Callable[[list], Any]:
    """f of a batch, in parts of which each lies on one device.

    Every part has its own copy, made here, of what all samples share and f closes over. So where f
    runs in a loop, a cotangent of that is summed over the devices once, at the end.

    Args:
        f: of arguments in the layout given, of any number of samples.
        args: such as it will be called with.
        axes, size, out_axis: as for `batching.chunks`.
    """
    parts = math.gcd(size, devices())
    if parts == 1:
        return f

    def copies(x: jax.Array) -> jax.Array:
        return jnp.broadcast_to(x, (parts, *x.shape))

    def split(args: list) -> list:
        return [
            jax.tree.map(copies, x) if a is None else parted(jnp.moveaxis(x, a, 0), a, parts)
            for x, a in zip(args, axes, strict=True)
        ]

    def joined(x: jax.Array) -> jax.Array:
        x = jnp.moveaxis(x, 0, -2) if out_axis else x
        return x.reshape(*x.shape[:-2], size) if out_axis else x.reshape(size, *x.shape[2:])

    one = jax.eval_shape(lambda args: jax.tree.map(lambda x: x[0], split(args)), args)
    part, shared = jax.closure_convert(f, one)
    own = [copies(x) for x in shared]
    return lambda args: jax.tree.map(joined, jax.vmap(part)(split(args), *own))


def parted(x: jax.Array, axis: int, count: int) -> jax.Array:
    """A batch, which comes first, in `count` parts, which then come first; a part has its samples
    at `axis` (0 or -1)."""
    x = x.reshape(count, x.shape[0] // count, *x.shape[1:])
    return jnp.moveaxis(x, 1, axis) if axis else x
