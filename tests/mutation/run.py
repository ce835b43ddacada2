"""Which faults do the quick tests not see? Mutants, each against the tests that execute it.

    python -m tests.mutation.run --workers 15 --budget-s 540 --out /tmp/mutation

First every test runs on the code as it is, and says which lines it executes and what it costs. Then
each mutant meets the tests that execute its statement: those of the file's namesake first, then
cheap before dear, up to `--cost` seconds of CPU. One that survives meets the dearer ones when the
new mutants are through, or after two thirds of the time. `results.jsonl` says what happened to
each, and a later run with the same `--out` goes on from there; `report.md` has the table and the
survivors. When tests have changed, FILE:LINE:COLUMN and another `--out` try a survivor
again, `--tests` its namesake only.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import tempfile
import threading
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

from tests.mutation.mutants import Mutant, mutants, spread
from tests.mutation.trees import ROOT, Tree, executed, in_parallel

ROOMS = "dynamics forces motion joints spatial lanes".split()  # noqa: SIM905
TESTS = [  # what is cheap comes first: a deadline then leaves out the fewest
    "tests/spatial/test_*.py", "tests/lanes/test_*.py", "tests/forces/test_*.py",
    "tests/test_bad_arguments.py", "tests/model/test_*.py", "tests/solvers/test_terms.py",
    *(f"rbjax/{room}" for room in ROOMS),  # their doctests
    "tests/dynamics/test_*.py", "tests/motion/test_*.py", "tests/test_registry.py",
    "tests/body/test_*.py", "tests/solvers/test_simulate.py", "tests/compiler/test_simulate.py",
]  # fmt: skip
START = 15.0  # seconds that Python, JAX and the imports may take


def found(*patterns: str) -> list[str]:
    return [p.relative_to(ROOT).as_posix() for x in patterns for p in sorted(ROOT.glob(x))]


def meeting(mutant: Mutant, tests: dict[str, Any]) -> list[str]:
    """The tests that execute the mutant's statement, in the order in which to run them."""
    room, stem = Path(mutant.file).parent.name, Path(mutant.file).stem

    def rank(name: str) -> tuple[int, float]:
        path = name.split("::")[0]
        namesake = path == mutant.file or path.endswith(f"/test_{stem}.py")
        near = 0 if namesake else 1 if f"/{room}/" in path else 2
        return near, tests[name]["cost"]

    lines = mutant.executed
    met = (n for n, t in tests.items() if not t["lines"].get(mutant.file, set()).isdisjoint(lines))
    return sorted(met, key=rank)


class Campaign:
    """The mutants, what became of each, and what is next. (Its methods may be called at once.)"""

    def __init__(self, chosen: list[Mutant], tests: dict, out: Path, cost: float, times: tuple):
        self.mutants = {m.key: m for m in chosen}
        self.tests, self.out, self.cost = tests, out, cost
        self.survivors_from, self.deadline = times
        self.lock = threading.Lock()
        self.results: dict[str, dict] = {}
        log = out / "results.jsonl"
        for line in log.read_text().splitlines() if log.exists() else ():
            row = json.loads(line)
            self.results[row["key"]] = row
        self.fresh = [m for m in chosen if m.key not in self.results]
        self.survivors = [m for m in chosen if self.results.get(m.key, {}).get("left")]

    def take(self) -> tuple[Mutant, list[str], list[str]] | None:
        """A mutant, the tests to run, and those left for later."""
        with self.lock:
            now = time.monotonic()
            if now > self.deadline - START or not (self.fresh or self.survivors):
                return None
            again = self.survivors and (now > self.survivors_from or not self.fresh)
            mutant = (self.survivors if again else self.fresh).pop(0)
            left = self.results[mutant.key]["left"] if again else meeting(mutant, self.tests)
            met = [name for name in left if name in self.tests]
            total, first = 0.0, 0
            while first < len(met) and (total < self.cost or not first):
                total += self.tests[met[first]]["cost"]
                first += 1
            return mutant, met[:first], met[first:]

    def work(self, tree: Tree, job: tuple[Mutant, list[str], list[str]]) -> None:
        mutant, now, later = job
        start, by = time.monotonic(), ""
        outcome = "survived" if mutant.key in self.results else "not executed"
        if now:
            usual = 2 * START + 4 * sum(self.tests[name]["cost"] for name in now)
            timeout = max(1.0, min(usual, self.deadline - start))
            tree.swap(mutant.file, mutant.source)
            output, status = tree.pytest(now, timeout, "-x")
            tree.swap(mutant.file, (ROOT / mutant.file).read_text())
            if status is None and timeout < usual:
                return  # the budget's end, which says nothing of the mutant
            outcome = {0: "survived", None: "timeout"}.get(status, "killed")
            found = re.search(r"^(?:FAILED|ERROR) (\S.*?)(?: - |$)", output, re.MULTILINE)
            by = found[1] if found else f"status {status}" if status else ""
        row = {
            "key": mutant.key, "outcome": outcome, "by": by, "kind": mutant.kind,
            "seconds": round(time.monotonic() - start, 1), "tests": now,
            "left": later if outcome == "survived" else [],
        }  # fmt: skip
        with self.lock:
            earlier = self.results.get(mutant.key, {}).get("tests", [])
            self.results[mutant.key] = row | {"tests": [*earlier, *now]}
            if row["left"]:
                self.survivors.append(mutant)
            with (self.out / "results.jsonl").open("a") as log:
                log.write(json.dumps(self.results[mutant.key]) + "\n")
            print(f"{outcome:12} {mutant.kind:9} {mutant.key}  {by}", flush=True)

    def report(self) -> str:
        outcomes = ["killed", "survived", "timeout", "not executed"]
        counts: dict[str, Counter] = defaultdict(Counter)
        for key, mutant in self.mutants.items():
            counts[mutant.file][self.results.get(key, {}).get("outcome", "untried")] += 1
        total = sum(counts.values(), Counter())
        rows = [f"| {' | '.join(['file', *outcomes, 'untried'])} |", "|---" * 6 + "|"]
        for file, n in [*sorted(counts.items()), ("all", total)]:
            rows.append(
                f"| {file} | " + " | ".join(str(n[x]) for x in [*outcomes, "untried"]) + " |"
            )
        for outcome in outcomes[1:]:
            rows += ["", f"## {outcome}"]
            for key, mutant in sorted(self.mutants.items(), key=lambda x: (x[1].file, x[1].line)):
                if (row := self.results.get(key, {})).get("outcome") == outcome:
                    rows.append(
                        f"\n`{mutant.file}:{mutant.line}: {mutant.old} -> {mutant.new}` "
                        f"({len(row['tests'])} tests run, {len(row['left'])} left)"
                    )
                    rows += ["```diff", mutant.diff((ROOT / mutant.file).read_text()), "```"]
        return "\n".join(rows) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "files", nargs="*", help="FILE, FILE:LINE or FILE:LINE:COLUMN; none: the kernel's"
    )
    parser.add_argument("--tests", nargs="+", default=TESTS, help="patterns of test files")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--budget-s", type=float, default=540.0)
    parser.add_argument("--cost", type=float, default=40.0, help="CPU seconds of tests a run")
    parser.add_argument("--most", type=int, default=40, help="mutants a file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    begin = time.monotonic()
    deadline = begin + given.budget_s
    given.out.mkdir(parents=True, exist_ok=True)

    rng, chosen = random.Random(given.seed), []
    for name in given.files or found(*(f"rbjax/{room}/**/[!_]*.py" for room in ROOMS)):
        file = name.partition(":")[0]
        of_file = mutants(file, (ROOT / file).read_text())
        rng.shuffle(of_file)
        of_file = [m for m in of_file if m.key.startswith(f"{name}:")]
        chosen += spread(of_file, lambda m: m.kind, rng)[: given.most]
    chosen = spread(chosen, lambda m: m.file, rng)

    with tempfile.TemporaryDirectory() as scratch:
        trees = [Tree(Path(scratch, str(k)), Path(scratch, "jax")) for k in range(given.workers)]
        tests = executed(trees, found(*given.tests), given.out, begin + given.budget_s / 4)
        spent = time.monotonic() - begin
        print(f"{len(chosen)} mutants, {len(tests)} tests, known after {spent:.0f} s", flush=True)
        campaign = Campaign(
            chosen, tests, given.out, given.cost, (begin + 2 / 3 * given.budget_s, deadline)
        )
        in_parallel(trees, campaign.take, campaign.work)
    report = campaign.report()
    (given.out / "report.md").write_text(report)
    print(report[: report.find("\n## ")])


if __name__ == "__main__":
    main()
