"""The errors of rbjax. Each message says what was got, what was expected, and the fix."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

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


class UnknownName(RbjaxError, KeyError):
    """A name that does not exist. The message lists the valid names, and the nearest one."""

    def __init__(self, kind: str, name: object, valid: Iterable[str]):
        known = list(valid)
        shown = repr(name) if len(repr(name)) <= 80 else f"{repr(name)[:77]}..."
        text = [str(n) for n in known]
        near = difflib.get_close_matches(str(name)[:80], text, 1)
        more = ""
        if len(known) > LISTED:
            nearest = set(difflib.get_close_matches(str(name)[:80], text, LISTED // 2, 0.0))
            more = f" and {len(known) - len(nearest)} more"
            known = [n for n in known if str(n) in nearest]
        names = (", ".join(repr(n) for n in known) or "(there are none)") + more
        hint = f"; did you mean {near[0]!r}?" if near else ""
        self.message = f"unknown {kind} {shown}; the {kind} names here are: {names}{hint}"
        super().__init__(self.message)

    def __str__(self) -> str:
        return self.message
