"""The errors of rbjax. Each message says what was got, what was expected, and the fix."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def listed(names: Sequence[str], shown: int) -> str:
    """Names for a message: the first few, and the number of the others."""
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(names[:shown]) + more


class RbjaxError(Exception):
    """The base class of all errors of rbjax."""


class ModelError(RbjaxError, ValueError):
    """A robot file, or a model built from it, that cannot be simulated."""


class UnsupportedFeature(RbjaxError, ValueError):
    """The file has a feature that rbjax leaves out. Raised with ``strict=True``."""


class InputError(RbjaxError, ValueError):
    """An argument of the wrong shape, dtype or value."""


class UnknownName(RbjaxError, KeyError):
    """A name that does not exist. The message lists the names that do."""

    def __init__(self, kind: str, name: object, valid: Iterable[str]):
        names = ", ".join(repr(n) for n in valid) or "(there are none)"
        self.message = f"unknown {kind} {name!r}; the {kind} names here are: {names}"
        super().__init__(self.message)

    def __str__(self) -> str:
        return self.message
