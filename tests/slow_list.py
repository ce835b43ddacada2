"""The list of slow test functions, made from a measured run: `slow.txt`, one function a line.

    RBJAX_TEST_TIMES=times.txt pytest -m "not slow or listed"
    python -m tests.slow_list times.txt

writes the list from the CPU seconds of the tests that ran and keeps its entries for other tests.
A function is listed as a whole if its cases take more than `LIMIT` CPU seconds on average or more
than `TOTAL` together. `conftest` marks all cases of a listed function as slow. If some cases of a
function are worth their time in `make test`, mark the others with `pytest.mark.slow` by hand.

CPU seconds do not depend on what else the machine does. `conftest` measures them for each test. The
time of a module's fixtures is not charged to the test that happens to run first.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from pathlib import Path

PATH = Path(__file__).parent / "slow.txt"
#: CPU seconds of one case, on average, and of all cases of a function
LIMIT, TOTAL = 0.4, 2.0
#: files whose tests are always quick: the compiler's core, every public function, wrong arguments
KEPT = (
    "tests/test_registry.py", "tests/compiler/test_primitives.py",
    "tests/compiler/test_quick_programs.py", "tests/public/",
    "tests/control/test_bad_arguments.py", "tests/sysid/test_bad_arguments.py",
)  # fmt: skip
#: tests whose cases are listed one by one
BY_CASE = "tests/docs/test_examples.py"
#: the environment variable that names the file of measured times
VARIABLE = "RBJAX_TEST_TIMES"


def listed() -> set[str]:
    """Names of slow test functions, as pytest has them, without cases."""
    return set(PATH.read_text().splitlines())


def slow(times: dict[str, float]) -> set[str]:
    """Test functions that are too slow for `make test`."""
    cases = defaultdict(list)
    for name, seconds in times.items():
        cases[function(name)].append(seconds)
    return {
        name
        for name, all_of in cases.items()
        if (sum(all_of) > LIMIT * len(all_of) or sum(all_of) > TOTAL) and not name.startswith(KEPT)
    }


def function(name: str) -> str:
    """A test's name without its case; pages of the documentation are functions of their own."""
    if name.startswith(BY_CASE):
        return name
    return re.sub(r"\[.*", "", name, flags=re.DOTALL)


def times(path: str) -> dict[str, float]:
    """CPU seconds of each test of a run: a line is "SECONDS NAME"."""
    pairs = (line.split(" ", 1) for line in Path(path).read_text().splitlines())
    return {name: float(seconds) for seconds, name in pairs}


def main() -> None:
    measured = times(sys.argv[1])
    functions = {function(name) for name in measured}
    names = slow(measured) | (listed() - functions)
    PATH.write_text("".join(f"{name}\n" for name in sorted(names)))
    print(f"{len(names)} test functions are slow")


if __name__ == "__main__":
    main()
