"""Docstrings of public names: a summary, arguments, shapes and units, results, errors, an example.

Doctests run the examples; `tests.public.docstrings` says what each docstring needs.
"""

import inspect

import numpy as np
import pytest

import rbjax as rb
from tests.public import docstrings


def good(q: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """Scale coordinates.

    Args:
        q: (n,), rad.
        gain: factor, no unit.

    Returns:
        (n,), rad.

    Raises:
        InputError: gain is not positive.

    Example:
        >>> good(np.ones(1)).tolist()
        [1.0]
    """
    if gain <= 0:
        raise rb.InputError("gain")
    return gain * q


@pytest.mark.parametrize(
    "text, part",
    [
        ("(n,), rad", "units"), ("(n,)", "shapes"), ("    gain: factor, no unit.\n", "args"),
        ("Returns:", "returns"), ("Raises:", "raises"), (">>>", "example"),
        ("\nExample:", "blank line"), ("coordinates.", "summary"),
    ],
)  # fmt: skip
def test_what_is_missing_is_found(text, part):
    assert docstrings.missing(good) == []

    def bad(q: np.ndarray, gain: float = 1.0) -> np.ndarray:
        docstrings.real_array(q)
        return q

    doc = inspect.getdoc(good) or ""  # Python 3.13 removes the indentation
    if part == "units":
        doc = doc.replace("rad", "-").replace("no unit", "-")
    elif part == "summary":
        doc = "scale"
    else:
        doc = doc.replace(text, "Example:" if part == "blank line" else "")
    bad.__doc__ = doc
    assert part in docstrings.missing(bad)


def test_docstrings_are_complete():
    found = {name: docstrings.missing(x) for name, x in docstrings.public()}
    lacking = {name: parts for name, parts in found.items() if parts}
    assert not lacking, "\n".join(f"{n}: {', '.join(parts)}" for n, parts in lacking.items())
