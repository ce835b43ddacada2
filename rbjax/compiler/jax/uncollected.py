"""Work that makes objects by the ten thousand and lets none go.

Python searches all young objects for dead cycles whenever 700 more are alive, which takes a quarter
of the time of a trace.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


#: the threshold of new objects during such work; a number that nobody else would set
SEARCH_FROM = 1_000_000_007
_lock = threading.Lock()
_running = 0  # calls that run now, in all threads
_usual: tuple[int, ...] = ()


def uncollected(f: F) -> F:
    """f, during which Python does not search for dead cycles. The collector is not switched off:
    its threshold is raised. If another caller sets a threshold meanwhile, in any thread, it
    stays."""

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        with collection_paused():
            return f(*args, **kwargs)

    return call  # type: ignore[return-value]


@contextlib.contextmanager
def collection_paused() -> Iterator[None]:
    """`uncollected` of a block."""
    _begin()
    try:
        yield
    finally:
        _end()


def _begin() -> None:
    global _running, _usual
    with _lock:
        _running += 1
        if _running == 1:
            _usual = gc.get_threshold()
            if _usual[0]:  # 0: never
                gc.set_threshold(SEARCH_FROM, *_usual[1:])


def _end() -> None:
    global _running
    with _lock:
        _running -= 1
        if not _running and gc.get_threshold()[0] == SEARCH_FROM:
            gc.set_threshold(*_usual)
