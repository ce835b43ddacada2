"""Terminal lines with the current task and its time, by rich; without rich there are none."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

from rbjax.errors import MissingPackage
from rbjax.optional import require

Say = Callable[[str], None]


def _terminal() -> tuple[Any, Any] | None:
    """Return rich's console of stderr and its module of bars; None if stderr is not a terminal, or
    if rich is not installed."""
    if not sys.stderr.isatty():
        return None
    try:
        rich = require("progress", "rich.console"), require("progress", "rich.progress")
    except MissingPackage:
        return None
    console = rich[0].Console(stderr=True, force_jupyter=False)
    return (console, rich[1]) if console.is_terminal else None


def has_live_lines() -> bool:
    """Return whether `progress_line` shows a line.

    >>> has_live_lines()  # not in a test
    False
    """
    return _terminal() is not None


@contextlib.contextmanager
def progress_line(label: str, show: bool = True) -> Iterator[Say]:
    """Show a transient line on stderr, if stderr is a terminal and rich is installed.

    Args:
        label: name of the running task, at the start of the line.
        show: False for no line.

    Returns:
        A context manager that yields a function to set the text of the line.

    Example:
        >>> from rbjax.progress import progress_line
        >>> with progress_line("count", show=False) as say:
        ...     for k in range(3):
        ...         say(f"{k} of 3")
    """
    found = _terminal() if show else None
    if found is None:
        yield lambda text: None
        return
    console, rich = found
    text = rich.TextColumn(label + ": {task.description}")
    columns = (rich.SpinnerColumn(), rich.TimeElapsedColumn(), text)
    with rich.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("")
        yield lambda text: bar.update(task, description=text)


@contextlib.contextmanager
def progress_bar(label: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show a transient bar on stderr, if stderr is a terminal and rich is installed.

    Returns:
        A context manager that yields a function to set the number done.

    Example:
        >>> from rbjax.progress import progress_bar
        >>> with progress_bar("draw", 3) as done:
        ...     done(1)
    """
    found = _terminal()
    if found is None:
        yield lambda done: None
        return
    console, rich = found
    columns = (rich.TextColumn("{task.description}"), rich.BarColumn(), rich.TimeRemainingColumn())
    with rich.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(label, total=total)
        yield lambda done: bar.update(task, completed=done)
