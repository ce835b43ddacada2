"""Argument checks of functions of one rigid body and of the forces on it."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.errors import InputError
from rbjax.rotations.arguments import SHAPES
from rbjax.spatial.arguments import checked


def one(where: str, name: str, value: Any, kind: str) -> jax.Array:
    """An argument without leading axes, of a kind of `rbjax.rotations.arguments.SHAPES`.

    Raises:
        InputError: not an array, another shape or dtype, values that are not finite.
    """
    x = checked(where, name, value, kind)
    if x.shape != SHAPES[kind]:
        raise InputError(
            f"{where}: {name} has shape {x.shape}, expected {SHAPES[kind]}; for a batch use "
            "jax.vmap"
        )
    return x


def row(where: str, name: str, value: Any) -> jax.Array:
    """An argument of shape (n,), such as coordinates.

    Raises:
        InputError: not an array, another shape or dtype, values that are not finite.
    """
    x = checked(where, name, value, "scalar")
    if x.ndim != 1 or not x.size:
        raise InputError(
            f"{where}: {name} has shape {x.shape}, expected (n,), n at least 1; for a batch use "
            "jax.vmap"
        )
    return x


def as_array(value: Any) -> Any:
    """The converter of a field. A value that is not an array stays, and `Force` rejects it."""
    try:
        return jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        return value


def field(kind: str, **options: Any) -> Any:
    """A field of a `Force`: an array of a kind of `rbjax.rotations.arguments.SHAPES`."""
    return eqx.field(converter=as_array, metadata={"kind": kind}, **options)


class Force(eqx.Module):
    """A force with fields made by `field`, which are checked."""

    def __check_init__(self) -> None:
        for name, of in self.__dataclass_fields__.items():
            checked(type(self).__name__, name, getattr(self, name), of.metadata["kind"])
