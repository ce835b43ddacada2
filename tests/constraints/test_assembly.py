"""Consistent states from guesses; freedoms and redundant rows of mechanisms."""

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.mechanisms import spatial_slider_crank
from rbjax import constraints as rc


def test_mobility_of_mechanisms() -> None:
    model = rb.load("four_bar")
    found = rc.mobility(model, model.default_state().q)
    assert (found.freedoms, found.rank) == (1, 2)
    assert found.redundant == ("Spherical 0, row 1",)  # across the plane
    flat = rc.mobility(model, jnp.array([np.pi / 2, -np.pi / 2, np.pi / 2]))
    assert (flat.freedoms, flat.rank) == (2, 1)
    crank, start = spatial_slider_crank()
    assert rc.mobility(crank, start.q) [:2] == (1, 7)  # fmt: skip


def test_a_guess_is_assembled_with_a_joint_pinned() -> None:
    model = rb.load("four_bar")
    guess = rb.State(jnp.array([0.4, -0.1, 0.3]), jnp.array([2.0, 0.0, 0.0]))
    found = rc.assemble(model, guess, pinned=["left"])
    assert found.ok and found.off < 1e-12 and not found.conflicting
    # a parallelogram: both rods alike, the coupler level
    np.testing.assert_allclose(found.state.q, [0.4, -0.4, 0.4], atol=1e-12)
    np.testing.assert_allclose(found.state.v, [2.0, -2.0, 2.0], atol=1e-12)


def test_what_cannot_be_assembled_is_named() -> None:
    model = rb.load("four_bar")
    start = model.default_state()
    far = rc.Distance(rc.Place.on(), rc.Place.on(body="right", point=[1.0, 0, 0]), jnp.array(5.0))
    model = model.with_constraints(far)
    found = rc.assemble(model, start, throw=False)
    assert not found.ok and "Distance 1, row 0" in found.conflicting
    with pytest.raises(rb.InputError, match="Distance 1, row 0"):
        rc.assemble(model, start)
    with pytest.raises(rb.UnknownName, match="rod7"):
        rc.assemble(model, start, pinned=["rod7"])


def test_kinds_are_all_there() -> None:
    found = rc.kinds()
    assert {"Spherical", "Revolute", "Gear", "RollingDisc", "Holonomic", "Pfaffian"} <= set(found)
    assert all(getattr(rc, name) is kind for name, kind in found.items())
