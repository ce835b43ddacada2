"""Static beams: closed forms, the 45-degree bend, locking, orders of convergence."""

import numpy as np
import pytest

import rbjax.flexible.reference as rf
from rbjax.errors import RbjaxError
from rbjax.flexible import rectangle
from tests.flexible.reference.formulations import (
    ALL,
    BEAMS,
    CABLE,
    LOCKED,
    REISSNER,
    SLENDER,
    VOLUME,
    bent,
    each,
    elements,
)

STEPS = 20  # the same everywhere, so that a mesh is compiled once
SOUND = [one for one in ALL if one is not LOCKED]
BENDABLE = [one for one in SOUND if one.spatial]


def elastica_error(beam: rf.Formulation, segments: int, load: str) -> float:
    row = BEAMS["elastica_tip_load"]["table"][load]
    want = -float(row["shortening_over_L"]), float(row["v_over_L"])
    many = elements(beam, segments)
    tip = rf.cantilever(beam, SLENDER, 1.0, many, force=(0, float(load), 0), steps=STEPS)
    return float(np.abs(tip[:2] - np.array(want)).max())


# Errors with 16 segments, measured, with a factor of about 1.5 for another compiler's rounding of
# nothing: they are discretisation errors, which do not depend on it.
@pytest.mark.parametrize("load", BEAMS["elastica_tip_load"]["table"])
@each(SOUND)
def test_elastica(beam, load):
    allowed = {VOLUME: 2e-3, CABLE: 1e-3, rf.AbsoluteNodal("full"): 4e-3}.get(beam, 3e-3)
    assert elastica_error(beam, 16, load) < allowed


# Two-node elements are of order 2. Order 4: two collocation points of parabolas, cubic polynomials.
@pytest.mark.parametrize("beam, order", [(REISSNER, 2), (VOLUME, 4), (CABLE, 4)])
def test_order_of_convergence(beam, order):
    coarse, fine = (elastica_error(beam, segments, "4") for segments in (8, 16))
    assert abs(np.log2(coarse / fine) - order) < 0.25


# A full circle. One-point elements of constant curvature close a polygon: rounding times the number
# of load steps. The others have the discretisation error of 16 segments.
@pytest.mark.parametrize("beam, error", [(REISSNER, 1e-9), (VOLUME, 5e-3), (CABLE, 5e-3)])
@pytest.mark.parametrize("part", ["0.25", "0.5", "1.0"])
def test_roll_up(beam, error, part):
    row = BEAMS["rollup"]["table"][part]
    moment = (0, 0, 2 * np.pi * float(part))
    tip = rf.cantilever(beam, SLENDER, 1.0, elements(beam, 16), moment=moment, steps=STEPS)
    want = np.array([float(row["x_over_L"]) - 1, float(row["y_over_L"])])
    if beam is REISSNER and part != "1.0":
        # The polygon has chords as long as the arcs: a ratio of (t / sin t), t half an angle.
        t = np.pi * float(part) / 16
        want = (want + np.array([1, 0])) * t / np.sin(t) - [1, 0]
    assert np.abs(tip[:2] - want).max() < error


# The reference has 12 digits. Errors measured with 16 segments: 0.023, 0.026, 0.028, 0.0005.
@each(BENDABLE)
def test_45_degree_bend(beam):
    want = BEAMS["bathe_45deg_bend"]["mine_GA_5e6"]["600"]["u"]
    assert np.abs(bent(beam, 16, 100, STEPS) - want).max() < (1e-3 if beam is VOLUME else 0.03)


def exudyn_tip(segments: int) -> np.ndarray:
    case = BEAMS["exudyn_2d_exact"]
    section = rectangle(
        case["h"], case["b"], E=case["E"], G=case["G"], density=1.0, shear=13 / 15.3
    )
    F = case["tip_force_across"] / np.sqrt(2)
    tip = rf.cantilever(
        REISSNER, section, case["L"], segments, force=(F, -F, 0),
        moment=(0, 0, case["tip_moment"]), steps=STEPS, curve=rf.line(angle=np.pi / 4),
    )  # fmt: skip
    return np.asarray(tip[:2])


def test_thick_beam_of_exudyn():
    """The exact tip by extrapolation from 16 and 32 elements, order 2, to its next term, order 4;
    and the uy that Exudyn's test suite expects of 16 linear elements, which are the same elements:
    16 digits there, of which Newton's tolerance of 1e-10 leaves 9 here."""
    coarse, fine = exudyn_tip(16), exudyn_tip(32)
    assert abs(coarse[1] - -2.211502835379855) < 1e-9
    want = BEAMS["exudyn_2d_exact"]["tip_displacement"]
    assert np.abs(fine + (fine - coarse) / 3 - want).max() < 1e-5


def bends(beam: rf.Formulation) -> list[np.ndarray]:
    steps = {1e4: 100}  # Newton's method needs more of them
    return [bent(beam, 16, by, steps.get(by, STEPS)) for by in (1e1, 1e2, 1e3, 1e4)]


@each([REISSNER, VOLUME])
def test_no_locking(beam):
    """A slender bend differs from its limit by a term in 1 / slenderness^2."""
    tips = bends(beam)
    thick, normal = tips[0] - tips[1], tips[1] - tips[2]
    assert np.abs(normal - thick / 100).max() < 1e-4
    assert np.abs(tips[2] - tips[3]).max() < 1e-4


def test_full_quadrature_locks_in_shear():
    """The slender bend with full quadrature moves by a sixth of the right distance; a straight one,
    by less than a thousandth of it."""
    tips = bends(LOCKED)
    assert abs(tips[0][2] - 54.1) < 2
    assert all(tip[2] < 20 for tip in tips[1:])
    straight = rf.cantilever(LOCKED, SLENDER, 1.0, 16, force=(0, 2, 0), steps=STEPS)
    assert straight[1] < 1e-3 * float(BEAMS["elastica_tip_load"]["table"]["2"]["v_over_L"])


def test_failure_of_newton_is_said():
    with pytest.raises(RbjaxError, match="did not converge at load"):
        bent(REISSNER, 16, 1e4, STEPS)
