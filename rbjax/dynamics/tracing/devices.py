"""A batch that is sharded over devices stays sharded when XLA runs it in a loop.

Slices across the whole batch would make XLA gather it, and sums over samples would be reduced over
the devices in every iteration. So the batch is first split into one part for each device, and the
parts run side by side. If the batch is sharded evenly, each part lies on one device.
(Threads on a GPU: `rbjax.compiler.jax.sharding`.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def devices() -> int:
    """The number of devices of a batch; inside `shard_map` each has its own batch."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty:
        return jax.device_count()
    return 1 if mesh.manual_axes else mesh.size


def memory_share() -> int:
    """Bytes: an eighth of the memory of all devices, 2 GiB for a device that does not report it."""
    limit = (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit", 2**34)
    return limit // 8 * devices()


def on_each_device(
    f: Callable[[list], Any], args: list, axes: list[int | None], size: int, out_axis: int = 0
) -> Callable[[list], Any]:
    """f of a batch, in parts that each lie on one device.

    Every part gets its own copy of the values that all samples share and f closes over. So if f
    runs in a loop, their cotangents are summed over the devices once, at the end.

    Args:
        f: takes arguments in the given layout, with any number of samples.
        args: examples of its arguments.
        axes: the axis of the batch in each argument, 0 or -1, or None.
        size: of the batch.
        out_axis: the batch axis of every result.
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
    """A batch, on the first axis, split into `count` parts on a new first axis. A part has its
    samples at `axis` (0 or -1)."""
    x = x.reshape(count, x.shape[0] // count, *x.shape[1:])
    return jnp.moveaxis(x, 1, axis) if axis else x
