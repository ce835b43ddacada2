"""A batch that is spread over devices stays spread where XLA works through it in chunks.

Slices across the whole batch would make XLA gather it. So the batch is parted first, into as many
parts as there are devices, and all parts are worked through side by side: wherever the batch is
spread evenly, a part lies on one device. (Threads on a GPU: `rbjax.threads.sharding`.)
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


def on_each_device(
    f: Callable[[list, int], Any], args: list, axes: list[int | None], size: int, out_axis: int
) -> Any:
    """f(args, size) of a batch, in parts of which each lies on one device.

    Every part has its own copy of what all samples share, so a cotangent of that is summed over the
    devices once, at the end, and not in every turn of a loop.

    Args:
        f: of arguments in the layout given and of the number of their samples.
        args, axes, size, out_axis: as for `batching.chunks`.
    """
    parts = math.gcd(size, devices())
    if parts == 1:
        return f(args, size)

    def copies(x: jax.Array) -> jax.Array:
        return jnp.broadcast_to(x, (parts, *x.shape))

    def joined(x: jax.Array) -> jax.Array:
        x = jnp.moveaxis(x, 0, -2) if out_axis else x
        return x.reshape(*x.shape[:-2], size) if out_axis else x.reshape(size, *x.shape[2:])

    own = [
        jax.tree.map(copies, x) if a is None else parted(jnp.moveaxis(x, a, 0), a, parts)
        for x, a in zip(args, axes, strict=True)
    ]
    one = jax.eval_shape(lambda own: jax.tree.map(lambda x: x[0], own), own)
    part, shared = jax.closure_convert(lambda args: f(args, size // parts), one)
    return jax.tree.map(joined, jax.vmap(part)(own, *map(copies, shared)))


def parted(x: jax.Array, axis: int, count: int) -> jax.Array:
    """A batch, which comes first, in `count` parts, which then come first; a part has its samples
    at `axis` (0 or -1)."""
    x = x.reshape(count, -1, *x.shape[1:])
    return jnp.moveaxis(x, 1, axis) if axis else x
