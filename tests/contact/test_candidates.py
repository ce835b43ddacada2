"""Candidates of pairs of geoms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rbjax as rb
from rbjax.contact.geometry.candidates import PairKind, pair_contacts, pairs_of_candidates
from rbjax.contact.geometry.narrow_phase import COUNTS, KINDS, PAIRS
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


@pytest.mark.parametrize(
    "kinds", [("plane", "box"), ("capsule", "cylinder"), ("capsule", "box"), ("box", "box")]
)
def test_pairs_far_apart_have_no_contacts(kinds):
    """The test whether shapes are near removes no contact."""
    rng = np.random.default_rng(0)
    turns = Rotation.random(800, rng).as_matrix().reshape(2, 400, 3, 3)
    p, size = rng.uniform(-0.6, 0.6, (2, 400, 3)), rng.uniform(0.05, 0.3, (2, 400, 3))

    def exists(turns, p, size):
        shapes = [as_shape(*x) for x in zip(p, turns, size, strict=True)]
        near = pair_contacts(PairKind(*kinds), *shapes, 0.02)
        every = PAIRS[kinds](*shapes, 0.02)
        return [jnp.stack([jnp.asarray(c.exists) for c in x]) for x in (near, every)]

    near, every = jax.jit(jax.vmap(exists, in_axes=1))(turns, p, size)
    np.testing.assert_array_equal(near, every)
    assert 0.05 < every.any(axis=1).mean() < 0.95
