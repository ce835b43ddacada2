"""Segments of constant curvature against the elastica, the circle, and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.flexible.reference.piecewise_constant_strain import constant_strain_beam
from rbjax.flexible.reference.uniform_beam import UniformBeam
from tests.flexible.reference.tip_load import (
    UNIFORM,
    elastica_error,
    frequency_errors,
    tip_of,
)
from tests.tolerances import F64_PARITY, GRADIENT

#: error of the elastica at P L^2 / EI = 10 by segments, from an independent script
ERRORS = {1: 1.4e-1, 2: 4.3e-2, 4: 1.1e-2, 8: 2.6e-3, 16: 6.5e-4}


@pytest.mark.parametrize(
    "n", [2, 4, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 8, 16))]
)
def test_the_error_of_the_elastica_falls_as_the_square_of_the_segments(n):
    model = constant_strain_beam(UniformBeam(1.0, n, planar=True, **UNIFORM))
    np.testing.assert_allclose(elastica_error(model), ERRORS[n], rtol=0.03)  # two digits


def test_segments_in_space_bend_as_in_the_plane():
    model = constant_strain_beam(UniformBeam(1.0, 3, torsion=0.8, **UNIFORM))
    plane = constant_strain_beam(UniformBeam(1.0, 3, planar=True, **UNIFORM))
    force = (0.0, 3.0, 0.0)
    np.testing.assert_allclose(tip_of(model, force), tip_of(plane, force), atol=F64_PARITY)


@pytest.mark.parametrize("n", [1, 3])
def test_a_constant_strain_is_a_helix(n):
    model = constant_strain_beam(UniformBeam(2.0, n, torsion=0.8, **UNIFORM))
    strain = np.array([0.7, -0.4, 0.9])  # 1/m
    q = jnp.tile(jnp.array(strain * 2.0 / n), n)
    R, p = rb.frame_pose(model, q, site="tip")
    # r' = R e_x, R' = R [k]: the axis of the helix is k, the pitch and radius follow from it
    k = strain / np.linalg.norm(strain)
    angle = 2.0 * np.linalg.norm(strain)
    along = k * k[0] * 2.0
    across = np.array([1.0, 0, 0]) - k * k[0]
    turn = (np.sin(angle) * across + (1 - np.cos(angle)) * np.cross(k, across)) * 2.0 / angle
    np.testing.assert_allclose(p, along + turn, atol=1e-14)
    want = np.cos(angle) * across + np.sin(angle) * np.cross(k, across) + k * k[0]
    np.testing.assert_allclose(R[:, 0], want, atol=1e-14)


def test_frequencies():
    errors = [
        frequency_errors(constant_strain_beam(UniformBeam(1.0, n, planar=True, **UNIFORM)))
        for n in (4, 8)
    ]
    # measured: -4.1e-3, -3.4e-3, 1.3e-2 with 8 segments, and -1.7e-2 with 4
    assert (np.abs(errors[1]) < [5e-3, 4e-3, 1.5e-2]).all()
    np.testing.assert_allclose(errors[0][0] / errors[1][0], 4.0, rtol=0.05)


def test_the_energy_has_the_force_as_its_slope():
    model = constant_strain_beam(UniformBeam(1.0, 2, torsion=0.8, **UNIFORM))
    q = jnp.array([0.3, -0.2, 0.8, 0.1, 0.4, -0.5])
    slope = jax.grad(lambda q: rb.forces.elastic_energy(model, q))(q)
    force = rb.applied_forces(model, rb.State(q, jnp.zeros(model.nv)))
    np.testing.assert_allclose(force, -slope, atol=GRADIENT * 1e-4)


def test_float32():
    model = constant_strain_beam(UniformBeam(1.0, 4, planar=True, **UNIFORM))
    single = jax.tree.map(lambda x: x.astype(jnp.float32), model)
    force = (0.0, 10.0, 0.0)
    np.testing.assert_allclose(tip_of(single, force), tip_of(model, force), atol=3e-6)


def test_bad_input():
    with pytest.raises(rb.InputError, match="bending is"):
        constant_strain_beam(
            UniformBeam(1.0, 2, planar=True, **(UNIFORM | {"bending": (1.0, -1.0)}))
        )
    with pytest.raises(rb.InputError, match="torsion is"):
        constant_strain_beam(UniformBeam(1.0, 2, **UNIFORM))
