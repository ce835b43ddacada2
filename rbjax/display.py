"""Objects in a terminal and in a notebook: `repr` and `_repr_html_` of models and results.

An object is one line of `name=value` if it fits. Otherwise it is a title and a table of at most
`LINES` lines, in a notebook with a picture. An array of few known values prints them, another one
its dtype and shape: `f64[101,2]`. Nothing is computed on a device: values are copied to the host,
and traced, deleted or remote arrays have no values.

A class gets both methods by the decorator `displayed`, or from `rbjax.model.record.Record`. It may
define `_display_`, which returns a `Display`.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.html_page import element, table

#: the largest number of lines and of characters of a line in a terminal
LINES, WIDTH = 15, 100
#: the largest number of rows of a table in a notebook
ROWS = 50
#: arrays of up to this many numbers print their values; larger ones than the second are not copied
FEW, MOST = 6, 10_000
_UNSET = "unset"
_KINDS = {"float": "f", "int": "i", "uint": "u", "complex": "c", "bfloat": "bf"}
T = TypeVar("T", bound=type)


class Display(NamedTuple):
    """The content of a display.

    title: the first line.
    rows: the rows of the table; each is a tuple of texts.
    columns: the names of the columns; () for none.
    notes: lines between the title and the table.
    picture: HTML of a picture, only for notebooks; called only there.
    """

    title: str
    rows: Sequence[Sequence[str]] = ()
    columns: Sequence[str] = ()
    notes: Sequence[str] = ()
    picture: Callable[[], str] | None = None


def displayed(cls: T) -> T:
    """Give a class `__repr__` and `_repr_html_`: a decorator for dataclasses and named tuples."""
    cls.__repr__ = text  # type: ignore[assignment]
    cls._repr_html_ = html  # type: ignore[attr-defined]
    return cls


def display_of(x: Any) -> Display:
    """Return the display of an object: its `_display_()`, or a table of its fields."""
    own = getattr(type(x), "_display_", None)
    return Display(type(x).__name__, field_rows(x)) if own is None else own(x)


def field_rows(x: Any, names: Iterable[str] | None = None) -> list[tuple[str, str]]:
    """Return a row (name, value) for each field, or for the given ones."""
    found = dict(_fields(x))
    return [(n, value_text(found[n])) for n in (found if names is None else names) if n in found]


def text(x: Any) -> str:
    """Return an object as one line if it fits, else as its title and table, for a terminal."""
    if getattr(type(x), "_display_", None) is None and (line := _call(x, WIDTH)):
        return line
    shown = display_of(x)
    head = [shown.title, *(f"  {note}" for note in shown.notes[: LINES - 5])]
    rows = [*([shown.columns] if shown.columns else []), *shown.rows]
    left = LINES - len(head)
    if len(rows) > left:
        kept = left - 1
        rows, more = rows[:kept], [f"  ... {len(rows) - kept} more"]
    else:
        more = []
    return "\n".join(_clipped(line, WIDTH) for line in [*head, *_aligned(rows), *more])


def html(x: Any) -> str:
    """Return an object as a title, a picture and a table, for a notebook."""
    shown = display_of(x)
    parts = [element("b", shown.title), *(element("div", note) for note in shown.notes)]
    if shown.picture is not None:
        parts.append(f"<div>{shown.picture()}</div>")
    if shown.rows:
        rows = list(shown.rows[:ROWS])
        if len(shown.rows) > ROWS:
            rows.append([f"... {len(shown.rows) - ROWS} more"])
        parts.append(table(shown.columns, rows, style="text-align: left"))
    return f"<div>{''.join(parts)}</div>"


def host(x: Any, most: int = MOST) -> np.ndarray | None:
    """Copy an array to the host. Return None if its values are unknown (traced, deleted, on another
    process), or more than `most`."""
    if isinstance(x, (bool, int, float, np.ndarray, np.generic)):
        known = np.asarray(x)
        return known if known.size <= most else None
    if not isinstance(x, jax.Array) or isinstance(x, jax.core.Tracer) or x.size > most:
        return None
    opaque = jnp.issubdtype(x.dtype, jax.dtypes.extended)  # keys of random numbers
    if opaque or x.is_deleted() or not x.is_fully_addressable:
        return None
    return np.asarray(jax.device_get(x))


def shape(x: Any) -> tuple[int, ...]:
    """Return the shape of an array or a number, and () for other objects, such as None."""
    found = getattr(x, "shape", ())
    return tuple(found) if isinstance(found, tuple) else ()


def number(x: Any) -> str:
    """Format a number with four digits."""
    x = x.item() if isinstance(x, np.ndarray | np.generic) else x
    return f"{x:.4g}" if isinstance(x, float | complex) else str(x)


def plural(count: int, name: str) -> str:
    """Format a count and its noun: "1 joint", "2 joints", "2 bodies"."""
    if count == 1:
        return f"1 {name}"
    return f"{count} {name[:-1]}ies" if name.endswith("y") else f"{count} {name}s"


def array_text(x: Any, dtype: bool = True) -> str:
    """Format an array: a number, `f64[2] [0.1, 0.2]` (without its type unless `dtype`), or
    `f64[101,2]`."""
    values = host(x) if x.size <= FEW and x.ndim <= 1 else None
    if values is not None and values.ndim == 0:
        return number(values)
    sizes = f"{short_dtype(x.dtype)}[{','.join(map(str, x.shape))}]"
    if values is None:
        return sizes
    numbers = f"[{', '.join(number(v) for v in values)}]"
    return f"{sizes} {numbers}" if dtype else numbers


def short_dtype(dtype: Any) -> str:
    """Return the short name of a dtype: f32, i64, bool."""
    name = str(dtype)
    kind = name.rstrip("0123456789")
    return _KINDS[kind] + name[len(kind) :] if kind in _KINDS else name


def value_text(x: Any, width: int = WIDTH - 20) -> str:
    """Format a value on one line of at most `width` characters."""
    return _clipped(_value(x, width), width)


def _value(x: Any, width: int) -> str:
    if isinstance(x, enum.Enum) or x is None or isinstance(x, bool | int | str | bytes):
        return str(x) if isinstance(x, enum.Enum) else repr(x)
    if isinstance(x, float | complex | np.generic):
        return number(x)
    if isinstance(x, jax.Array | np.ndarray | jax.ShapeDtypeStruct):
        return array_text(x) if isinstance(x.shape, tuple) else type(x).__name__
    if isinstance(x, type):
        return x.__name__
    if getattr(type(x), "_display_", None) is not None:
        return display_of(x).title
    if type(x).__repr__ is text or _is_named_tuple(x) or type(x).__repr__ is eqx.Module.__repr__:
        return _call(x, width, cut=True)
    if isinstance(x, Mapping):
        items = (f"{_value(k, width)}: {_value(v, width)}" for k, v in x.items())
        return _joined("{", items, "}", len(x), width)
    if isinstance(x, tuple | list):
        last = ",)" if isinstance(x, tuple) and len(x) == 1 else ")"
        ends = ("(", last) if isinstance(x, tuple) else ("[", "]")
        return _joined(ends[0], (_value(v, width) for v in x), ends[1], len(x), width)
    if callable(x) and hasattr(x, "__name__"):
        return f"<{x.__name__}>"
    if isinstance(x, functools.partial):
        return f"<{getattr(x.func, '__name__', 'partial')}>"
    return repr(x).partition("\n")[0]


def _joined(start: str, items: Iterable[str], end: str, count: int, width: int) -> str:
    """Join items, as many as fit into `width` characters. If some do not fit, append their
    number."""
    out: list[str] = []
    used = len(start) + len(end)
    for item in itertools.islice(items, width):
        used += len(item) + 2
        if used > width:
            return f"{start}{''.join(f'{x}, ' for x in out)}... {count} in all{end}"
        out.append(item)
    return f"{start}{', '.join(out)}{end}"


def _call(x: Any, width: int, cut: bool = False) -> str:
    """Format an object as `Name(field=value, ...)`. If the line is too long, return "", or with
    `cut` the first fields and `...`."""
    parts: list[str] = []
    used = len(type(x).__name__) + 2
    for name, value in _fields(x):
        part = f"{name}={_value(value, width)}"
        used += len(part) + 2
        if used - 2 > width:
            parts = [*parts, "..."]
            break
        parts.append(part)
    if not cut and parts[-1:] == ["..."]:
        return ""
    return f"{type(x).__name__}({', '.join(parts)})"


def _fields(x: Any) -> Iterable[tuple[str, Any]]:
    """Yield the names and values of fields, without those that have their default, None."""
    if _is_named_tuple(x):
        names = [(n, x._field_defaults.get(n, _UNSET)) for n in x._fields]
    elif dataclasses.is_dataclass(x):
        names = [(f.name, f.default) for f in dataclasses.fields(x) if f.repr]
    else:
        names = []
    for name, default in names:
        value = getattr(x, name, _UNSET)
        if value is None and default is None:
            continue
        yield name, value


def _is_named_tuple(x: Any) -> bool:
    return isinstance(x, tuple) and hasattr(x, "_fields")


def _clipped(line: str, width: int) -> str:
    line = line.replace("\n", " ")
    return line if len(line) <= width else f"{line[: width - 3]}..."


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    columns = max(map(len, rows), default=0)
    full = [[*row, *[""] * (columns - len(row))] for row in rows]
    widths = [max(map(len, column)) for column in zip(*full, strict=True)]
    return ["  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in full]
