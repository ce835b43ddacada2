"""A pytest plugin (`-p tests.mutation.executed`): which lines of rbjax each passing test executes,
and what it costs: a line of JSON a test, in the file that RBJAX_EXECUTED names.

Python's lines are what matters, since a program's faults are there where it is traced. Lines that
run before the first test (imports) belong to every test of the run.
"""

import json
import os
import sys
import time
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path.cwd()
INSIDE = str(ROOT / "rbjax") + os.sep

_lines: dict[str, set[int]] = defaultdict(set)
_passed: set[str] = set()


def _called(frame, _event, _arg):
    if not frame.f_code.co_filename.startswith(INSIDE):
        return None
    seen = _lines[frame.f_code.co_filename]

    def _line(frame, _event, _arg):
        seen.add(frame.f_lineno)
        return _line

    return _line


def _write(name: str, cost: float) -> None:
    """A line for what has run since the last."""
    found = {os.path.relpath(file, ROOT): sorted(seen) for file, seen in _lines.items() if seen}
    _lines.clear()
    with Path(os.environ["RBJAX_EXECUTED"]).open("a") as out:
        out.write(json.dumps({"test": name, "cost": cost, "lines": found}) + "\n")


def pytest_configure() -> None:
    sys.settrace(_called)


def pytest_unconfigure() -> None:
    sys.settrace(None)


def pytest_collection_finish() -> None:
    _write("", 0.0)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    start = time.process_time()
    try:
        return (yield)
    finally:
        if item.nodeid in _passed:
            _write(item.nodeid, time.process_time() - start)


def pytest_runtest_logreport(report) -> None:
    if report.when == "call" and report.passed:
        _passed.add(report.nodeid)
