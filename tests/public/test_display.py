"""Every public class of data shows itself in few lines, whatever its leaves are."""

import dataclasses
import inspect
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from docs.generate.reference import rooms
from rbjax import display

SKIPPED = ("viewer",)  # its classes hold models and files


def public_classes() -> dict[str, type]:
    """The classes of `rb.__all__`, of the rooms' `__all__` and of the modules in it, and the
    results of public functions, by name."""
    found: dict[str, type] = {}

    def add(room: Any, prefix: str) -> None:
        for name in getattr(room, "__all__", ()):
            x = getattr(room, name)
            if inspect.ismodule(x) and prefix.count(".") < 2:
                add(x, f"{prefix}{name}.")
            elif inspect.isclass(x) and x not in found.values():
                found[prefix + name] = x

    add(rb, "")
    for paths in rooms.results().values():
        found |= {path.removeprefix("rbjax."): cls for path, cls in paths.items()}
    return {name: x for name, x in found.items() if not name.startswith(SKIPPED)}


CLASSES = public_classes()
SHOWN = {name: x for name, x in CLASSES.items() if x.__repr__ is display.text}


def array_fields(cls: type) -> bool:
    """Whether a named tuple or a record has a field of arrays."""
    named = issubclass(cls, tuple) and hasattr(cls, "_fields")
    record = issubclass(cls, rb.model.record.Record)
    kinds = [str(x) for c in cls.__mro__ for x in vars(c).get("__annotations__", {}).values()]
    return (named or record) and any("Array" in k or "ndarray" in k for k in kinds)


def test_every_class_of_arrays_shows_itself():
    assert len(SHOWN) > 250
    missing = [n for n, x in CLASSES.items() if array_fields(x) and n not in SHOWN]
    assert not missing, f"decorate with rbjax.display.displayed: {missing}"
    assert all(hasattr(x, "_repr_html_") for x in SHOWN.values())


LEAVES = {
    "many": np.zeros((1000, 3)),
    "tracer": jnp.zeros((4, 4)),
    "none": None,
    "text": "a line\n" * 50,
    "tuple": tuple(np.arange(9.0) for _ in range(50)),
}


@pytest.mark.parametrize("leaf", LEAVES.values(), ids=LEAVES)
def test_any_leaf_shows_in_few_lines(leaf):
    """Objects are made without their checks, with the same leaf in every field."""
    for name, cls in SHOWN.items():
        if inspect.isabstract(cls) or hasattr(cls, "_display_"):
            continue  # tests/test_display.py has those with a display of their own
        if issubclass(cls, tuple):
            x = tuple.__new__(cls, [leaf] * len(cls._fields))  # type: ignore[attr-defined]
        else:
            x = object.__new__(cls)
            for field in dataclasses.fields(cls):  # type: ignore[arg-type]
                object.__setattr__(x, field.name, leaf)
        found = repr(x).splitlines()
        assert len(found) <= display.LINES, name
        assert max(map(len, found)) <= display.WIDTH, name
        assert x._repr_html_().count("<tr>") <= display.ROWS + 2, name
