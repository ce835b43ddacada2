"""Reads the files of benchmarks/results: rows by their values, one number, the provenance."""

from __future__ import annotations

import functools
import json
import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
DEVICES = {
    "nvidia-h200": "NVIDIA H200", "nvidia-h100-80gb-hbm3": "NVIDIA H100",
    "amd-epyc": "AMD EPYC", "intel-r-xeon-r-processor": "Intel Xeon",
}  # fmt: skip

Row = dict[str, Any]


@functools.cache
def read(name: str) -> dict[str, Any]:
    """The contents of benchmarks/results/<name>.json: provenance and rows."""
    path = RESULTS / f"{name}.json"
    if not path.exists():
        raise LookupError(
            f"benchmarks/results has no file {name}.json; it has {', '.join(names())}"
        )
    return json.loads(path.read_text())


def names() -> list[str]:
    """The names of all results files, sorted, without their suffix."""
    return sorted(path.stem for path in RESULTS.glob("*.json"))


def subject(name: str) -> tuple[str, str]:
    """The name of a results file in two parts: benchmark and device.

    >>> subject("cpu-one-call-amd-epyc")
    ('cpu-one-call', 'AMD EPYC')
    """
    for ending, device in DEVICES.items():
        if name.endswith(ending):
            return name.removesuffix(ending).rstrip("-"), device
    raise LookupError(f"{name}: the device at the end is none of {', '.join(DEVICES)}")


def rows(name: str, **where: Any) -> list[Row]:
    """The rows of a file whose columns have these values; a tuple lists several values."""
    return list(select(read(name)["rows"], **where))


def select(found: Iterable[Row], **where: Any) -> Iterable[Row]:
    """The rows whose columns have these values. `_` in a keyword stands for a blank, too."""
    for row in found:
        if all(_equal(_of(row, key), wanted) for key, wanted in where.items()):
            yield row


def number(
    name: str, column: str, best: Callable[[Iterable[float]], float] = max, **where: Any
) -> float:
    """The largest (or `best`) value of a column among the rows chosen by `where`."""
    values = [row[column] for row in rows(name, **where) if row.get(column) is not None]
    if not values:
        raise LookupError(f"{name}.json has no row with {where} that has {column!r}")
    return best(values)


def _of(row: Row, key: str) -> Any:
    return row.get(key, row.get(key.replace("_", " ")))


def _equal(value: Any, wanted: Any) -> bool:
    return value in wanted if isinstance(wanted, tuple) else value == wanted


def evaluation(training: Row) -> Row:
    """The evaluation after a training, or the last report of a training that was cut.

    >>> evaluation({"curve": [{"reward": 3.0}]})["return"]
    3.0
    """
    report = training["curve"][-1]
    last = {"return": report.get("reward"), "std": report.get("reward_std"), "episodes": None}
    return training.get("evaluation") or last


def versions(name: str) -> str:
    """The versions of the packages that took part, as one line."""
    found = read(name)["provenance"].get("versions", {})
    shown = {k: v for k, v in found.items() if v and k not in ("jaxlib", "numpy")}
    return ", ".join(f"{package} {version}" for package, version in shown.items())


def machine(name: str) -> str:
    """The device, and on a CPU the number of its cores."""
    found = read(name)["provenance"]
    if found["platform"] == "cpu":
        return f"{found['cpu']}, {found['cores']} cores"
    count = "" if found["devices"] == 1 else f"{found['devices']} x "
    return count + re.sub(r" 80GB HBM3", "", found["device"])


def commit(name: str) -> str:
    """The commits of the run and of rows that an earlier run left, seven digits each."""
    data = read(name)
    all_of = [data["provenance"].get("commit")] + [row.get("commit") for row in data["rows"]]
    return ", ".join(dict.fromkeys(str(c)[:7] for c in all_of if c)) or "not recorded"


def text(value: float, digits: int = 3) -> str:
    """A number as a reader wants it: rounded, with commas at thousands, or as a power of ten.

    >>> text(3319.8), text(0.0521), text(5.78e-7), text(7.896, 2)
    ('3,320', '0.0521', '5.78e-7', '7.9')
    >>> text(-2.1e-14, 1), text(1024), text(0.2, 2)
    ('-2e-14', '1,024', '0.20')
    """
    if value != value or abs(value) == float("inf"):
        return str(value)
    if value == int(value) and abs(value) < 1e9:
        return f"{int(value):,}"
    rounded = float(f"{value:.{digits}g}")
    power = math.floor(math.log10(abs(rounded)))
    if -3 <= power < 7:
        return f"{rounded:,.{max(0, digits - 1 - power)}f}"
    mantissa, exponent = f"{rounded:.{digits - 1}e}".split("e")
    return f"{mantissa}e{int(exponent)}"
