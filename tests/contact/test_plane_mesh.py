"""Contacts of planes and convex hulls of meshes against MuJoCo C."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.model.hulls import Hull
from tests.tolerances import F64_PARITY, relative_error

MARGIN = 0.04
pytestmark = pytest.mark.filterwarnings("ignore:.*left out of the model.*contacts")


def points(name: str) -> np.ndarray:
    rng = np.random.default_rng(0)
    if name == "random":
        return rng.normal(size=(60, 3)) * [0.1, 0.15, 0.2]
    if name == "box":
        return np.array([[x, y, z] for x in (0, 0.1) for y in (0, 0.2) for z in (0, 0.3)])
    if name == "tetrahedron":
        return rng.normal(size=(4, 3)) * 0.2
    angle = np.sort(rng.uniform(0, 2 * np.pi, 7))
    rim = np.stack([0.2 * np.cos(angle), 0.15 * np.sin(angle)], 1)
    return np.concatenate([np.column_stack([rim, np.full(7, z)]) for z in (-0.1, 0.1)])


def scene(name: str) -> mujoco.MjModel:
    """A tilted plane and a free mesh."""
    spec = mujoco.MjSpec()
    spec.add_mesh(name="mesh").uservert = points(name).ravel()
    kinds = mujoco.mjtGeom
    spec.worldbody.add_geom(
        name="floor",
        type=kinds.mjGEOM_PLANE,
        size=[0, 0, 1],
        margin=MARGIN,
        quat=[0.9, 0.2, 0.1, 0],
    )
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.add_geom(name="stone", type=kinds.mjGEOM_MESH, meshname="mesh")
    return spec.compile()


def run(name: str, count: int) -> tuple:
    """Our contacts and MuJoCo's in random poses."""
    m = scene(name)
    model, d, rng = rb.load(m), mujoco.MjData(m), np.random.default_rng(count)
    q = 0.12 * rng.normal(size=(count, 7))
    q[:, 3:] = rng.normal(size=(count, 4))
    q[:, 3:] /= np.linalg.norm(q[:, 3:], axis=1, keepdims=True)
    want = []
    for row in q:
        d.qpos[:] = row
        mujoco.mj_kinematics(m, d)
        mujoco.mj_collision(m, d)
        want.append([(c.dist, c.pos.copy(), c.frame.reshape(3, 3).copy()) for c in d.contact])
    found = jax.jit(jax.vmap(lambda q: rb.contact.detect(model, q)))(jnp.asarray(q))
    return found, want


@pytest.mark.parametrize("name", ["random", "box", "tetrahedron"])
def test_contacts_are_those_of_mujoco(name) -> None:
    found, want = run(name, 1000)
    exists = np.asarray(found.exists)
    assert [int(x) for x in exists.sum(1)] == [len(x) for x in want]
    assert np.mean(exists.sum(1) > 0) > 0.3 and len(set(exists.sum(1))) > 2
    for k, contacts in enumerate(want):
        for i, (dist, pos, frame) in zip(np.flatnonzero(exists[k]), contacts, strict=True):
            np.testing.assert_allclose(found.distance[k, i], dist, atol=1e-12)
            np.testing.assert_allclose(found.position[k, i], pos, atol=1e-12)
            np.testing.assert_allclose(found.frame[k, i], frame, atol=1e-12)


def test_a_face_of_many_corners_has_the_deepest_one() -> None:
    """Faces of seven corners: the deepest contact is equal, most of the others are too."""
    found, want = run("prism", 1000)
    exists, same = np.asarray(found.exists), []
    for k, contacts in enumerate(want):
        assert exists[k].any() == bool(contacts)
        if contacts:
            np.testing.assert_allclose(found.distance[k, 0], contacts[0][0], atol=1e-12)
            np.testing.assert_allclose(found.position[k, 0], contacts[0][1], atol=1e-12)
            ours = np.asarray(found.distance[k])[exists[k]]
            theirs = [c[0] for c in contacts]
            same.append(len(ours) == len(theirs) and np.allclose(ours, theirs, atol=1e-12))
    assert len(same) > 300 and np.mean(same) > 0.9


def test_a_hull_is_kept_if_its_mesh_may_touch_a_plane() -> None:
    m = scene("box")
    geoms = rb.load(m).geoms
    assert geoms.hulls[0] is None and geoms.hulls[1].vertices.shape == (8, 3)
    assert isinstance(hash(geoms.hulls[1]), int) and geoms.hulls[1] == rb.load(m).geoms.hulls[1]
    m.geom_contype[:] = 0
    m.geom_conaffinity[:] = 0
    model = rb.load(m)
    assert model.geoms.hulls == (None, None)
    with pytest.raises(rb.UnsupportedFeature, match="plane and mesh"):
        rb.contact.detect(model, model.default_state().q, pairs=[("floor", "stone")])


def test_the_contact_problem_takes_meshes() -> None:
    """The acceleration of a box mesh on the plane is MuJoCo's."""
    m = scene("box")
    m.opt.tolerance, m.opt.iterations = 0.0, 200
    model, d = rb.load(m, contacts=True), mujoco.MjData(m)
    d.qpos[2] = 0.4
    for _ in range(400):
        mujoco.mj_step(m, d)
        if d.ncon > 1:
            break
    mujoco.mj_forward(m, d)
    assert d.ncon > 1
    state = rb.State(jnp.asarray(d.qpos), jnp.asarray(d.qvel))
    assert relative_error(rb.acceleration(model, state), d.qacc, floor=1.0) < F64_PARITY


def test_corners_of_a_face_with_many_corners_are_spread() -> None:
    """A rectangle with a slight corner in each side keeps its own corners."""
    sides = [(0, 0), (1, -0.01), (2, 0), (2.01, 0.5), (2, 1), (1, 1.01), (0, 1), (-0.01, 0.5)]
    face = np.array([(*p, 0.0) for p in sides])
    up = np.array([[0.0, 0.0, 1.0]])
    hull = Hull.from_faces(face, [list(range(8))], up)
    assert hull.corners[0, 0].tolist() == [0, 2, 4, 6]
    assert hull.corners[4, 0].tolist() == [4, 6, 0, 2]
    square = Hull.from_faces(face[::2], [[0, 1, 2, 3]], up)
    assert square.corners[2, 0].tolist() == [2, 3, 0, 1]
    assert square.radius == pytest.approx(np.sqrt(5))
    triangle = Hull.from_faces(face[:3], [[0, 1, 2]], up)
    assert triangle.corners[1, 0].tolist() == [1, 2, 0, -1]


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_dtypes_and_threads(dtype) -> None:
    model = rb.load(scene("random")).astype(dtype)
    q = jnp.asarray([0.01, 0.02, 0.1, 0.8, 0.4, 0.2, -0.4], dtype)
    found = rb.contact.detect(model, q, reach=1.0)
    threaded = rb.threads(lambda q: rb.contact.detect(model, q, reach=1.0).distance)(q)
    assert found.distance.dtype == dtype
    np.testing.assert_allclose(threaded, found.distance, atol=20 * float(jnp.finfo(dtype).eps))
