"""The whole demo in f64, and its report.

It has five sections and, in a checkout of the repository, one for each notebook.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from datetime import date
from pathlib import Path
from typing import Any

import jax
import matplotlib

from rbjax.demo.identify import identify
from rbjax.demo.integrators import integrators
from rbjax.demo.motion import motion
from rbjax.demo.notebooks import FOLDER, NOTEBOOKS, notebook
from rbjax.demo.report import ReportSection, write
from rbjax.demo.validate import validate

#: section -> its function, and its weight in progress bars
PARTS: dict[str, tuple[Callable[..., ReportSection], float]] = {
    "motion": (motion, 15),
    "validate": (validate, 35),
    "identify": (identify, 15),
    "integrators": (integrators, 40),
}
if FOLDER.is_dir():
    PARTS |= {
        name: (functools.partial(notebook, name=name), share) for name, share in NOTEBOOKS.items()
    }

#: parts that measure no computing time, and notebooks that run at the same time in a process
UNTIMED, CONCURRENT = ("validate", "identify"), ("forces", "joints")
#: the parts that run by default, in two minutes on two cores
SHORT = ("motion", "validate", "identify", "integrators", "forces", "joints")

_LEAD = (
    "Differentiable rigid-body dynamics in JAX. A robot file goes in. Fast, accurate and "
    "differentiable motion comes out, for one sample or a batch of a million. Everything on this "
    "page was just computed on your machine."
)


def demo(
    folder: str | Path = "rbjax-demo",
    *,
    say: Callable[[str], None] = print,
    done: Callable[[str, float], None] = lambda name, share: None,
    options: dict[str, dict[str, Any]] | None = None,
    everything: bool = False,
) -> Path:
    """Run the demo and write pictures, report.md and report.html.

    Use it to see what rbjax computes on this machine, and how fast.

    Args:
        folder: for the output; created if absent.
        say: called with the name of each stage before it starts.
        done: called with a part's name and weight after it ends.
        options: part -> keyword arguments; None skips the part. The parts are motion,
            validate, identify and integrators, and the notebooks forces, joints, loops, wheels,
            planning, gpu_threads, swing_up, contact and walking.
        everything: also run the parts that are neither in `SHORT` nor in `options`.

    Returns:
        The path of report.html.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    matplotlib.use("Agg")  # no window
    begin = time.perf_counter()
    short = PARTS if everything else SHORT
    given = {n: (options or {}).get(n, {} if n in short else None) for n in PARTS}
    chosen = {name: x for name, x in given.items() if x is not None}

    def run(name: str) -> ReportSection:
        (part, share), start = PARTS[name], time.perf_counter()
        section = part(folder, say, **chosen[name])
        done(name, share)
        return dataclasses.replace(section, seconds=time.perf_counter() - start)

    with jax.enable_x64(True):
        sections = _in_order(list(chosen), run)
    packages = ("jax", "mujoco", "mujoco-mjx")
    versions = ", ".join(f"{p} {importlib.metadata.version(p)}" for p in packages)
    spent = ", ".join(f"{s.title.split(':')[0].lower()} {s.seconds:.0f} s" for s in sections)
    footer = (
        f"{date.today().isoformat()}; {jax.devices()[0].device_kind}, {os.cpu_count()} cores, "
        f"Python {platform.python_version()}, {versions}. "
        f"Took {time.perf_counter() - begin:.0f} s, compilation included ({spent})."
    )
    return write(folder, "rbjax: a robot file in, motion out", _LEAD, sections, footer)


def _in_order(names: list[str], run: Callable[[str], ReportSection]) -> list[ReportSection]:
    """Run parts and return their sections in the given order. The notebooks of `CONCURRENT` run
    during the parts of `UNTIMED`, so that no measured time is disturbed."""
    concurrent = [n for n in names if n in CONCURRENT] if any(n in names for n in UNTIMED) else []
    found: dict[str, ReportSection] = {}
    running: dict[str, Future[ReportSection]] = {}
    with ThreadPoolExecutor(1) as pool:
        for name in names:
            if name in concurrent:
                continue
            if name in UNTIMED and not running:
                running = {n: pool.submit(run, n) for n in concurrent}
            elif name not in UNTIMED:
                wait(running.values())
            found[name] = run(name)
        found |= {n: x.result() for n, x in running.items()}
    return [found[name] for name in names]
