"""Contacts of whole robots against MuJoCo C, their derivatives, and messages for bad input."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.loading.mjcf.contact_pairs import contact_pairs

SCENES = Path(rb.loading.__file__).parent / "scenes"
pytestmark = pytest.mark.filterwarnings("ignore:.*left out of the model.*contacts")

PILE = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="0 0 1" quat="0.98 0.1 -0.1 0"/>
  <body pos="0 0 .2"><freejoint/><geom name="torso" type="capsule" size=".08 .12"/>
    <body name="thigh" pos=".1 0 0"><joint axis="0 1 0"/><geom type="sphere" size=".07"/>
      <body name="shin" pos=".15 0 0"><joint axis="0 1 0"/>
        <geom type="capsule" size=".05 .1"/></body>
      <body pos=".1 0 .1"><geom type="sphere" size=".09"/></body></body>
    <body name="arm" pos="-.1 .05 0"><joint axis="1 0 0"/>
      <geom name="hand" type="sphere" size=".08"/>
    </body></body>
  <body pos=".1 .1 .2"><freejoint/>
    <geom type="box" size=".1 .08 .12" margin=".02" gap=".01"/></body>
  <body name="ball" pos="-.1 .1 .2"><freejoint/><geom type="sphere" size=".1" contype="2"/></body>
  <body name="cube" pos="0 -.1 .2"><freejoint/>
    <geom name="cube" type="box" size=".05 .05 .05"/></body>
</worldbody>
<contact><exclude body1="arm" body2="ball"/><pair geom1="hand" geom2="torso" margin="0"/></contact>
</mujoco>"""


def scene() -> tuple[mujoco.MjModel, rb.Model]:
    m = mujoco.MjModel.from_xml_string(PILE)
    return m, rb.load(m)


def test_contacts_of_a_robot_are_those_of_mujoco() -> None:
    m, model = scene()
    d = mujoco.MjData(m)
    rng, count = np.random.default_rng(1), 0
    detect = jax.jit(lambda q: rb.contact.detect(model, q))
    for _ in range(40):
        d.qpos[:] = np.asarray(model.default_state().q) + 0.1 * rng.normal(size=m.nq)
        mujoco.mj_normalizeQuat(m, d.qpos)
        mujoco.mj_kinematics(m, d)
        mujoco.mj_collision(m, d)
        found = detect(jnp.asarray(d.qpos))
        ours = {}
        for i in np.flatnonzero(found.exists):
            ours.setdefault(found.geoms[i], []).append(i)
        theirs: dict = {}
        for c in d.contact:
            theirs.setdefault((int(c.geom1), int(c.geom2)), []).append(c)
        assert {k: len(x) for k, x in ours.items()} == {k: len(x) for k, x in theirs.items()}
        for pair, contacts in theirs.items():
            for i, c in zip(ours[pair], contacts, strict=True):
                np.testing.assert_allclose(found.distance[i], c.dist, atol=1e-12)
                np.testing.assert_allclose(found.position[i], c.pos, atol=1e-12)
                np.testing.assert_allclose(found.frame[i], c.frame.reshape(3, 3), atol=1e-10)
                count += 1
    assert count > 200


@pytest.mark.parametrize("name", ["humanoid", "quadruped", "gripper", "pile"])
def test_the_pairs_that_may_touch_are_those_of_mujoco(name) -> None:
    """All geoms are spheres in reach of each other, so each allowed pair is one contact."""
    text = PILE if name == "pile" else (SCENES / f"{name}.xml").read_text()
    spec = mujoco.MjSpec.from_string(text)
    for g in spec.geoms:
        g.margin = 25.0
        if name != "pile":  # the bundled scenes have no contacts
            g.contype = g.conaffinity = 1
        if g.type != mujoco.mjtGeom.mjGEOM_PLANE:
            g.type, g.size, g.fromto = mujoco.mjtGeom.mjGEOM_SPHERE, [0.1, 0, 0], [np.nan] * 6
    for pair in spec.pairs:
        pair.margin = 50.0
    m = spec.compile()
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    theirs = sorted((int(c.geom1), int(c.geom2)) for c in d.contact)
    assert theirs and sorted(contact_pairs(m)) == theirs


def test_the_distance_has_the_derivative_of_its_witness() -> None:
    """d distance / dq against central differences, and a gap that two balls keep."""
    _, model = scene()
    q = model.default_state().q + 0.01 * jnp.arange(model.nq) / model.nq
    pair = [("floor", "torso"), ("hand", "torso")]

    def gap(v: jax.Array) -> jax.Array:
        return rb.contact.detect(
            model, rb.integrate(model, q, v), pairs=pair, reach=jnp.inf
        ).distance

    J = jax.jacfwd(gap)(jnp.zeros(model.nv))
    h = 1e-6
    differences = [(gap(h * e) - gap(-h * e)) / (2 * h) for e in jnp.eye(model.nv)]
    np.testing.assert_allclose(J, jnp.stack(differences, 1), atol=1e-8)
    np.testing.assert_allclose(jax.jacrev(gap)(jnp.zeros(model.nv)), J, atol=1e-12)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_batches_and_dtypes(dtype) -> None:
    model = scene()[1].astype(dtype)
    q = jnp.stack([model.default_state().q] * 3)
    pairs = [("floor", "torso"), ("hand", "torso"), ("floor", "cube")]
    for batch in (q, q[:1], q[:0]):
        found = jax.vmap(lambda q: rb.contact.detect(model, q, pairs=pairs))(batch)
        assert found.distance.dtype == dtype and found.distance.shape[0] == len(batch)
    single = rb.contact.detect(model, q[0], pairs=pairs)
    assert single.position.dtype == single.frame.dtype == dtype
    threaded = rb.threads(lambda q: rb.contact.detect(model, q, pairs=pairs).distance)(q[0])
    np.testing.assert_allclose(threaded, single.distance, atol=20 * float(jnp.finfo(dtype).eps))


def test_a_model_without_pairs_has_no_contacts() -> None:
    body = "<body><freejoint/><geom size='1'/></body>"
    model = rb.load(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    assert rb.contact.detect(model, model.default_state().q).distance.shape == (0,)


def test_bad_input_is_named() -> None:
    model = rb.load(
        PILE.replace('type="box" size=".05 .05 .05"', 'type="ellipsoid" size=".1 .1 .1"'),
        contacts=False,
    )
    q = model.default_state().q
    with pytest.raises(rb.UnsupportedFeature, match=r"capsule and ellipsoid.*pairs="):
        rb.contact.detect(model, q)
    with pytest.raises(rb.UnknownName, match=r"flor.*floor"):  # codespell:ignore
        rb.contact.detect(model, q, pairs=[("flor", "torso")])  # codespell:ignore
    with pytest.raises(rb.InputError, match="two geoms"):
        rb.contact.detect(model, q, pairs=["floor"])
    for bad in (3, "ab", [3], [("floor",)]):
        with pytest.raises(rb.InputError, match="pairs"):
            rb.contact.detect(model, q, pairs=bad)
    with pytest.raises(rb.InputError, match="reach"):
        rb.contact.detect(model, q, pairs=[("floor", "torso")], reach=jnp.nan)
    with pytest.raises(rb.InputError, match="different geoms"):
        rb.contact.detect(model, q, pairs=[("floor", "floor")])
    with pytest.raises(rb.InputError, match="q"):
        rb.contact.detect(model, q[:3])
    with pytest.raises(rb.InputError, match="geoms"):
        rb.contact.detect(model.replace(geoms=None), q)
