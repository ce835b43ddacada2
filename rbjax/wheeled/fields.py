"""Numeric fields of robots, motors and tyres, and checks of their shapes and ranges."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.model.record import Record, check_fields, check_numbers, floats

#: fields of tyres that must be scalars, also if other fields may be (2,)
_SHARED = ("smooth_speed", "damping_time")
_NO_RANGE: Mapping[str, Any] = {}


def number(**given: Any) -> Any:
    """Declare a numeric field of a record, with a `default` if one is given."""
    return eqx.field(converter=floats, **given)


def check_ranges(
    record: Record,
    *,
    pairs: Sequence[str] = (),
    tables: Sequence[str] = (),
    per_axis: bool = False,
    above: Mapping[str, Any] = _NO_RANGE,
    least: Mapping[str, Any] = _NO_RANGE,
    most: Mapping[str, Any] = _NO_RANGE,
) -> None:
    """Raise `InputError` unless all numeric fields of a record have valid shapes and ranges.

    Args:
        record: its fields are numbers, other records, or static.
        pairs: names of fields of two numbers, x and y.
        tables: names of fields of any shape.
        per_axis: whether a field may also be (2,), one number along the wheel and one across.
        above: field -> limit; the field must be larger.
        least: field -> limit; the field must be at least as large.
        most: field -> limit; the field must be at most as large.

    A limit is a number, or the name of another field. Traced values are not checked.
    """
    check_fields(record)
    for field in dataclasses.fields(record):
        value, where = getattr(record, field.name), f"{type(record).__name__}({field.name}=...)"
        if value is None or not _is_number(field):
            continue
        check_numbers(where, value, infinite=record.may_be_infinite(field.name))
        shape = jnp.shape(value)
        if field.name in pairs:
            if shape != (2,):
                raise InputError(f"{where}: got shape {shape}, expected (2,), x and y in m")
        elif (
            shape != ()
            and field.name not in tables
            and not (per_axis and shape == (2,) and field.name not in _SHARED)
        ):
            fix = ", or (2,): one along the wheel and one across" if per_axis else ""
            raise InputError(
                f"{where}: got the shape {shape}, expected a number{fix}; for many use jax.vmap"
            )
    _check(record, above, np.greater, "above")
    _check(record, least, np.greater_equal, "of at least")
    _check(record, most, np.less_equal, "of at most")


def _is_number(field: dataclasses.Field) -> bool:
    """Check that a field is declared as an array; equinox resolves the types of some fields."""
    if isinstance(field.type, str):
        return field.type.startswith("jax.Array")
    return jax.Array in (typing.get_args(field.type) or (field.type,))


def _check(record: Record, limits: Mapping[str, Any], within: Callable, text: str) -> None:
    for name, limit in limits.items():
        value, origin = getattr(record, name), ""
        if isinstance(limit, str):
            limit, origin = getattr(record, limit), f", its {limit}"
        if value is None or any(isinstance(x, jax.core.Tracer) for x in (value, limit)):
            continue
        if not np.all(within(np.asarray(value), np.asarray(limit))):
            raise InputError(
                f"{type(record).__name__}({name}=...): got {np.asarray(value).tolist()}, expected "
                f"numbers {text} {np.asarray(limit).tolist()}{origin}"
            )
