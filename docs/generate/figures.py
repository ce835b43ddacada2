"""Keeps the numbers that Markdown files type equal to benchmarks/results.

A number of a Markdown file names its figure in a comment behind it:

    Go1 walks at 73<!-- = gpu.contact.go1 --> million steps a second.

`python -m docs.generate.figures` writes the present numbers into README.md and docs/; `--check`
lists the ones that differ, and `--list` prints every figure. tests/docs/test_figures.py checks.
"""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from docs.generate import measured

ROOT = Path(__file__).resolve().parents[2]
TYPED = re.compile(r"(-?\d[\d.,e-]*)<!-- = ([\w.-]+) -->")
GPU, H100, CORE = "nvidia-h200", "nvidia-h100-80gb-hbm3", "amd-epyc"


@dataclass(frozen=True)
class Number:
    """One number: the best value of a column among some rows of a results file."""

    file: str
    column: str
    where: dict[str, Any]
    best: Any = max
    scale: float = 1.0
    digits: int = 3

    def value(self) -> float:
        return self.scale * measured.number(self.file, self.column, self.best, **self.where)


@dataclass(frozen=True)
class Ratio:
    """One number over another."""

    of: str
    over: str
    digits: int = 3

    def value(self) -> float:
        return FIGURES[self.of].value() / FIGURES[self.over].value()


@dataclass(frozen=True)
class Rate:
    """Millions a second of a figure in microseconds."""

    of: str
    digits: int = 2

    def value(self) -> float:
        return 1 / FIGURES[self.of].value()


@dataclass(frozen=True)
class Count:
    """How many different values a column has in a results file."""

    file: str
    column: str
    where: dict[str, Any]
    digits: int = 0

    def value(self) -> int:
        return len({row[self.column] for row in measured.rows(self.file, **self.where)})


@dataclass(frozen=True)
class Both:
    """In how many rows of a results file two columns have numbers."""

    file: str
    one: str
    other: str
    digits: int = 0

    def value(self) -> int:
        found = measured.rows(self.file)
        return sum(
            row.get(self.one) is not None and row.get(self.other) is not None for row in found
        )


Figure = Number | Ratio | Rate | Count | Both


def figure(name: str) -> str:
    """The figure of this name as text, such as "73"."""
    if name not in FIGURES:
        raise LookupError(f"no figure {name!r}; {sys.argv[0]} --list prints the names")
    found = FIGURES[name]
    return measured.text(found.value(), found.digits)


def _gpu() -> dict[str, Figure]:
    """Motion without contacts on an H200, millions a second in f32: ours the median of runs, MJX's
    and frax' the fastest run."""
    out: dict[str, Figure] = {}
    parts = {"forward": ("forward", "forward"), "rollout": ("rollout", "rollout"),
             "gradient": ("gradient by controls", "gradient")}  # fmt: skip
    for robot in ("panda", "humanoid", "g1"):
        for part, (ours, theirs) in parts.items():
            name = f"gpu.{part}.{robot}"
            out[name] = Number(f"gpu-threads-{robot}-{GPU}", "M/s median", {"what": ours})
            out[f"{name}.mjx"] = Number(
                f"gpu-mjx-{robot}-{GPU}", "M/s", {"what": theirs, "engine": "mjx"}
            )
            out[f"{name}.over-mjx"] = Ratio(name, f"{name}.mjx")
    return out


def _contact() -> dict[str, Figure]:
    out: dict[str, Figure] = {}
    for robot in ("humanoid", "humanoid_feet", "go1", "g1"):
        file = f"gpu-contact-{robot}-{H100}"
        for part in ("rollout", "free"):
            out[f"gpu.contact.{robot}.{part}"] = Number(
                file, "M/s median", {"what": part}, digits=2 if part == "rollout" else 3
            )
    for robot in ("humanoid", "g1"):
        where = {"engine": "MuJoCo Warp", "what": "contact", "robot": robot}
        out[f"gpu.contact.{robot}.warp"] = Number(measured.PUBLISHED, "M/s", where, digits=2)
    return out


def _cpu() -> dict[str, Figure]:
    out: dict[str, Figure] = {}
    for robot in ("panda", "humanoid", "g1"):
        one = {"robot": robot}
        call = f"cpu-one-call-{CORE}"
        out[f"cpu.call.{robot}"] = Number(call, "compiled_ns", one, min, 1e-3, 2)
        out[f"cpu.call.{robot}.mujoco"] = Number(call, "mujoco_ns", one, min, 1e-3, 2)
        out[f"cpu.call.{robot}.jit"] = Number(call, "jit_ns", one, min, 1e-3, 2)
        compiling = f"cpu-compile-{robot}-intel-r-xeon-r-processor"
        out[f"cpu.compile.{robot}"] = Number(compiling, "rbjax s", one, min, 1, 2)
        out[f"cpu.compile.{robot}.mjx"] = Number(compiling, "MJX s", one, min, 1, 2)
    for robot in ("panda", "g1"):
        where = {"robot": robot, "algorithm": "forward dynamics", "engine": "rbjax float64",
                 "driver": "auto"}  # fmt: skip
        file = f"cpu-algorithms-{CORE}"
        out[f"cpu.forward.{robot}"] = Number(file, "ns", where, min, 1e-3, 2)
        out[f"cpu.forward.{robot}.pinocchio"] = Number(file, "Pinocchio's ns", where, min, 1e-3, 2)
        out[f"cpu.rate.{robot}"] = Rate(f"cpu.forward.{robot}")
        out[f"cpu.rate.{robot}.pinocchio"] = Rate(f"cpu.forward.{robot}.pinocchio")
    return out


def _accuracy() -> dict[str, Figure]:
    gpu, cpu = f"gpu-accuracy-{GPU}", f"accuracy-{CORE}"
    return {
        "accuracy.f32": Number(gpu, "rbjax median", {}, max, 1, 2),
        "accuracy.f32.mjx": Number(gpu, "MJX median", {}, max, 1, 2),
        "accuracy.f32.models": Both(gpu, "rbjax median", "MJX median"),
        "accuracy.f64": Number(cpu, "f64 max", {}, max, 1, 1),
        "accuracy.models": Count(cpu, "model", {}),
    }


def _kinds() -> dict[str, Figure]:
    precision = f"work-precision-pendulum-{CORE}"
    return {
        "count.formulations": Count(f"work-formulations-{CORE}", "formulation", {"what": "run"}),
        "count.solvers": Count(
            "failure-map-intel-r-xeon-r-processor",
            "solver",
            {"kind": ("ode", "second-order", "split", "lie")},
        ),
        "count.solvers.timed": Count(
            "work-solvers-intel-r-xeon-r-processor", "method", {"what": "done"}
        ),
        "count.integrators.mjx": Count(precision, "method", {"what": "step", "engine": "mjx"}),
    }


FIGURES: dict[str, Figure] = _gpu() | _contact() | _cpu() | _accuracy() | _kinds()


def renewed(markdown: str) -> str:
    """The text with the present number before each comment.

    >>> renewed("at 1<!-- = gpu.contact.go1.rollout --> M/s")
    'at 73<!-- = gpu.contact.go1.rollout --> M/s'
    """
    return TYPED.sub(lambda found: f"{figure(found[2])}<!-- = {found[2]} -->", markdown)


def files(root: Path = ROOT) -> list[Path]:
    """README.md and every Markdown file of docs/."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def differing(root: Path = ROOT) -> list[str]:
    """Every number that differs from the results: file, typed, present."""
    return [
        f"{path.relative_to(root)}: {name} is {figure(name)}, the text has {typed}"
        for path in files(root)
        for typed, name in TYPED.findall(path.read_text())
        if typed != figure(name)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="list what differs, write nothing")
    parser.add_argument("--list", action="store_true", help="print every figure")
    chosen = parser.parse_args()
    if chosen.list:
        print("\n".join(f"{name:40} {figure(name)}" for name in FIGURES))
    elif chosen.check:
        found = differing()
        print("\n".join(found))
        sys.exit(bool(found))
    else:
        for path in files():
            before = path.read_text()
            if (after := renewed(before)) != before:
                path.write_text(after)
                print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
