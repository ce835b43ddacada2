"""A terminal line with the current task and its time."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

Say = Callable[[str], None]


@contextlib.contextmanager
def progress_line(label: str, show: bool = True) -> Iterator[Say]:
    """Show a transient line on stderr, if stderr is a terminal.

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
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True, force_jupyter=False)
    columns = (SpinnerColumn(), TimeElapsedColumn(), TextColumn(label + ": {task.description}"))
    if not (show and console.is_terminal):
        yield lambda text: None
        return
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("")
        yield lambda text: bar.update(task, description=text)
