"""A batch that is sharded over devices stays sharded: each device runs its own samples.

XLA would gather the operands of a custom call on every device. `spread` gives it the sharding of
the batch axes and the program of a device. A result that is summed over the batch is summed over
the devices at the end. (Inside `shard_map` each device has its own samples anyway.)
"""

from __future__ import annotations

import string
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.experimental.custom_partitioning import custom_partitioning
from jax.sharding import Mesh, NamedSharding, PartitionSpec

Axes = tuple[int | None, ...]


def spread(
    f: Callable[[tuple[int, ...]], Callable], batch: tuple[int, ...], ins: Sequence[Axes],
    outs: Sequence[Axes], ranks: tuple[Sequence[int], Sequence[int]],
) -> Callable:  # fmt: skip
    """f(batch), as a function of operands that may be sharded along the axes of the batch.

    f: takes the sizes of a device's part of the batch. ins, outs: the place of each axis of the
    batch in each operand and result. ranks: their numbers of axes.
    """
    levels = range(len(batch))

    def parts(shardings: Any) -> list[Any]:
        """For each axis of the batch, the mesh axes over which it is sharded. A mesh axis is used
        for only one axis of the batch, the first. Operands with another sharding are moved."""
        found: list[Any] = [None] * len(batch)
        taken: set[str] = set()
        for sharding, axes in zip(shardings, ins, strict=True):
            spec = getattr(sharding, "spec", None)
            for level in levels:
                axis = axes[level]
                over = spec[axis] if spec and axis is not None and axis < len(spec) else None
                names = {*over} if isinstance(over, tuple) else {over} if over else set()
                if found[level] is None and names and not names & taken:
                    found[level] = over
                    taken |= names
        return found

    def placed(mesh: Mesh, over: list[Any], axes: Axes, rank: int) -> NamedSharding:
        spec: list[Any] = [None] * rank
        for level in levels:
            axis = axes[level]
            if axis is not None:
                spec[axis] = over[level]
        return NamedSharding(mesh, PartitionSpec(*spec))

    def partition(mesh: Mesh, args: Any, results: Any) -> Any:
        over = parts([a.sharding for a in args])
        sizes = [1 if o is None else _count(mesh, o) for o in over]
        local = tuple(n // k for n, k in zip(batch, sizes, strict=True))

        def run(*operands: jax.Array) -> Any:
            found = []
            for x, axes in zip(f(local)(*operands), outs, strict=True):
                names = [o for o, axis in zip(over, axes, strict=True) if axis is None and o]
                flat = [n for o in names for n in (o if isinstance(o, tuple) else (o,))]
                found.append(jax.lax.psum(x, tuple(flat)) if flat else x)
            return tuple(found)

        shardings = [
            tuple(placed(mesh, over, axes, rank) for axes, rank in zip(places, sizes, strict=True))
            for places, sizes in ((ins, ranks[0]), (outs, ranks[1]))
        ]
        return mesh, run, shardings[1], shardings[0]

    @custom_partitioning
    def whole(*operands: jax.Array) -> Any:  # JAX uses only its shapes, and refuses constants
        return tuple(jax.lax.full_like(x, 0) for x in jax.eval_shape(f(batch), *operands))

    whole.def_partition(partition, sharding_rule=_rule(batch, ins, outs, ranks))
    return whole


def _count(mesh: Mesh, names: Any) -> int:
    """The number of devices of these mesh axes."""
    total = 1
    for name in names if isinstance(names, tuple) else (names,):
        total *= mesh.shape[name]
    return total


def _rule(batch: Any, ins: Sequence[Axes], outs: Sequence[Axes], ranks: Any) -> str:
    """Shardy's rule: one letter for each axis of the batch, another for every other axis."""
    others = (f"{a}{b}" for a in string.ascii_lowercase for b in range(10_000))
    names = [f"B{level}" for level in range(len(batch))]

    def terms(places: Sequence[Axes], sizes: Sequence[int]) -> str:
        out = []
        for axes, rank in zip(places, sizes, strict=True):
            own = {axis: names[level] for level, axis in enumerate(axes) if axis is not None}
            out.append(" ".join(own.get(k) or next(others) for k in range(rank)))
        return ", ".join(out)

    return f"{terms(ins, ranks[0])} -> {terms(outs, ranks[1])}"
