"""Algorithms of a batch of 1,024 on one core, beside those of an older commit.

    python -m benchmarks.cpu.older [--commit COMMIT] [--full] [ROBOT ...]

--full: panda and humanoid, two turns of two seconds; by default panda, one turn of half a second.
The default commit is the last one before functions ran as machine code: XLA ran all of them. Each
commit runs in processes of its own, by turns, with this Python and its packages. A figure is the
best of all its processes: `jax.jit(jax.vmap(f))` with the model closed over, batch first.
"""

import argparse
import json
import os
import runpy
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[2]
ALGORITHMS = HERE / "benchmarks" / "shared" / "timed_algorithms.py"
BEFORE_MACHINE_CODE = "8b31068"
BATCH = 1024
COLUMNS = ("robot", "algorithm", "bits", "older_ns", "ns", "speedup")


def measure(robot: str, seconds: float) -> None:
    """Prints a row a line: this runs in a process with one commit's packages on its path."""
    import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)
    import jax
    import jax.numpy as jnp
    import numpy as np

    from benchmarks.shared.robots import as_model, compiled, states

    # by its path: an older commit lacks the file, and rbjax inside it is that commit's
    algorithms = runpy.run_path(str(ALGORITHMS))["ALGORITHMS"]
    reference = compiled(robot)
    for dtype in (np.float64, np.float32):
        model = as_model(reference).astype(dtype)
        args = [jnp.asarray(np.ascontiguousarray(x), dtype) for x in states(reference, BATCH)]
        for name, f in algorithms.items():
            jitted = jax.jit(jax.vmap(lambda *x, f=f, model=model: f(model, *x)))
            jax.block_until_ready(jitted(*args))
            best, end = np.inf, time.perf_counter() + seconds
            while time.perf_counter() < end:
                start = time.perf_counter()
                jax.block_until_ready(jitted(*args))
                best = min(best, time.perf_counter() - start)
            ns = best / BATCH * 1e9
            bits = np.dtype(dtype).itemsize * 8
            print(json.dumps([robot, name, bits, ns]), flush=True)


def measured(tree: Path, robot: str, seconds: float) -> dict[tuple[str, int], float]:
    """Nanoseconds a sample of each algorithm, by the commit that lies in a folder."""
    command = [sys.executable, __file__, "--measure", robot, "--seconds", str(seconds)]
    path = os.pathsep.join(filter(None, [str(tree), os.environ.get("PYTHONPATH")]))
    out = subprocess.run(
        command, cwd=tree, env=os.environ | {"PYTHONPATH": path}, check=True,
        stdout=subprocess.PIPE, text=True,
    ).stdout  # fmt: skip
    rows = [json.loads(line) for line in out.splitlines() if line.startswith("[")]
    return {(name, bits): ns for _, name, bits, ns in rows}


def rows_of(older: Path, robot: str, full: bool) -> list[dict[str, Any]]:
    from benchmarks.shared.progress import progress

    best: tuple[dict, dict] = {}, {}
    runs = [(best[0], older), (best[1], HERE)] * (2 if full else 1)
    for found, tree in progress(runs, lambda run: f"{robot} in {run[1].name}"):
        for key, ns in measured(tree, robot, 2.0 if full else 0.5).items():
            found[key] = min(ns, found.get(key, ns))
    return [
        {"robot": robot, "algorithm": name, "bits": bits, "older_ns": best[0][name, bits],
         "ns": ns, "speedup": best[0][name, bits] / ns}
        for (name, bits), ns in best[1].items()
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", help="if left out, those of the size")
    parser.add_argument("--commit", default=BEFORE_MACHINE_CODE)
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--full", action="store_true", help="both robots, two turns of 2 s")
    asked = parser.parse_args()
    if asked.measure:
        measure(asked.measure, asked.seconds)
        return
    from benchmarks.shared.progress import sized
    from benchmarks.shared.timing import markdown_table, others, save

    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(
            ["git", "archive", asked.commit], cwd=HERE, check=True, stdout=subprocess.PIPE
        ).stdout
        subprocess.run(["tar", "-x", "-C", folder], input=archive, check=True)
        for robot in asked.robots or ["panda", "humanoid"][: 2 if asked.full else 1]:
            new = rows_of(Path(folder), robot, asked.full)
            rows += [row | {"commit": asked.commit} for row in new]
            print(markdown_table(new, COLUMNS), flush=True)
    name = sized("cpu-older", asked.full)
    kept = others(name, rows, ("robot", "algorithm", "bits", "commit"))
    print(save(name, [*kept, *rows]))


if __name__ == "__main__":
    main()
