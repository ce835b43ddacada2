"""Candidates of pairs of geoms and the lower bound of their distance."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.geometry.candidates import PairKind, candidates, cheap_distance, pair_contacts
from rbjax.contact.geometry.narrow_phase import COUNTS, KINDS
from tests.contact.test_narrow_phase import PRIMITIVES, as_shape, poses, scene


@pytest.mark.parametrize("kinds", PRIMITIVES, ids="-".join)
def test_the_bound_is_below_the_distance(kinds) -> None:
    """The distance is MuJoCo's, and the least one of our candidates."""
    m = scene(*kinds)
    d = mujoco.MjData(m)
    kind, fromto = PairKind(*kinds), np.zeros(6)
    given, true = [], []
    for q in 2.0 * poses(m, np.random.default_rng(3), 100):
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        given.append((d.geom_xpos.copy(), d.geom_xmat.reshape(-1, 3, 3).copy()))
        true.append(mujoco.mj_geomDistance(m, d, 0, 1, 10.0, fromto))
    p, R = (jnp.asarray(np.stack(x)) for x in zip(*given, strict=True))
    sizes = jnp.asarray(m.geom_size)

    @jax.vmap
    def bound(p, R):
        one, other = (as_shape(p[k], R[k], sizes[k]) for k in (0, 1))
        return cheap_distance(kind, one, other)

    found = np.asarray(bound(p, R))
    assert (found <= np.array(true) + 1e-5).all()
    assert (found > 0).mean() > 0.2  # it does reject pairs


@pytest.mark.filterwarnings("ignore:.*left out of the model.*contacts")
def test_candidates_are_the_columns_of_detect() -> None:
    text = """<mujoco><worldbody><geom type="plane" size="0 0 1"/>
      <body><freejoint/><geom type="box" size=".1 .1 .1"/></body>
      <body pos="0 0 1"><freejoint/><geom type="capsule" size=".1 .1"/></body>
    </worldbody></mujoco>"""
    model = rb.load(text)
    found = candidates(model.geoms, model.geoms.pairs)
    geoms = [model.geoms.pairs[x.pair] for x in found]
    assert tuple(geoms) == rb.contact.detect(model, model.default_state().q).geoms
    assert [x.bodies for x in found[:8]] == [(-1, 0)] * 8
    assert [x.slot for x in found] == [*range(8), 0, 1, 0, 1]
    assert candidates(model.geoms, ()) == ()


def test_the_narrow_phase_of_a_pair_has_its_number_of_candidates() -> None:
    one = as_shape(jnp.zeros(3), jnp.eye(3), jnp.full(3, 0.1))
    for kinds in PRIMITIVES:
        found = jax.eval_shape(lambda kinds=kinds: pair_contacts(PairKind(*kinds), one, one, 0.1))
        assert len(found) == COUNTS[kinds]
        assert KINDS.index(kinds[0]) <= KINDS.index(kinds[1])
    assert not PairKind("ellipsoid", "box").supported and not PairKind("plane", "mesh").supported
