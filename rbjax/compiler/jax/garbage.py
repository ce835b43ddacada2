"""A pause of Python's garbage collector during tracing.

A trace makes thousands of objects and frees none. The collector would search them for cycles after
every 700 new objects, which takes a quarter of the tracing time.
"""

from __future__ import annotations

import contextlib
import gc
import threading
from collections.abc import Iterator

#: the threshold of the collector during a pause; a value that no other code is likely to set
PAUSED = 1_000_000_007
_lock = threading.Lock()
_running = 0  # pauses in progress, in all threads
_threshold: tuple[int, ...] = ()


@contextlib.contextmanager
def gc_paused() -> Iterator[None]:
    """Pause the collector in a `with` block, or in a function decorated with `gc_paused()`.

    The collector stays enabled, but its threshold is raised. If other code sets a threshold during
    the pause, in any thread, that threshold is kept.
    """
    global _running, _threshold
    with _lock:
        _running += 1
        if _running == 1:
            _threshold = gc.get_threshold()
            if _threshold[0]:  # 0 means that the collector never runs
                gc.set_threshold(PAUSED, *_threshold[1:])
    try:
        yield
    finally:
        with _lock:
            _running -= 1
            if not _running and gc.get_threshold()[0] == PAUSED:
                gc.set_threshold(*_threshold)
