"""Beams in motion: the flying beam and the spin-up manoeuvre of Simo and Vu-Quoc."""

from functools import cache

import numpy as np
import pytest

import rbjax.flexible.reference as rf
from rbjax.errors import RbjaxError
from tests.flexible.reference.formulations import (
    BEAMS,
    CABLE,
    REISSNER,
    SLENDER,
    VOLUME,
    each,
    elements,
)

TIMES = (1, 2.5, 5, 7.5)


@cache
def flight(beam: rf.Formulation, segments: int, dt: float, EI: int) -> rf.Motion:
    return rf.flying_beam(beam, elements(beam, segments), dt, EI=EI)


def flight_errors(beam: rf.Formulation, segments: int, dt: float, EI: int) -> np.ndarray:
    motion = flight(beam, segments, dt, EI)
    x = np.asarray(beam.pose(motion.q[:, -1])[0])[:, :2]
    found = (x - x[0])[[round(t / dt) for t in TIMES]]
    return np.abs(found - [*BEAMS["flying_beam_step_load"][f"EI_{EI}"].values()]).max(1)


# Measured, the largest of four times; the load jumps, so the error does not fall as h^2 in time.
@pytest.mark.parametrize(
    "beam, EI, coarse, fine",
    [(REISSNER, 500, 0.02, 0.008), (REISSNER, 100, 0.15, 0.06), (VOLUME, 500, 0.2, 0.05),
     (VOLUME, 100, 0.3, 0.06)],
)  # fmt: skip
def test_flying_beam_converges(beam, EI, coarse, fine):
    assert flight_errors(beam, 8, 0.02, EI).max() < coarse
    assert flight_errors(beam, 16, 0.01, EI).max() < fine


def test_flying_cable_has_no_shear():
    """The limit is another: EA = GA, so shear moves the end by some millimetres."""
    assert 1e-3 < flight_errors(CABLE, 16, 0.01, 500).max() < 6e-3


@each([REISSNER, VOLUME, CABLE])
def test_momentum_is_the_impulse(beam):
    p = np.asarray(flight(beam, 16, 0.01, 500).p[:, :, :2].sum(1))
    impulse = np.minimum(8 * 0.01 * np.arange(len(p)), 20)
    assert np.abs(p - np.stack([impulse, 0 * impulse], -1)).max() < 1e-10  # 750 steps of rounding


@each([REISSNER, VOLUME])
def test_angular_momentum_after_release(beam):
    """About the origin, r x p + spin is constant: the forces of an element balance."""
    motion = flight(beam, 16, 0.01, 500)
    x, p = np.asarray(motion.q[250:, :, :3]), np.asarray(motion.p[250:])
    about = (np.cross(x, p[..., :3]) + p[..., 3:]).sum(1)[:, 2]
    assert np.ptp(about) < 1e-8 * abs(about[0])


def test_energy_after_release():
    """Nearly constant: the mean of the stresses makes it so to third order in the step. The finite
    volumes integrate no energy, and gain some."""
    energy = np.asarray(flight(REISSNER, 16, 0.01, 500).energy.sum(1))[251:]
    assert np.ptp(energy) < 1e-3 * energy[0]


# Largest errors over the table, measured with dt = 0.01 s, with 8 segments; the table's digits are
# good to 1e-7. The cable has no shear, and nearly none is needed here.
@pytest.mark.parametrize(
    "beam, axial, across", [(REISSNER, 1e-4, 2e-3), (VOLUME, 4e-4, 6e-3), (CABLE, 2e-5, 4e-4)]
)
def test_spin_up(beam, axial, across):
    dt, table = 0.01, BEAMS["spin_up_table"]
    t, tip = (np.asarray(x) for x in rf.spin_up_beam(beam, elements(beam, 8), dt))
    for key in ("2.5", "5", "7.5", "10", "12.5", "15"):
        error = np.abs(tip[round(float(key) / dt)] - table[key])
        assert error[0] < axial and error[1] < across, (key, error)
    lag, at = table["peak_lag"]
    assert abs(tip[:, 1].min() - lag) < across
    assert abs(t[tip[:, 1].argmin()] - at) < 2 * dt
    extension = BEAMS["spin_up_beam"]["steady_extension_linear"]
    assert abs(tip[t > 17, 0].mean() - extension) < 0.01 * extension


def test_failure_of_newton_is_said():
    """A force of 1 kN on the end of a slender cantilever, in one step."""
    mesh = REISSNER.build(rf.line(), 1.0, SLENDER, 4)
    wrenches = np.zeros((1, len(mesh.q), 6))
    wrenches[:, -1, 1] = 1e3
    with pytest.raises(RbjaxError, match="did not converge in step 1 of 1"):
        rf.simulate(mesh, wrenches, 0.01, REISSNER.supports(mesh))
