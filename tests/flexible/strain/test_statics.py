"""Static beams: closed forms, digits of other methods, and shooting."""

import json
from pathlib import Path

import numpy as np
import pytest

from rbjax.flexible.strain import strain_beam
from tests.flexible import shooting
from tests.flexible.statics import Cantilever

ORACLES = json.loads((Path(__file__).parents[2] / "oracles/beams.json").read_text())
BENDING = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]


def elastica_error(coordinates: int, loads: list[str]) -> list[float]:
    """Compute the larger error of deflection and shortening, over the length."""
    beam = strain_beam({"k_z": coordinates - 1})
    static, out = Cantilever(beam), []
    for load in loads:
        want = ORACLES["elastica_tip_load"]["table"][load]
        x, y, _ = static.tip(BENDING, beam.defaults, force=(0.0, float(load), 0.0))
        out.append(
            max(abs(y - float(want["v_over_L"])), abs(1 - x - float(want["shortening_over_L"])))
        )
    return out


def test_elastica_of_eight_coordinates():
    """The table of `P L^2 / EI`. The error of strains of degree 7 grows with the load."""
    bounds = {"0.5": 1e-14, "1": 2e-14, "2": 2e-12, "4": 1e-10, "10": 1e-8, "16": 2e-7}
    errors = elastica_error(8, list(bounds))
    assert all(e < bound for e, bound in zip(errors, bounds.values(), strict=True)), errors


def test_elastica_of_twelve_coordinates():
    assert elastica_error(12, ["10"])[0] < 1e-12


def test_roll_up_to_a_circle_needs_one_coordinate():
    """A pure moment gives a constant curvature, which the basis contains, and the quadrature of
    its circle has 14 points. Simo and Vu-Quoc: L = 1, EI = 2, M = 4 pi."""
    beam = strain_beam({"k_z": 0}, points=14)
    static = Cantilever(beam)
    for turns, want in ((0.125, None), (0.25, None), (0.5, None), (1.0, (0.0, 0.0))):
        row = ORACLES["rollup"]["table"][str(turns)]
        want = want or (float(row["x_over_L"]), float(row["y_over_L"]))
        moment = (0.0, 0.0, turns * 4 * np.pi)
        at = static.tip([0, 0, 2.0, 0, 0, 0], beam.defaults, moment=moment, steps=1)
        assert np.abs(at[:2] - want).max() < 1e-13


def bend(slenderness: float) -> tuple[list[float], float]:
    """Return the stiffness of a square section with G = E / 2 and GJ = EI, and the force."""
    side, E = 100.0 / slenderness, 1e7
    A, I = side**2, side**4 / 12
    return [E * I, E * I, E * I, E * A, E * A / 2, E * A / 2], 600.0 * (100.0 / slenderness) ** 4


ARC = dict.fromkeys(("k_x", "k_y", "k_z", "e_x", "g_y", "g_z"), 3)


@pytest.mark.slow
def test_slender_bend_of_45_degrees_with_sixteen_coordinates():
    """One beam without shear and axial strain, with 4, 6 and 6 coefficients of k_x, k_y, k_z. The
    strains that are left out change the tip by 6e-7 of the radius at a slenderness of 1e3."""
    beam = strain_beam({"k_x": 3, "k_y": 5, "k_z": 5}, natural={"k_z": 0})
    static = Cantilever(beam)
    for slenderness in (1e3, 1e4):
        C, force = bend(slenderness)
        params = beam.values_of(length=25 * np.pi, natural_k_z=1 / 100)
        got = static.tip(C, params, force=(0, 0, force))
        want = shooting.tip(C, 100 * np.pi / 4, (0, 0, force), curvature=(0, 0, 1 / 100))
        assert np.linalg.norm(got - want) < 1e-6 * 100


@pytest.fixture(scope="module")
def arc():
    """Bathe and Bolourchi's arc of 45 degrees, radius 100, as two curved beams in series."""
    beam = strain_beam(ARC, natural={"k_z": 0})
    params = beam.values_of(length=100 * np.pi / 8, natural_k_z=1 / 100)
    return Cantilever(beam, links=2), params


@pytest.mark.parametrize("slenderness", [1e1, 1e2, 1e3, 1e4])
def test_bend_of_45_degrees_does_not_lock(arc, slenderness):
    static, params = arc
    C, force = bend(slenderness)
    got = static.tip(C, params, force=(0, 0, force))
    want = shooting.tip(C, 100 * np.pi / 4, (0, 0, force), curvature=(0, 0, 1 / 100))
    key = f"1e{round(np.log10(slenderness))}"
    if key in ORACLES["bend_45_slenderness"]:
        assert np.abs(want - ORACLES["bend_45_slenderness"][key]).max() < 2e-8  # its last digit
    # one beam errs by 1.4e-5, four by 1.4e-9
    assert np.abs(got - want).max() < 4e-7 * 100, got - want


def test_planar_beam_with_shear_and_axial_strain():
    """Exudyn's test of its planar beam: the exact displacement, to its last digit."""
    case = ORACLES["exudyn_2d_exact"]
    L, h, b, E, G = (case[name] for name in ("L", "h", "b", "E", "G"))
    A, ks = b * h, 10 * 1.3 / (12 + 3.3)
    C = [0.0, 0.0, E * b * h**3 / 12, E * A, ks * G * A, 0.0]
    beam = strain_beam({"k_z": 7, "e_x": 7, "g_y": 7})
    force, moment = case["tip_force_across"], case["tip_moment"]
    at = Cantilever(beam).tip(
        C, beam.values_of(length=L), force=(0.0, -force, 0.0), moment=(0.0, 0.0, moment)
    )
    s = np.sqrt(0.5)
    moved = np.array([[s, -s], [s, s]]) @ (at[:2] - [L, 0.0])
    assert np.abs(moved - case["tip_displacement"]).max() < 1e-8
