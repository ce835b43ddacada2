"""Batches on a device mesh with explicit axes (`jax.make_mesh`), whose array types have a sharding.

rbjax lets XLA shard a batch, as on automatic axes. So arguments are moved to automatic axes on
entry, and results get explicit types again.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import equinox as eqx
import jax
import numpy as np
from jax.sharding import AbstractMesh, NamedSharding, PartitionSpec

from rbjax.compiling import inside_jit
from rbjax.errors import InputError

F = TypeVar("F", bound=Callable)
NOWHERE = NamedSharding(AbstractMesh((), ()), PartitionSpec())


def automatic(f: F) -> F:
    """Wrap f to accept arguments on explicit axes. Its results are then on explicit axes too."""

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        if not on_explicit_axes(args, kwargs):
            return f(*args, **kwargs)
        return on_auto_axes(lambda args, kwargs: f(*args, **kwargs), args, kwargs)

    return cast(F, call)


def on_explicit_axes(*args: Any) -> bool:
    """Check whether arrays among the arguments, or the traced program, are on explicit axes."""
    if jax.sharding.get_abstract_mesh().explicit_axes:
        return True
    return any(_on(x).mesh.explicit_axes for x in jax.tree.leaves(args))


def on_auto_axes(f: Callable, *args: Any, along: Sequence[jax.Array] = ()) -> Any:
    """Return f(*args), run on automatic axes if arrays among the arguments are on explicit axes.

    along: arrays whose first axis is the first axis of every result. Results are sharded like the
        first of these arrays that is sharded.
    Untraced arrays that are replicated on every device remain constants.
    """

    def moves(x: Any) -> bool:
        return isinstance(x, jax.core.Tracer) or any(_on(x).spec)

    moving, known = eqx.partition(args, moves)
    known = jax.tree.map(lambda x: np.asarray(x) if _on(x).mesh.explicit_axes else x, known)
    around = [jax.sharding.get_abstract_mesh(), *(_on(x).mesh for x in jax.tree.leaves(moving))]
    mesh = next((m for m in around if m.explicit_axes), None)
    if mesh is None:
        return f(*eqx.combine(moving, known))
    rest = []

    def arrays(moving: Any) -> Any:
        given, other = eqx.partition(f(*eqx.combine(moving, known)), eqx.is_array)
        rest.append(other)
        return given

    spread = [axes for x in along for axes in _on(x).spec[:1] if axes]
    where = NamedSharding(mesh, PartitionSpec(*spread[:1]))
    auto = jax.sharding.auto_axes(arrays, axes=mesh.explicit_axes, out_sharding=where)
    try:
        given = (auto if inside_jit() else jax.jit(auto))(moving)
    except ValueError as error:
        if "context mesh" not in str(error).lower():
            raise
        raise InputError(
            "a function closes over arrays on a mesh of explicit axes, which JAX refuses; expected "
            "them as leaves of the function: use jax.tree_util.Partial(function, *arrays), or an "
            "equinox.Module"
        ) from error
    return eqx.combine(given, rest[0])


def _on(x: Any) -> NamedSharding:
    """Return the sharding in the type of a leaf."""
    return jax.typeof(x).sharding if isinstance(x, jax.Array) else NOWHERE
