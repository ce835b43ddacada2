"""A pause of Python's garbage collector during tracing.

A trace makes thousands of objects and frees none. The collector would search them for cycles at
every 700 new objects, a quarter of the time of a trace.
"""

from __future__ import annotations

import contextlib
import gc
import threading
from collections.abc import Iterator

#: the threshold of the collector during a pause; a number that nobody else would set
PAUSED = 1_000_000_007
_lock = threading.Lock()
_running = 0  # pauses in progress, in all threads
_threshold: tuple[int, ...] = ()


@contextlib.contextmanager
def gc_paused() -> Iterator[None]:
    """Pause the collector in a block, or in a function that is decorated with `gc_paused()`.

    The collector is not switched off: its threshold is raised. If another caller sets a threshold
    meanwhile, in any thread, it stays.
    """
    global _running, _threshold
    with _lock:
        _running += 1
        if _running == 1:
            _threshold = gc.get_threshold()
            if _threshold[0]:  # 0: never
                gc.set_threshold(PAUSED, *_threshold[1:])
    try:
        yield
    finally:
        with _lock:
            _running -= 1
            if not _running and gc.get_threshold()[0] == PAUSED:
                gc.set_threshold(*_threshold)
