"""Meshes, rigid motions, bad input."""

import jax
import numpy as np
import pytest

import rbjax.flexible.reference as rf
from rbjax.errors import InputError, UnknownName
from rbjax.flexible import section
from rbjax.rotations import quaternion
from tests.flexible.reference.formulations import (
    ALL,
    CABLE,
    INCREMENTAL,
    REISSNER,
    SLENDER,
    TOTAL,
    VOLUME,
    bend,
    each,
    elements,
)


def forces(mesh: rf.Mesh, q) -> np.ndarray:
    of, nodes = mesh.formulation, mesh.connectivity
    both = jax.jit(jax.vmap(of.force))
    return np.asarray(both(mesh.data, mesh.history, mesh.q[nodes], q[nodes]))


@each(ALL)
def test_unloaded_beam_has_no_forces(beam):
    mesh = beam.build(rf.arc(1.0), 1.0, SLENDER, elements(beam, 4))
    assert np.abs(forces(mesh, mesh.q)).max() < 1e-7  # EA = 1e7 times rounding


@each([REISSNER, VOLUME, CABLE])
def test_masses_sum_to_the_mass(beam):
    bar = section([1.0] * 6, 3.0, [0.5, 0.2, 0.3])
    mesh = beam.build(rf.line(), 2.0, bar, elements(beam, 4))
    q = mesh.q[mesh.connectivity]
    v = jax.numpy.zeros((*q.shape[:2], beam.d)).at[..., 0].set(1.0)
    p = jax.vmap(beam.momentum)(mesh.data, q, v)[0]
    assert np.allclose(p[..., 0].sum(), 6.0, rtol=1e-14)


def rotated(q, by):
    """Nodes after a rigid rotation about the origin."""
    turned = quaternion.multiply(by, q[..., 3:])
    return jax.numpy.concatenate([quaternion.rotate(by, q[..., :3]), turned], -1)


def rotation_error(beam: rf.Formulation, angle: float) -> float:
    """How much the forces of a bent beam differ after a rigid rotation, relative to them."""
    square, F = bend(100)
    mesh = beam.build(rf.arc(100.0), 25 * np.pi, square, elements(beam, 4))
    wrench = np.zeros((10, len(mesh.q), 6))
    wrench[:, -1, 2] = np.linspace(0, F, 11)[1:]
    mesh = rf.solve_static(mesh, wrench, beam.supports(mesh)).mesh
    by = quaternion.exp(angle * np.array([0.48, -0.6, 0.64]))
    here, there = forces(mesh, mesh.q), forces(mesh, rotated(mesh.q, by))
    turned = [quaternion.rotate(by, here[..., i : i + 3]) for i in (0, 3)]
    return float(np.abs(there - np.concatenate(turned, -1)).max() / np.abs(here).max())


# Rounding of the strain energy's gradient: EA over the load, 1e7/600, times 1e-15 and a few terms.
@each([REISSNER, VOLUME, INCREMENTAL])
def test_objective(beam):
    assert rotation_error(beam, 1.2) < 1e-9


def test_total_rotation_vectors_are_not_objective():
    assert rotation_error(TOTAL, 1.2) > 1e-2


def two_orders(beam: rf.Formulation, segments: int) -> float:
    """How far apart the tip ends for two orders of the same two loads, in m."""
    square, F = bend(100)
    mesh = beam.build(rf.arc(100.0), 25 * np.pi, square, elements(beam, segments))
    first, second = (
        np.r_[np.linspace(0.1, 1, 10), np.ones(10)],
        np.r_[np.zeros(10), np.linspace(0.1, 1, 10)],
    )
    tips = []
    for up, inward in ((first, second), (second, first)):
        wrench = np.zeros((20, len(mesh.q), 6))
        wrench[:, -1, 2], wrench[:, -1, 1] = F * up, -2 / 3 * F * inward
        tips.append(rf.solve_static(mesh, wrench, beam.supports(mesh)).mesh.q[-1, :3])
    return float(np.abs(tips[0] - tips[1]).max())


# Newton's tolerance is 1e-10 of the beam, 100 m.
@each([REISSNER, TOTAL])
def test_path_independent(beam):
    assert two_orders(beam, 8) < 1e-7


# Measured with 8 segments: 0.27 and 0.033 m. The dependence vanishes with the mesh, not with steps.
@pytest.mark.parametrize("beam, least", [(INCREMENTAL, 0.1), (VOLUME, 0.01)])
def test_incremental_rotations_depend_on_the_path(beam, least):
    coarse, fine = two_orders(beam, 8), two_orders(beam, 16)
    assert least < coarse < 10 * least and fine < 0.4 * coarse


def test_bad_input():
    with pytest.raises(UnknownName, match="quadrature"):
        rf.Reissner("selective")
    with pytest.raises(UnknownName, match="interpolation"):
        rf.Reissner(interpolation="spherical")
    with pytest.raises(UnknownName, match="quadrature"):
        rf.AbsoluteNodal("selective")
    with pytest.raises(InputError, match="at least 1 element"):
        REISSNER.build(rf.line(), 1.0, SLENDER, 0)
    with pytest.raises(InputError, match="positive, in m"):
        VOLUME.build(rf.line(), -1.0, SLENDER, 2)
    with pytest.raises(InputError, match="radius"):
        rf.arc(0.0)
    coupled = np.diag(np.ones(6)) + np.diag([0.1], 5) + np.diag([0.1], -5)
    with pytest.raises(InputError, match="couplings"):
        CABLE.build(rf.line(), 1.0, section(coupled, 1.0, [0.0, 0.0, 0.0]), 2)
    mesh = CABLE.build(rf.line(), 1.0, SLENDER, 2)
    with pytest.raises(InputError, match="plane"):
        CABLE.supports(mesh)
    supports = CABLE.supports(mesh, planar=True)
    with pytest.raises(InputError, match="wrenches"):
        rf.solve_static(mesh, np.zeros((3, 6)), supports)
    with pytest.raises(InputError, match="wrenches"):
        rf.simulate(mesh, np.zeros((3, 6)), 0.1, supports)
    with pytest.raises(InputError, match="dt is 0"):
        rf.simulate(mesh, np.zeros((1, 3, 6)), 0.0, supports)
    with pytest.raises(InputError, match="clamp_angles"):
        rf.simulate(mesh, np.zeros((1, 3, 6)), 0.1, supports, clamp_angles=np.zeros(1))
    with pytest.raises(InputError, match="momenta"):
        rf.simulate(mesh, np.zeros((1, 3, 6)), 0.1, supports, momenta=np.zeros(3))
    with pytest.raises(InputError, match="increments"):
        rf.solve_static(mesh, np.zeros((1, 3, 6)), supports, np.zeros(3))
    with pytest.raises(InputError, match="steps"):
        rf.cantilever(CABLE, SLENDER, 1.0, 2, steps=0)
