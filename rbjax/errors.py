"""The errors of rbjax. Each message contains the received value, the expected one, and the fix."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence

#: largest number of names of which an `UnknownName` lists all; of more names it lists half as many,
#: the nearest ones
LISTED = 40


def listed(names: Sequence[str], shown: int = 4) -> str:
    """Format names for a message: the first few, and the number of the rest."""
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(names[:shown]) + more


class RbjaxError(Exception):
    """Base class of all errors of rbjax."""


class ModelError(RbjaxError, ValueError):
    """Error of a robot file, or of a model built from it, that cannot be simulated."""


class UnsupportedFeature(RbjaxError, ValueError):
    """Error of a file with a feature that rbjax does not support, raised with ``strict=True``."""


class InputError(RbjaxError, ValueError):
    """Error of an argument with a wrong shape, dtype or value."""


class MissingPackage(InputError, ImportError):
    """Error of a call that needs an optional package which is not installed."""


def _nearest(known: Sequence[str], name: object) -> str:
    """Format known names for a message: all, or the nearest to an unknown name."""
    more = ""
    if len(known) > LISTED:
        text = [str(n) for n in known]
        nearest = set(difflib.get_close_matches(str(name)[:80], text, LISTED // 2, 0.0))
        more = f" and {len(known) - len(nearest)} more"
        known = [n for n in known if str(n) in nearest]
    return (", ".join(repr(n) for n in known) or "(there are none)") + more


class UnknownName(RbjaxError, KeyError):
    """Error of a name that does not exist. The message lists the valid names, and the nearest one.

    apart: the valid names by kind, such as {"joint": [...], "site": [...]}, if there are several
        lists; None for one list.
    synonyms: other words for valid names, such as those of a book: word -> valid name.
    """

    def __init__(
        self,
        kind: str,
        name: object,
        valid: Iterable[str] = (),
        *,
        apart: Mapping[str, Sequence[str]] | None = None,
        synonyms: Mapping[str, str] | None = None,
    ):
        groups = {kind: list(valid)} if apart is None else apart
        known = [n for names in groups.values() for n in names]
        shown = repr(name) if len(repr(name)) <= 80 else f"{repr(name)[:77]}..."
        text = [str(n) for n in known]
        meant = (synonyms or {}).get(str(name))
        near = [meant] if meant else difflib.get_close_matches(str(name)[:80], text, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        lists = (
            f"known {'' if apart is None else word + ' '}names: {_nearest(x, name)}"
            for word, x in groups.items()
        )
        self.message = f"unknown {kind} {shown}; {'; '.join(lists)}{hint}"
        super().__init__(self.message)

    def __str__(self) -> str:
        return self.message
