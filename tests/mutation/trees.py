"""Copies of the repository, in each of which pytest runs beside the others."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
NO_TESTS = 5  # pytest's status where all tests of a file are slow


class Tree:
    """A copy of the repository in which one file at a time is another."""

    def __init__(self, folder: Path, cache: Path):
        folder.mkdir(parents=True)
        for path in ROOT.iterdir():
            if path.name in ("rbjax", "tests"):
                shutil.copytree(path, folder / path.name)
            elif not path.name.startswith("."):
                (folder / path.name).symlink_to(path)
        self.folder = folder
        inherited = os.environ.get("PYTHONPATH")
        self.environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, [str(folder), inherited])),
            "JAX_PLATFORMS": "cpu",
            "JAX_ENABLE_X64": "1",  # as tests/conftest.py, which doctests without tests go without
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05",
            "OMP_NUM_THREADS": "1",
        }

    def pytest(self, tests: Iterable[str], timeout: float, *options: str, **environment: str):
        """Output and exit status (None: no end in time) of the quick ones of these tests."""
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0"]
        command += ["-m", "not slow", "--tb=line", "-rfE", *options, *tests]
        process = subprocess.Popen(
            command, cwd=self.folder, env=self.environment | environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            return process.communicate(timeout=timeout)[0], process.returncode
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return process.communicate()[0], None

    def swap(self, file: str, text: str) -> None:
        (self.folder / file).write_text(text)


def in_parallel(trees: list[Tree], take: Callable[[], Any], work: Callable[[Tree, Any], None]):
    """`work` on what `take` gives, until it gives None, in each of the trees at once."""

    def loop(tree: Tree) -> None:
        while (job := take()) is not None:
            work(tree, job)

    threads = [threading.Thread(target=loop, args=(tree,)) for tree in trees]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def executed(trees: list[Tree], files: list[str], out: Path, deadline: float) -> dict[str, Any]:
    """test -> its cost in seconds of CPU, and the lines of each file that it executes. A test that
    fails as the code is, or does not come to an end before the deadline, is left out."""
    sources = b"".join(p.read_bytes() for p in sorted((ROOT / "rbjax").rglob("*.py")))
    parts = {}
    for path in map(ROOT.joinpath, files):
        own = path.read_bytes() if path.is_file() else b""  # a folder of doctests is all sources'
        digest, file = hashlib.sha256(sources + own).hexdigest()[:12], path.relative_to(ROOT)
        parts[str(file)] = out / "executed" / f"{'-'.join(file.parts)}-{digest}.jsonl"
    (out / "executed").mkdir(exist_ok=True)
    jobs = iter([file for file, part in parts.items() if not part.exists()])
    lock = threading.Lock()

    def take() -> str | None:
        with lock:
            return next(jobs, None) if time.monotonic() < deadline else None

    def work(tree: Tree, file: str) -> None:
        left, plugin = max(1.0, deadline - time.monotonic()), ("-p", "tests.mutation.executed")
        output, status = tree.pytest([file], left, *plugin, RBJAX_EXECUTED=str(parts[file]))
        if status not in (0, NO_TESTS):
            print(f"{file}: status {status} as the code is: {output.splitlines()[-1:]}", flush=True)

    in_parallel(trees, take, work)
    found: dict[str, Any] = {}
    for part in parts.values():
        rows = [json.loads(x) for x in part.read_text().splitlines()] if part.exists() else []
        for row in rows[1:]:
            imports, own = rows[0]["lines"], row["lines"]
            of_all = {f: {*imports.get(f, ()), *own.get(f, ())} for f in {*imports, *own}}
            found[row["test"]] = {"cost": row["cost"], "lines": of_all}
    return found
