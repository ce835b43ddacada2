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
from datetime import date
from pathlib import Path
from typing import Any

import jax
import matplotlib

from rbjax.demo.identify import identify
from rbjax.demo.integrators import integrators
from rbjax.demo.landing import landing
from rbjax.demo.motion import motion
from rbjax.demo.notebooks import FOLDER, NOTEBOOKS, notebook
from rbjax.demo.report import Section, write
from rbjax.demo.validate import validate

#: section -> its function, and its weight in progress bars
PARTS: dict[str, tuple[Callable[..., Section], float]] = {
    "motion": (motion, 15),
    "landing": (landing, 12),
    "validate": (validate, 35),
    "identify": (identify, 15),
    "integrators": (integrators, 40),
}
if FOLDER.is_dir():
    PARTS |= {
        name: (functools.partial(notebook, name=name), share) for name, share in NOTEBOOKS.items()
    }

#: the parts that run by default, in two minutes on two cores
SHORT = ("motion", "landing", "validate", "identify", "integrators", "forces", "joints")

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
        options: part -> keyword arguments; None skips the part. The parts are motion, landing,
            validate, identify, integrators, and the notebooks forces, joints, loops, wheels,
            planning, gpu_threads, swing_up, contact and walking.
        everything: also run the parts that are neither in `SHORT` nor in `options`.

    Returns:
        The path of report.html.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    matplotlib.use("Agg")  # no window
    begin, sections = time.perf_counter(), []
    short = PARTS if everything else SHORT
    chosen = {n: (options or {}).get(n, {} if n in short else None) for n in PARTS}
    with jax.enable_x64(True):
        for name, (part, share) in PARTS.items():
            given = chosen[name]
            if given is None:
                continue
            start = time.perf_counter()
            section = part(folder, say, **given)
            sections.append(dataclasses.replace(section, seconds=time.perf_counter() - start))
            done(name, share)
    packages = ("jax", "mujoco", "mujoco-mjx")
    versions = ", ".join(f"{p} {importlib.metadata.version(p)}" for p in packages)
    spent = ", ".join(f"{s.title.split(':')[0].lower()} {s.seconds:.0f} s" for s in sections)
    footer = (
        f"{date.today().isoformat()}; {jax.devices()[0].device_kind}, {os.cpu_count()} cores, "
        f"Python {platform.python_version()}, {versions}. "
        f"Took {time.perf_counter() - begin:.0f} s, compilation included ({spent})."
    )
    return write(folder, "rbjax: a robot file in, motion out", _LEAD, sections, footer)
