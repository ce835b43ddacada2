"""A chain of rigid links with springs against the elastica and closed forms of vibration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.flexible.reference.lumped_chain import lumped_beam
from rbjax.flexible.reference.uniform_beam import UniformBeam
from tests.flexible.reference.tip_load import (
    ROOTS,
    UNIFORM,
    elastica_error,
    frequencies,
    frequency_errors,
    tip_of,
)
from tests.tolerances import F64_PARITY

#: error of the elastica at P L^2 / EI = 10 by links, from an independent script
ERRORS = {1: 1.837e-1, 2: 8.799e-2, 4: 2.773e-2, 8: 7.023e-3, 16: 1.753e-3}


@pytest.mark.parametrize(
    "n", [2, 4, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 8, 16))]
)
def test_the_error_of_the_elastica_falls_as_the_square_of_the_links(n):
    model = lumped_beam(UniformBeam(1.0, n, planar=True, **UNIFORM))
    np.testing.assert_allclose(elastica_error(model), ERRORS[n], rtol=1e-3)


def test_balls_bend_as_hinges():
    model = lumped_beam(UniformBeam(1.0, 4, torsion=0.8, **UNIFORM))
    plane = lumped_beam(UniformBeam(1.0, 4, planar=True, **UNIFORM))
    force = (0.0, 3.0, 0.0)
    np.testing.assert_allclose(tip_of(model, force), tip_of(plane, force), atol=F64_PARITY)


def test_frequencies_converge_as_the_square_of_the_links():
    errors = [
        frequency_errors(lumped_beam(UniformBeam(1.0, n, planar=True, **UNIFORM))) for n in (8, 16)
    ]
    # measured: -1.8e-3, -6.2e-3 and -1.0e-2 with 16 links
    assert (np.abs(errors[1]) < [2e-3, 7e-3, 1.1e-2]).all()
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.05)


def test_frequencies_in_space():
    stiff, soft, torsion = 4.0, 1.0, 8e-3
    beam = {"bending": (stiff, soft), "mass": 1.0, "inertia": (2e-4, 1e-4, 1e-4)}
    found = frequencies(lumped_beam(UniformBeam(1.0, 12, torsion=torsion, **beam)))
    # torsion of a clamped rod: (2 k - 1) pi / 2 sqrt(GJ / rho J); bending about z and about y
    twists = np.pi / 2 * np.sqrt(torsion / 2e-4) * np.array([1, 3])
    bends = np.concatenate([np.sqrt(EI) * ROOTS[:2] ** 2 for EI in (soft, stiff)])
    want = np.sort(np.concatenate([twists, bends]))[:5]
    np.testing.assert_allclose(found[:5], want, rtol=1.5e-2)  # the second bending: 1.1e-2


def test_float32():
    model = lumped_beam(UniformBeam(1.0, 8, planar=True, **UNIFORM))
    single = jax.tree.map(lambda x: x.astype(jnp.float32), model)
    force = (0.0, 10.0, 0.0)
    np.testing.assert_allclose(tip_of(single, force), tip_of(model, force), atol=3e-6)


def test_bad_input():
    good = {"length": 1.0, "segments": 2, "torsion": 1.0, **UNIFORM}
    wrong = {
        "length": 0.0, "segments": 0, "torsion": -1.0, "mass": 0.0, "bending": (1.0, 0.0),
        "inertia": (0.0, 1.0, 1.0),
    }  # fmt: skip
    for name, value in wrong.items():
        with pytest.raises(rb.InputError, match=name):
            lumped_beam(UniformBeam(**(good | {name: value})))
