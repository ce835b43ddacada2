"""Sharding of a batch over devices: each device runs its own samples.

XLA would gather the operands of a custom call on every device. `shard_batch` tells XLA the sharding
of the batch axes, and provides the program of one device. A result that is summed over the batch is
summed over the devices at the end. Inside `shard_map`, each device already has its own samples.
"""

from __future__ import annotations

import math
import string
from collections.abc import Callable, Sequence

import jax
from jax.experimental.custom_partitioning import custom_partitioning
from jax.sharding import Mesh, NamedSharding, PartitionSpec

Axes = tuple[int | None, ...]
#: the mesh axes over which one axis of an array is sharded
MeshAxes = str | tuple[str, ...] | None


def shard_batch(
    f: Callable[[tuple[int, ...]], Callable], batch: tuple[int, ...], ins: Sequence[Axes],
    outs: Sequence[Axes], ranks: tuple[Sequence[int], Sequence[int]],
) -> Callable:  # fmt: skip
    """Return f(batch) as a function of operands that may be sharded along the axes of the batch.

    Args:
        f: maps the shape of a device's part of the batch to the function that evaluates it.
        ins, outs: the position of each axis of the batch in each operand and result.
        ranks: the number of axes of each operand and result.
    """

    def batch_axes(operands: Sequence[jax.ShapeDtypeStruct]) -> list[MeshAxes]:
        """Return the mesh axes over which each axis of the batch is sharded.

        A mesh axis shards only one axis of the batch, the first. Operands with another sharding
        are moved.
        """
        found: list[MeshAxes] = [None] * len(batch)
        taken: set[str] = set()
        for operand, axes in zip(operands, ins, strict=True):
            spec = getattr(operand.sharding, "spec", None)
            for level, axis in enumerate(axes):
                over = spec[axis] if spec and axis is not None and axis < len(spec) else None
                names = set(_names(over))
                if found[level] is None and names and not names & taken:
                    found[level] = over
                    taken |= names
        return found

    def shardings(
        mesh: Mesh, over: list[MeshAxes], positions: Sequence[Axes], ranks: Sequence[int]
    ) -> tuple[NamedSharding, ...]:
        out = []
        for axes, rank in zip(positions, ranks, strict=True):
            spec: list[MeshAxes] = [None] * rank
            for level, axis in enumerate(axes):
                if axis is not None:
                    spec[axis] = over[level]
            out.append(NamedSharding(mesh, PartitionSpec(*spec)))
        return tuple(out)

    def partition(mesh: Mesh, args: Sequence[jax.ShapeDtypeStruct], _: object) -> tuple:
        over = batch_axes(args)
        local = tuple(n // _device_count(mesh, o) for n, o in zip(batch, over, strict=True))

        def run(*operands: jax.Array) -> tuple[jax.Array, ...]:
            found = []
            for x, axes in zip(f(local)(*operands), outs, strict=True):
                absent = [o for o, axis in zip(over, axes, strict=True) if axis is None]
                names = tuple(name for o in absent for name in _names(o))
                found.append(jax.lax.psum(x, names) if names else x)
            return tuple(found)

        operands, results = (
            shardings(mesh, over, *x) for x in zip((ins, outs), ranks, strict=True)
        )
        return mesh, run, results, operands

    @custom_partitioning
    def whole(*operands: jax.Array) -> tuple[jax.Array, ...]:  # JAX reads only its shapes
        return tuple(jax.lax.full_like(x, 0) for x in jax.eval_shape(f(batch), *operands))

    whole.def_partition(partition, sharding_rule=_rule(len(batch), ins, outs, ranks))
    return whole


def _names(over: MeshAxes) -> tuple[str, ...]:
    return over if isinstance(over, tuple) else (over,) if over else ()


def _device_count(mesh: Mesh, over: MeshAxes) -> int:
    """Return the number of devices along these mesh axes."""
    return math.prod(mesh.shape[name] for name in _names(over))


def _rule(
    levels: int, ins: Sequence[Axes], outs: Sequence[Axes],
    ranks: tuple[Sequence[int], Sequence[int]],
) -> str:  # fmt: skip
    """Return Shardy's sharding rule of a call, with one factor per axis of the batch and per other
    axis."""
    others = (f"{a}{b}" for a in string.ascii_lowercase for b in range(10_000))
    names = [f"B{level}" for level in range(levels)]

    def terms(positions: Sequence[Axes], ranks: Sequence[int]) -> str:
        out = []
        for axes, rank in zip(positions, ranks, strict=True):
            own = {axis: names[level] for level, axis in enumerate(axes) if axis is not None}
            out.append(" ".join(own.get(k) or next(others) for k in range(rank)))
        return ", ".join(out)

    return f"{terms(ins, ranks[0])} -> {terms(outs, ranks[1])}"
