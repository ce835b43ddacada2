"""Candidates of pairs of geoms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

import rbjax as rb
from rbjax.contact.geometry.candidates import PairKind, pair_contacts, pairs_of_candidates
from rbjax.contact.geometry.narrow_phase import COUNTS, KINDS
from tests.contact.test_narrow_phase import PRIMITIVES, as_shape


@pytest.mark.filterwarnings("ignore:.*left out of the model.*contacts")
def test_candidates_are_the_columns_of_detect() -> None:
    text = """<mujoco><worldbody><geom type="plane" size="0 0 1"/>
      <body><freejoint/><geom type="box" size=".1 .1 .1"/></body>
      <body pos="0 0 1"><freejoint/><geom type="capsule" size=".1 .1"/></body>
    </worldbody></mujoco>"""
    model = rb.load(text)
    found = pairs_of_candidates(model.geoms, model.geoms.pairs)
    assert found == [0] * 8 + [1] * 2 + [2] * 2
    geoms = tuple(model.geoms.pairs[i] for i in found)
    assert geoms == rb.contact.detect(model, model.default_state().q).geoms
    assert pairs_of_candidates(model.geoms, ()) == []


def test_the_narrow_phase_of_a_pair_has_its_number_of_candidates() -> None:
    one = as_shape(jnp.zeros(3), jnp.eye(3), jnp.full(3, 0.1))
    for kinds in PRIMITIVES:
        found = jax.eval_shape(lambda kinds=kinds: pair_contacts(PairKind(*kinds), one, one, 0.1))
        assert len(found) == COUNTS[kinds]
        assert KINDS.index(kinds[0]) <= KINDS.index(kinds[1])
    assert not PairKind("ellipsoid", "box").supported and not PairKind("plane", "mesh").supported
