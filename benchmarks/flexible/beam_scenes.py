"""Scenes of beams, their answers, and the reference formulations as entries of a comparison.

An `Entry` runs a scene at a resolution. To compare a further formulation, write a function from a
scene's name and a number of segments to the number of coordinates and a function without arguments
that solves the scene and returns its answer, or None if it does not have the scene; and append
`Entry(name, function)` to a list such as `references()`.

Scenes and their answers:
"elastica": cantilever, L = EI = 1, under a dead force P = 10 across: displacement (2,) of the tip.
"bend": the 45-degree bend of Bathe and Bolourchi, 600 N: displacement (3,) of the tip.
"flying": the flying beam of Simo and Vu-Quoc, EI = 500: displacement (4, 2) of the loaded end at
    1, 2.5, 5 and 7.5 s.
"spin_up": the spin-up manoeuvre: axial and across displacement (6, 2) of the tip at 2.5, ..., 15 s.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rbjax.flexible.reference as rf
from rbjax.errors import RbjaxError
from rbjax.flexible import section

BEAMS = json.loads((Path(__file__).parents[2] / "tests" / "oracles" / "beams.json").read_text())
FLYING_TIMES = (1.0, 2.5, 5.0, 7.5)
SPIN_TIMES = (2.5, 5.0, 7.5, 10.0, 12.5, 15.0)
SLENDER = section([1.0, 1.0, 1.0, 1e8, 1e8, 1e8], 1.0, [0.0, 0.0, 0.0])
SQUARE = section([1e7 / 12] * 3 + [1e7, 5e6, 5e6], 1.0, [0.0, 0.0, 0.0])

Prepared = tuple[int, Callable[[], np.ndarray]]


class Entry(NamedTuple):
    """A formulation in a comparison: its name and its runs, see the module."""

    name: str
    run: Callable[[str, int], Prepared | None]


def _elastica() -> np.ndarray:
    row = BEAMS["elastica_tip_load"]["table"]["10"]
    return np.array([-float(row["shortening_over_L"]), float(row["v_over_L"])])


ANSWERS = {
    "elastica": _elastica(),
    "bend": np.array(BEAMS["bathe_45deg_bend"]["mine_GA_5e6"]["600"]["u"]),
    "flying": np.array([*BEAMS["flying_beam_step_load"]["EI_500"].values()]),
    "spin_up": np.array([BEAMS["spin_up_table"][f"{t:g}"] for t in SPIN_TIMES]),
}
#: step of a motion with so many segments, s
STEPS = {"flying": lambda segments: 0.16 / segments, "spin_up": lambda segments: 0.16 / segments}


def references() -> list[Entry]:
    """The reference formulations, each as an `Entry`."""
    beams = [
        rf.Reissner(), rf.Reissner("full"), rf.Reissner(interpolation="incremental"),
        rf.FiniteVolume(), rf.AbsoluteNodal(),
    ]  # fmt: skip
    return [Entry(beam.name, lambda scene, n, beam=beam: prepare(beam, scene, n)) for beam in beams]


def prepare(beam: rf.Formulation, scene: str, segments: int) -> Prepared | None:
    """A scene with a reference formulation: its number of coordinates and its solution."""
    many, planar = segments // (beam.k - 1), sum(beam.planar)

    def bend() -> np.ndarray:
        arc, force = rf.arc(100.0), (0, 0, 600)
        return np.asarray(
            rf.cantilever(beam, SQUARE, 25 * np.pi, many, force=force, curve=arc, steps=10)
        )

    def elastica() -> np.ndarray:
        tip = rf.cantilever(beam, SLENDER, 1.0, many, force=(0, 10, 0), steps=10, planar=True)
        return np.asarray(tip[:2])

    if scene == "bend":
        return (6 * segments, bend) if beam.spatial else None
    if scene == "elastica":
        return planar * segments, elastica
    dt = STEPS[scene](segments)

    def fly() -> np.ndarray:
        x = beam.pose(rf.flying_beam(beam, many, dt).q[:, -1])[0][:, :2]
        return np.asarray(x - x[0])[[round(t / dt) for t in FLYING_TIMES]]

    def spin() -> np.ndarray:
        tip = rf.spin_up_beam(beam, many, dt, 15.0)[1]
        return np.asarray(tip)[[round(t / dt) for t in SPIN_TIMES]]

    return (planar * (segments + 1), fly) if scene == "flying" else (planar * segments, spin)


def measure(entry: Entry, scene: str, segments: int, runs: int = 3) -> dict[str, Any] | None:
    """Error, coordinates and seconds, the least of some runs after one that compiles; None if the
    entry does not have the scene."""
    prepared = entry.run(scene, segments)
    if prepared is None:
        return None
    coordinates, run = prepared
    row = {"scene": scene, "formulation": entry.name, "segments": segments}
    row |= {"coordinates": coordinates}
    seconds = math.inf
    try:
        answer = run()
        for _ in range(runs):
            begin = time.perf_counter()
            run()
            seconds = min(seconds, time.perf_counter() - begin)
    except RbjaxError as error:
        return row | {"error": None, "run_s": None, "note": str(error)}
    return row | {"error": float(np.abs(answer - ANSWERS[scene]).max()), "run_s": seconds}
