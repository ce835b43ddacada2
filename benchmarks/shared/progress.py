"""How far a benchmark is, and the size of its run. This file is no benchmark."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

T = TypeVar("T")


def progress(items: Iterable[T], name: Callable[[T], Any] = str) -> Iterator[T]:
    """The items, each with a line to stderr: its number and name, the seconds spent and left."""
    items = list(items)
    start = time.perf_counter()
    for done, item in enumerate(items):
        spent = time.perf_counter() - start
        left = f", about {spent / done * (len(items) - done):.0f} s left" if done else ""
        line = f"  {done + 1} of {len(items)}: {name(item)} (after {spent:.0f} s{left})"
        print(line, file=sys.stderr, flush=True)
        yield item


def add_full(parser: argparse.ArgumentParser, full: str, short: str) -> None:
    """The option --full of a benchmark that runs a part of its work by default."""
    parser.add_argument("--full", action="store_true", help=f"{full}, not {short}")


def sized(name: str, full: bool) -> str:
    """The name of the results of a full run, or of a short one, which must not replace them."""
    return name if full else f"{name}-short"
