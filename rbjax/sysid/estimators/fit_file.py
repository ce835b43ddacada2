"""The file of a fit: what it found, and where it goes on."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rbjax.errors import InputError
from rbjax.sysid.arguments import floats


def write_fit(path: str | Path, names: Sequence[str], x: np.ndarray, **more: Any) -> None:
    """Writes a fit as JSON. It replaces the file at once: one that is cut off harms nothing.

    Args:
        path: of the file.
        names: (n,) of the parameters.
        x: (n + more,) their values, then the corrections of starts, where those are sought.
        more: anything that JSON can hold.
    """
    values = dict(zip(names, map(float, x), strict=False))
    held = {"values": values, "starts": np.asarray(x[len(names) :]).tolist(), **more}
    path = Path(path)
    beside = path.with_name(path.name + ".part")
    beside.write_text(json.dumps(held, indent=1), encoding="utf-8")
    beside.replace(path)


def read_fit(fit: str | Path | Mapping[str, float], names: Sequence[str]) -> np.ndarray:
    """x of a file of `write_fit`, or of values by name.

    Raises:
        InputError: no such file, or a fit of other parameters.
    """
    if not isinstance(fit, (str, Path, Mapping)):
        raise InputError(
            f"identify: resume is {type(fit).__name__}, expected the file of a fit, or a dict "
            "name -> value"
        )
    path, values, starts = ("resume", fit, []) if isinstance(fit, Mapping) else _read(Path(fit))
    if list(values) != list(names):
        other = sorted(set(values) ^ set(names))
        raise InputError(
            f"identify: {path} is a fit of {len(values)} parameters, expected the same "
            f"{len(names)} in the same order; only one of the two has: {', '.join(other) or 'none'}"
        )
    found = floats("identify", f"{path}", [*values.values(), *starts], "a fit of numbers")
    if not np.isfinite(found).all():
        raise InputError(f"identify: {path} has values that are not finite, expected a fit")
    return found


def _read(path: Path) -> tuple[str, Mapping[str, float], list[float]]:
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        return str(path), held["values"], held["starts"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"identify: cannot go on from {path} ({error!r}), expected a file that a fit wrote"
        ) from error
