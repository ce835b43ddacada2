"""Every solver on every scene, on all cores and GPUs of a machine, within a deadline.

`python -m benchmarks.work.queue --jobs 28 --gpus 2 --deadline 560` writes work-solvers-*.json into
results/ (one for the CPU, one for the GPUs) every few seconds. A second call keeps the tasks that
the files list as done on such a CPU (or those of `--resume`, on any) and continues with the rest.

A task is (scene, solver, precision): see `benchmarks.work.solvers`. Each CPU worker has its own
core (with hyperthreads, half of one), so times are those of one core of a busy machine. GPU workers
compile in parallel on the remaining cores and run one at a time on each GPU. Tasks are sorted by
importance: f64 before f32, the most important solvers first, counts of evaluations last. A task
does not start if, judged by others of its kind, it would not end in time. A task that was left out,
failed, or does not apply is a row that says so, and a second call retries failed ones.
It runs only on Linux, because processes are pinned to cores.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.shared.timing import RESULTS, cpu_model, save
from benchmarks.work.scenes import SCENES
from benchmarks.work.solvers import FIRST, IMPLICIT, MAKERS, applicable

NAME = "work-solvers"
EARLIER = ("cpu", "cores", "date", "commit", "dirty")  # stored for resumed runs
Rows = list[dict[str, Any]]


class Task(NamedTuple):
    """One unit of work of a worker; the precision "count" means counting evaluations."""

    scene: str
    method: str
    precision: str

    def importance(self) -> tuple[int, int]:
        return ("f64", "f32", "count").index(self.precision), self.method not in FIRST

    def row(self, what: str, note: str) -> dict[str, Any]:
        return {"what": what, "scene": self.scene, "engine": "simulate", "method": self.method,
                "precision": self.precision, "note": note}  # fmt: skip


def tasks(scenes: Iterable[str], methods: Iterable[str], precisions: Iterable[str]) -> list[Task]:
    """All tasks that apply; evaluations of explicit solvers are counted on one scene."""
    scenes, out = list(scenes), []
    for method in methods:
        for precision in precisions:
            here = [s for s in scenes if applicable(s, method)]
            if precision == "count" and method not in IMPLICIT:
                here = here[:1]
            out += [Task(scene, method, precision) for scene in here]
    return sorted(out, key=Task.importance)  # stable: keeps the order of equal importance


class Board:
    """The tasks of one platform and their rows, shared by the threads of its workers."""

    def __init__(self, platform: str, wanted: list[Task], deadline: float, name: str = NAME):
        self.platform, self.deadline, self.name = platform, deadline, name
        self.found: dict[Task, Rows] = {}
        self.source: dict[str, Any] | None = None
        self.earlier: list[dict[str, Any]] = []
        self.waiting, self.lock = wanted, threading.Lock()

    def resume(self, paths: Iterable[Path], cpu: str | None) -> None:
        """Mark tasks as done that the files list for this CPU (None: for any)."""
        for path in paths:
            data = json.loads(path.read_text())
            source = data["provenance"]
            if (source["platform"] == "cpu") != (self.platform == "cpu"):
                continue
            if cpu not in (None, source["cpu"]):
                continue
            self.source = source
            self.earlier += [*source.pop("earlier", []), {k: source[k] for k in EARLIER}]
            by_task: dict[Task, Rows] = {}
            for row in data["rows"]:
                if row.get("engine") == "simulate":
                    precision = "count" if row["what"] == "count" else row["precision"]
                    task = Task(row["scene"], row["method"], precision)
                    by_task.setdefault(task, []).append(row)
            self.found |= {t: r for t, r in by_task.items() if r[-1]["what"] in ("done", "count")}
        self.waiting = [task for task in self.waiting if task not in self.found]

    def next(self) -> Task | None:
        """The most important task that will end in time, judged by others of its kind."""
        with self.lock:
            took: dict[Any, float] = {}
            for task, rows in self.found.items():
                seconds = rows[-1].get("task_s", 0.0)
                took[_kind(task)] = max(seconds, took.get(_kind(task), 0.0))
            for task in self.waiting:
                if time.monotonic() + took.get(_kind(task), 0.0) < self.deadline:
                    self.waiting.remove(task)
                    return task
        return None

    def give_back(self, task: Task) -> None:
        with self.lock:
            self.waiting.insert(0, task)

    def put(self, task: Task, rows: Rows) -> None:
        with self.lock:
            self.found[task] = rows
        last = rows[-1]
        print(self.platform, *task, last["what"], last.get("note", ""), last.get("task_s", ""),
              flush=True)  # fmt: skip

    def rows(self, counts: dict[tuple[str, str], Any]) -> Rows:
        """All rows, with force evaluations a second if they were counted."""
        with self.lock:
            out = [row for rows in self.found.values() for row in rows]
            out += [task.row("left out", "out of time") for task in self.waiting]
        for row in out:
            count = counts.get((row["scene"] if row["method"] in IMPLICIT else "", row["method"]))
            if row["what"] == "point" and count:
                a_step = np.interp(np.log(row["steps"]), np.log(count[0]), count[1])
                seconds = SCENES[row["scene"]].seconds
                row["evaluations"] = float(f"{a_step * row['steps'] / seconds:.5g}")
        return out

    def counts(self) -> dict[tuple[str, str], Any]:
        """(scene, method) -> steps and evaluations a step; no scene for an explicit solver."""
        with self.lock:
            rows = [rows[-1] for task, rows in self.found.items() if task.precision == "count"]
        out = {}
        for row in rows:
            if row["what"] == "count" and row["of_steps"]:
                scene = row["scene"] if row["method"] in IMPLICIT else ""
                out[scene, row["method"]] = row["of_steps"], row["a_step"]
        return out


def _kind(task: Task) -> tuple[str, bool, bool]:
    return task.scene, task.method in IMPLICIT, task.precision == "count"


class Worker(threading.Thread):
    """A process that runs tasks of a board one after another; it is restarted if it dies."""

    def __init__(self, board: Board, env: dict[str, str], cores: set[int], folder: Path):
        super().__init__(daemon=True)
        self.board, self.env, self.cores, self.folder = board, os.environ | env, cores, folder
        self.process: subprocess.Popen | None = None
        self.since, self.over = time.monotonic(), False

    def start_process(self) -> subprocess.Popen:
        with (self.folder / "log").open("a") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.work.solvers", str(self.folder)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, env=self.env,
            )  # fmt: skip
        os.sched_setaffinity(process.pid, self.cores)
        self.process, self.since = process, time.monotonic()
        return process

    def run(self) -> None:
        process = None
        while not self.over and (task := self.board.next()):
            if process is None:
                process = self.start_process()
                source = process.stdout.readline()
                if not source:
                    print(self.board.platform, "worker does not start: see the log", flush=True)
                    self.board.give_back(task)
                    return
                self.board.source = json.loads(source)
            self.since = time.monotonic()
            try:
                process.stdin.write(json.dumps(task) + "\n")
                process.stdin.flush()
                answer = process.stdout.readline()
            except BrokenPipeError:
                answer = ""
            if answer:
                self.board.put(task, json.loads(answer))
                continue
            code, process = process.wait(), None
            after = f"after {time.monotonic() - self.since:.0f} s"
            note = f"killed {after}" if code == -9 else f"its process ended, code {code}, {after}"
            self.board.put(task, [task.row("left out" if code == -9 else "failed", note)])
        self.kill()

    def kill(self) -> None:
        if self.process and self.process.poll() is None:
            self.process.kill()


def started(boards: list[Board], opts: argparse.Namespace, folder: Path) -> list[Worker]:
    """CPU workers on one core each; GPU workers and other child processes on the rest."""
    cores = sorted(os.sched_getaffinity(0))
    on_gpu = opts.per_gpu * opts.gpus
    on_cpu = 0 if opts.no_cpu else max(1, opts.jobs - on_gpu)
    left = set(cores[on_cpu:] or cores)
    os.sched_setaffinity(0, left)
    out = []
    for board in boards:
        if board.platform == "cpu":
            for k in range(on_cpu):
                env = {"JAX_PLATFORMS": "cpu", "RBJAX_GPU_LOCK": str(folder / f"cpu{k}.lock")}
                out.append(Worker(board, env, {cores[k % len(cores)]}, folder))
        else:
            for k in range(on_gpu):
                env = {
                    "JAX_PLATFORMS": opts.gpu_platform,
                    "CUDA_VISIBLE_DEVICES": str(k % opts.gpus),
                    "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
                    "RBJAX_GPU_LOCK": str(folder / f"gpu{k % opts.gpus}.lock"),
                }
                out.append(Worker(board, env, left, folder))
    for worker in out:
        worker.start()
    return out


def references(scenes: list[str], folder: Path) -> list[subprocess.Popen]:
    """Processes that compute the ends of the scenes."""
    env = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_X64": "1"}
    command = [sys.executable, "-m", "benchmarks.work.scenes"]
    with (folder / "log").open("a") as log:
        return [
            subprocess.Popen([*command, s, str(folder / f"{s}.npz")], env=env, stderr=log)
            for s in scenes
        ]


def write(boards: list[Board], folder: Path, kept: Rows) -> None:
    """Write the results, and the workers' log next to their copies."""
    ends: Rows = []
    for path in sorted(folder.glob("*.npz")):
        if path.stem in SCENES:
            with np.load(path) as end:
                ends.append({"what": "reference", "scene": path.stem, "bound": float(end["bound"]),
                             "seconds": SCENES[path.stem].seconds})  # fmt: skip
    counts = {k: v for board in boards for k, v in board.counts().items()}
    for board in boards:
        if board.source is None:
            continue
        source = board.source | ({"earlier": board.earlier} if board.earlier else {})
        save(board.name, [*ends, *kept, *board.rows(counts)], source)
    copies = os.environ.get("RBJAX_RESULTS")
    if copies and (folder / "log").exists():
        shutil.copy(folder / "log", Path(copies) / f"{NAME}.log")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--solvers", nargs="*", default=list(MAKERS))
    parser.add_argument("--precisions", nargs="*", default=["f64", "f32", "count"])
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes in all")
    parser.add_argument("--gpus", type=int, default=0)
    parser.add_argument("--per-gpu", type=int, default=5, help="processes that share a GPU")
    parser.add_argument("--gpu-platform", default="cuda", help="cpu: a rehearsal without a GPU")
    parser.add_argument("--no-cpu", action="store_true")
    parser.add_argument("--deadline", type=float, default=36_000.0, help="seconds in all")
    parser.add_argument("--task-limit", type=float, default=240.0, help="seconds a task")
    parser.add_argument("--resume", nargs="*", type=Path, help="folders or files, of any CPU")
    opts = parser.parse_args()
    os.environ["JAX_PLATFORMS"] = "cpu"  # this process does not use the GPUs
    deadline = time.monotonic() + opts.deadline - 5.0

    boards = [] if opts.no_cpu else [
        Board("cpu", tasks(opts.scenes, opts.solvers, opts.precisions), deadline)
    ]  # fmt: skip
    on_gpu = [p for p in opts.precisions if p != "count"]
    if opts.gpus:
        name = NAME if opts.gpu_platform != "cpu" else f"rehearsal-{NAME}"
        boards.append(Board("gpu", tasks(opts.scenes, opts.solvers, on_gpu), deadline, name))
    for board in boards:
        for where in [RESULTS] if opts.resume is None else opts.resume:
            paths = sorted(where.glob(f"{NAME}-*.json")) if where.is_dir() else [where]
            board.resume(paths, cpu_model() if opts.resume is None else None)
        print(board.platform, len(board.found), "tasks done before,", len(board.waiting), "to do")
    note = "takes rigid bodies alone, and the robot is none"
    not_applicable = [
        Task(scene, method, "-").row("not applicable", note)
        for scene in opts.scenes
        for method in opts.solvers
        if not applicable(scene, method)
    ]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        needed = {task.scene for board in boards for task in board.waiting}
        workers = started(boards, opts, folder)
        looking = references([s for s in opts.scenes if s in needed], folder)
        saved = time.monotonic()
        while any(w.is_alive() for w in workers) and time.monotonic() < deadline:
            time.sleep(0.5)
            for worker in workers:
                if worker.is_alive() and time.monotonic() - worker.since > opts.task_limit:
                    worker.kill()
            if time.monotonic() - saved > 10.0:
                write(boards, folder, not_applicable)
                saved = time.monotonic()
        for worker in workers:
            worker.over = True
            worker.kill()
        for worker in workers:
            worker.join(5.0)
        for process in looking:
            process.kill()
            process.wait()
        write(boards, folder, not_applicable)
    for board in boards:
        done = sum(rows[-1]["what"] in ("done", "count") for rows in board.found.values())
        bad = len(board.found) - done
        print(board.platform, done, "done,", bad, "failed or killed,", len(board.waiting), "left")


if __name__ == "__main__":
    main()
