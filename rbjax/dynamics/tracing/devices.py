"""Loops of XLA over batches that are sharded over devices.

Slices across the whole batch would make XLA gather it, and sums over samples would be reduced over
the devices in every iteration. Therefore the batch is first split into one part for each device,
and all parts run in parallel. If the batch is sharded evenly, each part is on one device.
(Threads on a GPU: `rbjax.compiler.jax.sharding`.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def devices() -> int:
    """Return the number of devices of a batch, which is 1 inside `shard_map`."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty:
        return jax.device_count()
    return 1 if mesh.manual_axes else mesh.size


def memory_share() -> int:
    """Return an eighth of the memory of all devices in bytes, 2 GiB each if it is not reported."""
    limit = (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit", 2**34)
    return limit // 8 * devices()


def on_each_device(
    f: Callable[[list], Any], args: list, axes: list[int | None], size: int
) -> Callable[[list], Any]:
    """Split f over a batch into parts that each run on one device.

    Every part gets its own copy of the shared values and of the values that f closes over. If f
    runs in a loop, their cotangents are therefore summed over the devices once, at the end.

    Args:
        f: a function of arguments in the given layout, with any number of samples.
        args: examples of the arguments of f.
        axes: the batch axis of each argument, 0 or -1, or None.
        size: the size of the batch.
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
        return x.reshape(size, *x.shape[2:])

    one = jax.eval_shape(lambda args: jax.tree.map(lambda x: x[0], split(args)), args)
    part, shared = jax.closure_convert(f, one)
    own = [copies(x) for x in shared]
    return lambda args: jax.tree.map(joined, jax.vmap(part)(split(args), *own))


def parted(x: jax.Array, axis: int, count: int) -> jax.Array:
    """Split a batch on the first axis into `count` parts on a new first axis.
    The samples of a part are on its axis `axis` (0 or -1)."""
    x = x.reshape(count, x.shape[0] // count, *x.shape[1:])
    return jnp.moveaxis(x, 1, axis) if axis else x
