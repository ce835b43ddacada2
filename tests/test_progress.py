"""A line of progress: on a terminal only."""

import io
import sys

import pytest

from rbjax.progress import progress_line


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stream", "show", "seen"),
    [(Terminal, True, True), (Terminal, False, False), (io.StringIO, True, False)],
)
def test_a_line_is_for_terminals(monkeypatch, stream, show, seen):
    monkeypatch.setattr(sys, "stderr", stream())
    monkeypatch.setenv("TERM", "xterm")
    with progress_line("count", show) as say:
        say("2 of 3")
    text = sys.stderr.getvalue()
    assert ("count: 2 of 3" in text) == seen and bool(text) == seen
