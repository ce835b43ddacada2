"""Records: immutable pytrees with named fields, and checks of their fields."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax import display
from rbjax.arguments import shown
from rbjax.errors import InputError, UnknownName

#: arrays of up to this size are checked on the host, larger ones on their device
FEW = 10_000
_RESIZE = "; build a new model to change its size, or jax.vmap over models to have many"


class Record(eqx.Module):
    """An immutable pytree with named fields. It displays itself (`rbjax.display`)."""

    __repr__ = display.text
    _repr_html_ = display.html

    def replace(self, **changes: Any):
        """Return a copy with the given fields changed. Arrays must keep their shapes."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        for name, value in changes.items():
            if name not in fields:
                raise UnknownName(f"field of {type(self).__name__}", name, fields)
            old = fields[name]
            if eqx.is_array(old):
                where = f"{type(self).__name__}.replace({name}=...)"
                infinite = self.may_be_infinite(name)
                value = array_like(
                    where, value, old.shape, old.dtype, infinite=infinite, fix=_RESIZE
                )
            fields[name] = value
        return type(self)(**fields)

    def may_be_infinite(self, name: str) -> bool:
        """Return True if a field may be infinite: a range without limits."""
        return name.endswith("range")


def array_like(
    where: str, value: Any, shape: tuple[int, ...], dtype: Any, *, infinite: bool, fix: str = ""
) -> jax.Array:
    """Convert a value to an array of the given shape and dtype, and check that it is finite."""
    try:
        new = jnp.asarray(value)
        new = new.astype(dtype) if _is_real(new.dtype) else new
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{where}: got {type(value).__name__}, expected numbers of shape {shape}"
        ) from error
    if new.shape != shape:
        raise InputError(f"{where}: got shape {new.shape}, expected {shape}{fix}")
    check_numbers(where, new, infinite=infinite)
    return new


def check_numbers(where: str, x: Any, *, infinite: bool) -> None:
    """Raise `InputError` if untraced values are NaN, infinite (unless allowed) or not real."""
    if not hasattr(x, "dtype"):
        x = np.asarray(x)
    if not _is_real(x.dtype):
        raise InputError(f"{where}: got numbers of dtype {x.dtype}, expected real ones")
    if isinstance(x, jax.core.Tracer) or not jnp.issubdtype(x.dtype, jnp.floating):
        return
    xp = np if x.size <= FEW else jnp
    wrong = xp.isnan(x) if infinite else ~xp.isfinite(x)
    if wrong.any():
        at = tuple(map(int, np.argwhere(np.asarray(wrong))[0]))
        raise InputError(f"{where}: got {np.asarray(x)[at]} at {list(at)}, expected finite numbers")


def check_rows(where: str, rows: Any, count: int) -> None:
    """Raise `InputError` unless `rows` is a tuple of indices below `count`."""
    if not isinstance(rows, tuple) or not all(
        isinstance(i, int | np.integer) and 0 <= i < count for i in rows
    ):
        raise InputError(
            f"{where}: got {shown(rows)}, expected a tuple of indices from 0 to {count - 1}"
        )


def check_least(where: str, x: Any, *, above: bool = False) -> None:
    """Raise `InputError` if untraced numbers are below zero, or zero if `above` is set."""
    if isinstance(x, jax.core.Tracer):
        return
    least = float(np.min(x, initial=np.inf))
    if least < 0 or (above and least == 0):
        expected = "above 0" if above else "of at least 0"
        raise InputError(f"{where}: got {least}, expected numbers {expected}")


def check_order(where: str, ranges: Any) -> None:
    """Raise `InputError` if an untraced range (n, 2) has its larger number first."""
    if isinstance(ranges, jax.core.Tracer):
        return
    wrong = np.flatnonzero(np.asarray(ranges[:, 0] > ranges[:, 1]))
    if len(wrong):
        raise InputError(
            f"{where}: got {np.asarray(ranges)[wrong[0]].tolist()} at [{wrong[0]}], expected the "
            "smaller number first"
        )


def _is_real(dtype: Any) -> bool:
    return any(jnp.issubdtype(dtype, kind) for kind in (jnp.floating, jnp.integer, jnp.bool_))


def floats(x: Any) -> Any:
    """Convert a field to an array. Return a value that cannot be converted unchanged."""
    if isinstance(x, (str, bytes)):  # NumPy reads "1" as a number
        return x
    try:
        return x if hasattr(x, "dtype") else jnp.asarray(x, float)
    except (TypeError, ValueError, OverflowError):
        return x


def check_number(record: Record, name: str, *, positive: bool = False) -> None:
    """Raise `InputError` unless a field is a number, and above zero if `positive` is set."""
    check_fields(record)
    value, where = getattr(record, name), f"{type(record).__name__}({name}=...)"
    if jnp.shape(value) != ():
        raise InputError(f"{where}: got the shape {jnp.shape(value)}, expected a number")
    if positive:
        check_above_zero(where, value)


def check_above_zero(where: str, value: Any) -> None:
    """Raise `InputError` if an untraced value has an entry that is not above zero."""
    if isinstance(value, jax.core.Tracer):
        return
    wrong = ~(np.asarray(value) > 0)
    if wrong.any():
        at = tuple(map(int, np.argwhere(wrong)[0]))
        place = f" at {list(at)}" if at else ""
        got = np.asarray(value)[at]
        raise InputError(f"{where}: got {got}{place}, expected a number above zero")


def check_fields(record: Record) -> None:
    """Raise `InputError` if a field annotated as an array or a tuple has another type."""
    for f in dataclasses.fields(record):
        value, where = getattr(record, f.name), f"{type(record).__name__}({f.name}=...)"
        optional = f.type == "jax.Array | None" and value is not None
        if optional or f.type in ("jax.Array", jax.Array):
            if not (eqx.is_array(value) or isinstance(value, (np.ndarray, np.generic, float))):
                raise InputError(
                    f"{where}: got {type(value).__name__}, expected an array of numbers, as "
                    "jax.numpy.asarray makes it"
                )
            check_numbers(where, value, infinite=record.may_be_infinite(f.name))
        named = str(f.type).startswith("tuple[") and not isinstance(value, tuple)
        if named and (value is not None or "None" not in str(f.type)):
            raise InputError(f"{where}: got {type(value).__name__}, expected a tuple")


def cast_floats(tree: Any, dtype: Any) -> Any:
    """Convert the floating-point leaves of a pytree to a dtype."""

    def cast(x: Any) -> Any:
        floating = jnp.issubdtype(jnp.result_type(x), jnp.floating)
        return jnp.asarray(x, dtype) if floating else x

    return jax.tree.map(cast, tree)


def index_of(kind: str, name: str | int, names: tuple[str, ...]) -> int:
    """Return the index of a name. An index is checked and returned."""
    if isinstance(name, (int, np.integer)) and not isinstance(name, bool):
        if 0 <= name < len(names):
            return int(name)
    elif isinstance(name, str) and name in names:
        return names.index(name)
    raise UnknownName(kind, name, names)


#: the contact laws of `rb.contact.laws()`
CONTACT_NAMES = ("mujoco", "coulomb", "impulse")
#: the drivers of the recursions; "auto" is resolved by `rbjax.dynamics.drivers.choice`
DRIVER_NAMES = ("auto", "unrolled", "rolled", "limbs")


class Execution(Record):
    """Options for the execution of algorithms on a model. They do not change the results.

    Fields:
        driver: one of `DRIVER_NAMES`.
        zeros: the entries of leaves that are compile-time constants (`Model.fix_zeros`), or None.
        constants: the precomputed link constants (`with_constants`), or None.
        weights: the precomputed inverse inertias of bodies, dofs and tendons that scale the
            softness of contacts (`rbjax.constraints.equations.soft_weights.with_weights`), or None.
    """

    driver: str = eqx.field(static=True, default="auto")
    zeros: tuple | None = eqx.field(static=True, default=None)
    constants: Any = None
    weights: Any = None

    def __check_init__(self) -> None:
        if self.driver not in DRIVER_NAMES:
            raise UnknownName("driver", self.driver, DRIVER_NAMES)


#: the names of the fields of `Execution`
EXECUTION = tuple(f.name for f in dataclasses.fields(Execution))
#: the fields of a model from which constants and weights are computed
PRECOMPUTED_FROM = frozenset({"bodies", "joints", "gravity", "tendons", "sites", "geoms"})
