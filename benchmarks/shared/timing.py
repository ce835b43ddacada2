"""Timing and results of every benchmark, with the device and the versions."""

import importlib.metadata
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

RESULTS = Path(__file__).parents[1] / "results"
PACKAGES = ("jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx", "mujoco-warp", "pin", "frax")

# A cached program would be reported as compiled in no time.
jax.config.update("jax_enable_compilation_cache", False)


def measure(
    fn: Callable[..., Any],
    *args: Any,
    budget_s: float = 2.0,
    jit: bool = True,
    compiler_options: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Time `fn(*args)`: tracing, compiling and running separately, each in seconds.

    Runs for about `budget_s`, at least 5 times, after one warm-up run. The clock stops when the
    *result* is ready, because JAX returns before the work is done. `jit=False` times a plain
    function (of another engine) with the same clock, without lowering or compiling.
    """
    row: dict[str, Any] = {"lower_s": None, "compile_s": None}
    if jit:
        jitted = fn if hasattr(fn, "lower") else jax.jit(fn)
        start = time.perf_counter()
        lowered = jitted.lower(*args)
        row["lower_s"] = time.perf_counter() - start
        start = time.perf_counter()
        fn = lowered.compile(compiler_options=compiler_options)
        row["compile_s"] = time.perf_counter() - start
    jax.block_until_ready(fn(*args))
    times: list[float] = []
    deadline = time.perf_counter() + budget_s
    while len(times) < 5 or (time.perf_counter() < deadline and len(times) < 10_000):
        start = time.perf_counter()
        jax.block_until_ready(fn(*args))
        times.append(time.perf_counter() - start)
    return row | {
        "run_s": statistics.median(times),
        "run_min_s": min(times),
        "repeats": len(times),
    }


def fastest_ns(f: Callable[[], object], count: int, runs: int = 15) -> float:
    """Nanoseconds of one of the `count` evaluations that f() makes on the host, in its best run."""
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        f()
        times.append(time.perf_counter() - start)
    return min(times) / count * 1e9


def provenance() -> dict[str, Any]:
    """Device, versions, date and commit of a measurement."""
    device = jax.devices()[0]
    return {
        "device": device.device_kind,
        "platform": device.platform,
        "devices": jax.device_count(),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "x64": jax.numpy.result_type(float) == "float64",
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "command": command(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        **_commit(),
    }


def command() -> str:
    """The command of this process, which says the size of its run; of paths the last part."""
    spec = sys.modules["__main__"].__spec__
    arguments = [Path(x).name if os.sep in x else x for x in sys.argv[1:]]
    arguments = [f'"{x}"' if " " in x else x for x in arguments]
    return " ".join(["python", *(["-m", spec.name] if spec else []), *arguments])


def save(name: str, rows: list[dict[str, Any]], source: dict[str, Any] | None = None) -> Path:
    """Write rows with their provenance (of this process or another one) to
    results/<name>-<device>.json, replacing an older run; and a copy to RBJAX_RESULTS, if set."""
    source = source or provenance()
    RESULTS.mkdir(exist_ok=True)
    path = _path(name, source)
    each = ",\n".join(json.dumps(row) for row in rows)  # one line each: small, and separate in git
    path.write_text(f'{{"provenance": {json.dumps(source)},\n"rows": [\n{each}\n]}}\n')
    if copies := os.environ.get("RBJAX_RESULTS"):
        (Path(copies) / path.name).write_bytes(path.read_bytes())
    return path


def _path(name: str, source: dict[str, Any]) -> Path:
    device = source["cpu"] if source["platform"] == "cpu" else source["device"]
    return RESULTS / f"{name}-{re.sub(r'[^a-z0-9]+', '-', device.lower()).strip('-')}.json"


def others(name: str, rows: list[dict[str, Any]], keys: Iterable[str]) -> list[dict[str, Any]]:
    """The rows of an older run that differ from all of these in the keys, each with its commit. A
    run of only some parts must keep them."""
    path = _path(name, provenance())
    if not path.exists():
        return []
    data = json.loads(path.read_text())
    keys = list(keys)
    renewed = {tuple(row.get(key) for key in keys) for row in rows}
    older = {"commit": data["provenance"]["commit"]}
    return [
        older | row for row in data["rows"] if tuple(row.get(key) for key in keys) not in renewed
    ]


def markdown_table(rows: Iterable[Mapping[str, Any]], columns: Iterable[str]) -> str:
    """The rows as a Markdown table with these columns; three digits a number, a dash if missing.

    >>> print(markdown_table([{"model": "panda", "run_s": 1.23456e-4}], ["model", "run_s", "note"]))
    | model | run_s | note |
    | --- | --- | --- |
    | panda | 0.000123 | - |
    """
    columns = list(columns)
    cells = [columns, ["---"] * len(columns)]
    cells += [[_cell(row.get(column)) for column in columns] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def cpu_model() -> str:
    """The name of this machine's processor."""
    try:
        found = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.M)
    except OSError:  # not Linux
        found = None
    return found[1].strip() if found else platform.processor() or platform.machine()


def _commit() -> dict[str, Any]:
    """Commit and dirty flag, each None where there is no git or no repository.

    RBJAX_COMMIT=<hash> overrides it, for a machine with the files but without their history.
    """

    def git(*args: str) -> str | None:
        try:
            run = subprocess.run(
                ["git", *args], cwd=RESULTS.parent, capture_output=True, text=True, check=True
            )
        except (OSError, subprocess.CalledProcessError):
            return None
        return run.stdout.strip()

    told = os.environ.get("RBJAX_COMMIT")
    if told:
        return {"commit": told, "dirty": None}
    commit = git("rev-parse", "HEAD")
    # Earlier results of the same run do not make the timed code dirty.
    status = git("status", "--porcelain", "--", ":/", ":(top,exclude)benchmarks/results")
    return {
        "commit": commit,
        "dirty": None if status is None else bool(status),
    }
