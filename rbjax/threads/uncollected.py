"""Work that makes objects by the ten thousand and lets none go.

Python searches all young objects for dead cycles whenever 700 more are alive, which takes a quarter
of the time of a trace.
"""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def uncollected(f: F) -> F:
    """f, during which Python does not search for dead cycles."""

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        if not gc.isenabled():
            return f(*args, **kwargs)
        gc.disable()
        try:
            return f(*args, **kwargs)
        finally:
            gc.enable()

    return call  # type: ignore[return-value]
