"""The errors of rbjax. Each message says what was got, what was expected, and the fix."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence

#: the message of an `UnknownName` lists all names up to this number; above it, half as many, the
#: nearest ones
LISTED = 40


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


def _nearest(known: Sequence[str], name: object) -> str:
    """Names for a message: all, or the nearest to a name that does not exist."""
    more = ""
    if len(known) > LISTED:
        text = [str(n) for n in known]
        nearest = set(difflib.get_close_matches(str(name)[:80], text, LISTED // 2, 0.0))
        more = f" and {len(known) - len(nearest)} more"
        known = [n for n in known if str(n) in nearest]
    return (", ".join(repr(n) for n in known) or "(there are none)") + more


class UnknownName(RbjaxError, KeyError):
    """A name that does not exist. The message lists the valid names, and the nearest one.

    apart: names of several kinds, listed one kind after the other, by the word for the kind.
    """

    def __init__(
        self,
        kind: str,
        name: object,
        valid: Iterable[str] = (),
        *,
        apart: Mapping[str, Sequence[str]] | None = None,
    ):
        groups = {kind: list(valid)} if apart is None else apart
        known = [n for names in groups.values() for n in names]
        shown = repr(name) if len(repr(name)) <= 80 else f"{repr(name)[:77]}..."
        text = [str(n) for n in known]
        near = difflib.get_close_matches(str(name)[:80], text, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        lists = (f"the {word} names here are: {_nearest(x, name)}" for word, x in groups.items())
        self.message = f"unknown {kind} {shown}; {'; '.join(lists)}{hint}"
        super().__init__(self.message)

    def __str__(self) -> str:
        return self.message
