"""Records: immutable pytrees with named fields, of which a model is made."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError, UnknownName

#: up to so many numbers are looked at on the host; more stay where they are
FEW = 10_000
_RESIZE = "; build a new model to change its size, or jax.vmap over models to have many"


class Record(eqx.Module):
    """An immutable pytree with named fields."""

    def replace(self, **changes: Any):
        """A copy with the given fields changed; shapes of arrays must stay, values be numbers."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        for name, value in changes.items():
            if name not in fields:
                raise UnknownName(f"field of {type(self).__name__}", name, fields)
            old = fields[name]
            if eqx.is_array(old):
                where = f"{type(self).__name__}.replace({name}=...)"
                endless = self.may_be_endless(name)
                value = array_like(where, value, old.shape, old.dtype, endless=endless, fix=_RESIZE)
            fields[name] = value
        return type(self)(**fields)

    def may_be_endless(self, name: str) -> bool:
        """Whether infinity stands for something in a field: no limit, in a range."""
        return name.endswith("range")


def array_like(
    where: str, value: Any, shape: tuple[int, ...], dtype: Any, *, endless: bool, fix: str = ""
) -> jax.Array:
    """A value as an array of the shape and dtype, of real numbers that `check_numbers` takes."""
    try:
        new = jnp.asarray(value)
        new = new.astype(dtype) if _is_real(new.dtype) else new
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{where}: got {type(value).__name__}, expected numbers of shape {shape}"
        ) from error
    if new.shape != shape:
        raise InputError(f"{where}: got shape {new.shape}, expected {shape}{fix}")
    check_numbers(where, new, endless=endless)
    return new


def check_numbers(where: str, x: Any, *, endless: bool) -> None:
    """Refuse known values that are no real numbers: NaN, and infinity unless it is allowed."""
    if not hasattr(x, "dtype"):
        x = np.asarray(x)
    if not _is_real(x.dtype):
        raise InputError(f"{where}: got numbers of dtype {x.dtype}, expected real ones")
    if isinstance(x, jax.core.Tracer) or not jnp.issubdtype(x.dtype, jnp.floating):
        return
    xp = np if x.size <= FEW else jnp
    wrong = xp.isnan(x) if endless else ~xp.isfinite(x)
    if wrong.any():
        at = tuple(map(int, np.argwhere(np.asarray(wrong))[0]))
        raise InputError(f"{where}: got {np.asarray(x)[at]} at {list(at)}, expected finite numbers")


def _is_real(dtype: Any) -> bool:
    return any(jnp.issubdtype(dtype, kind) for kind in (jnp.floating, jnp.integer, jnp.bool_))


def floats(x: Any) -> Any:
    """A field's converter: numbers as an array. What is none stays for `check_fields` to refuse."""
    if isinstance(x, (str, bytes)):  # NumPy reads "1" as a number
        return x
    try:
        return x if hasattr(x, "dtype") else jnp.asarray(x, float)
    except (TypeError, ValueError, OverflowError):
        return x


def check_number(record: Record, name: str, *, positive: bool = False) -> None:
    """Refuse a field that is no number, or not above zero where that is due."""
    check_fields(record)
    value, where = getattr(record, name), f"{type(record).__name__}({name}=...)"
    if jnp.shape(value) != ():
        raise InputError(f"{where}: got the shape {jnp.shape(value)}, expected a number")
    if positive:
        check_above_zero(where, value)


def check_above_zero(where: str, value: Any) -> None:
    """Raise if a value that is not traced is not above zero."""
    if isinstance(value, jax.core.Tracer):
        return
    wrong = ~(np.asarray(value) > 0)
    if wrong.any():
        at = tuple(map(int, np.argwhere(wrong)[0]))
        place = f" at {list(at)}" if at else ""
        got = np.asarray(value)[at]
        raise InputError(f"{where}: got {got}{place}, expected a number above zero")


def check_fields(record: Record) -> None:
    """Refuse fields of a record of a user that are no arrays of numbers, or no tuples, where these
    are due."""
    for f in dataclasses.fields(record):
        value, where = getattr(record, f.name), f"{type(record).__name__}({f.name}=...)"
        optional = f.type == "jax.Array | None" and value is not None
        if optional or f.type in ("jax.Array", jax.Array):
            if not (eqx.is_array(value) or isinstance(value, (np.ndarray, np.generic, float))):
                raise InputError(
                    f"{where}: got {type(value).__name__}, expected an array of numbers, as "
                    "jax.numpy.asarray makes it"
                )
            check_numbers(where, value, endless=record.may_be_endless(f.name))
        named = str(f.type).startswith("tuple[") and not isinstance(value, tuple)
        if named and (value is not None or "None" not in str(f.type)):
            raise InputError(f"{where}: got {type(value).__name__}, expected a tuple")


def cast_floats(tree: Any, dtype: Any) -> Any:
    """Convert the floating-point leaves of a pytree to a dtype."""

    def cast(x: Any) -> Any:
        floating = jnp.issubdtype(jnp.result_type(x), jnp.floating)
        return jnp.asarray(x, dtype) if floating else x

    return jax.tree.map(cast, tree)
