"""The formulations under test, with the elements that give each the same number of nodes."""

from __future__ import annotations

import numpy as np
import pytest

import rbjax.flexible.reference as rf
from rbjax.flexible import Section, section
from tests.oracles import load

BEAMS = load("beams")
REISSNER, LOCKED = rf.Reissner(), rf.Reissner("full")
TOTAL, INCREMENTAL = rf.Reissner(interpolation="total"), rf.Reissner(interpolation="incremental")
VOLUME, CABLE = rf.FiniteVolume(), rf.AbsoluteNodal()
ALL = [REISSNER, LOCKED, TOTAL, INCREMENTAL, VOLUME, CABLE, rf.AbsoluteNodal("full")]
#: nearly inextensible and without shear, EI = 1
SLENDER = section([1.0, 1.0, 1.0, 1e7, 1e7, 1e7], 1.0, [0.0, 0.0, 0.0])


def each(formulations: list[rf.Formulation]) -> pytest.MarkDecorator:
    """Run a test for each formulation."""
    ids = [one.name.replace(", ", "-").replace(" ", "-") for one in formulations]
    return pytest.mark.parametrize("beam", formulations, ids=ids)


def elements(beam: rf.Formulation, segments: int) -> int:
    """The number of elements with so many segments between nodes."""
    return segments // (beam.k - 1)


def bend(slenderness: float) -> tuple[Section, float]:
    """Section of the 45-degree bend of radius 100, a square of side w = 100 / slenderness, and the
    force that bends it alike."""
    w = 100 / slenderness
    A, I = w * w, w**4 / 12
    stiffness = [1e7 * I, 1e7 * I, 1e7 * I, 1e7 * A, 5e6 * A, 5e6 * A]
    return section(stiffness, 1.0, [0.0, 0.0, 0.0]), 600 * w**4


def bent(beam: rf.Formulation, segments: int, slenderness: float, steps: int) -> np.ndarray:
    """Displacement of the tip of the 45-degree bend."""
    square, F = bend(slenderness)
    many, length = elements(beam, segments), 25 * np.pi
    x = rf.cantilever(
        beam, square, length, many, force=(0, 0, F), steps=steps, curve=rf.arc(100.0)
    )  # fmt: skip
    return np.asarray(x)
