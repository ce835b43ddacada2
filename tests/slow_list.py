"""The list of slow tests, by a measured run: `slow.txt`, one test a line.

    pytest --junitxml times.xml -m "not slow"
    python -m tests.slow_list times.xml [SHARE]

writes the list from the times of the tests that ran, and keeps what it has of others. SHARE is
what a worker had of a core, 1 on a quiet machine. `conftest` marks what is listed as slow. A test
is listed if it took more than `LIMIT` seconds; the cheapest case of each function stays quick up to
`CHEAPEST`. So every function that is not long by itself still has a case in `make test`.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree

PATH = Path(__file__).parent / "slow.txt"
#: seconds of a test
LIMIT, CHEAPEST = 0.8, 1.5
#: files whose tests are always quick: every public function composes
KEPT = ("tests/test_registry.py",)


def listed() -> set[str]:
    """The names of slow tests, as pytest has them."""
    return set(PATH.read_text().splitlines())


def slow(times: dict[str, float]) -> set[str]:
    """The tests that go to the list."""
    cases = defaultdict(list)
    for name, t in times.items():
        cases[function(name)].append((t, name))
    out = set()
    for group in cases.values():
        least = min(group)
        out |= {name for t, name in group if t > LIMIT and (name != least[1] or t > CHEAPEST)}
    return {name for name in out if not name.startswith(KEPT)}


def function(name: str) -> str:
    """A test's name without its case."""
    return re.sub(r"\[.*", "", name, flags=re.DOTALL)


def times(path: str) -> dict[str, float]:
    """Seconds of each test of a run."""
    found = {}
    for case in ElementTree.parse(path).iter("testcase"):
        file = case.get("classname", "").replace(".", "/") + ".py"
        found[f"{file}::{case.get('name')}"] = float(case.get("time", 0))
    return found


def main() -> None:
    share = float(sys.argv[2]) if len(sys.argv) > 2 else 1.0
    measured = {name: share * t for name, t in times(sys.argv[1]).items()}
    names = slow(measured) | {name for name in listed() if name not in measured}
    PATH.write_text("".join(f"{name}\n" for name in sorted(names)))
    print(f"{len(names)} tests are slow")


if __name__ == "__main__":
    main()
