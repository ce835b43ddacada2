"""Closed-form contacts against MuJoCo C: count, order, distance, position and normal."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rbjax.contact.geometry.narrow_phase import COUNTS, PAIRS
from rbjax.contact.geometry.shapes import Contact, Shape, contact_frame
from rbjax.lanes import Mat3, Vec3

MARGIN = 0.05
SIZES = {
    "plane": (0.0, 0.0, 1.0), "sphere": (0.11, 0.0, 0.0), "capsule": (0.07, 0.13, 0.0),
    "ellipsoid": (0.08, 0.12, 0.16), "cylinder": (0.12, 0.09, 0.0), "box": (0.09, 0.11, 0.14),
}  # fmt: skip


def scene(one: str, other: str) -> mujoco.MjModel:
    """Two free bodies with one geom each; a plane is fixed to the world."""
    spec = mujoco.MjSpec()
    for kind in (one, other):
        body = spec.worldbody if kind == "plane" else spec.worldbody.add_body()
        if kind != "plane":
            body.add_freejoint()
        size = np.asarray(SIZES[kind])
        body.add_geom(
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=size, margin=MARGIN / 2,
            quat=[0.8, 0.3, -0.4, 0.2] if kind == "plane" else [1, 0, 0, 0],
        )  # fmt: skip
    return spec.compile()


def poses(m: mujoco.MjModel, rng: np.random.Generator, count: int) -> np.ndarray:
    """Configurations near contact; a third of them have axes along the world's."""
    q = np.zeros((count, m.nq))
    for k in range(0, m.nq, 7):
        q[:, k : k + 3] = 0.16 * rng.normal(size=(count, 3))
        q[:, k + 3 : k + 7] = rng.normal(size=(count, 4))
        aligned = np.zeros((count, 4))
        aligned[np.arange(count), rng.integers(0, 4, count)] = 1.0
        q[::3, k + 3 : k + 7] = aligned[::3]
        q[:, k + 3 : k + 7] /= np.linalg.norm(q[:, k + 3 : k + 7], axis=1, keepdims=True)
    return q


def as_shape(p: jax.Array, R: jax.Array, size: jax.Array) -> Shape:
    return Shape(Vec3(*p), Mat3(*R.reshape(9)), Vec3(*size))


def arrays(pair, one: tuple, other: tuple, reach: float) -> tuple[jax.Array, ...]:
    """Distance, position, frame and existence of each candidate of a pair."""
    found: list[Contact] = pair(as_shape(*one), as_shape(*other), reach)
    frames = [jnp.stack([x.array for x in contact_frame(c.normal, c.tangent)]) for c in found]
    return (
        jnp.stack([jnp.asarray(c.distance) for c in found]),
        jnp.stack([c.position.array for c in found]),
        jnp.stack(frames),
        jnp.stack([jnp.asarray(c.exists) for c in found]),
    )


#: cylinders: test_capsule_cylinder.py and test_cylinder_pairs.py, because MuJoCo iterates
ITERATED = [("capsule", "cylinder"), ("cylinder", "cylinder"), ("cylinder", "box")]
PRIMITIVES = [k for k in PAIRS if not {"mesh", "hfield"} & {*k} and k not in ITERATED]
QUICK = [("plane", "sphere"), ("plane", "capsule"), ("sphere", "box"), ("capsule", "capsule")]
CASES = [
    *(pytest.param(kinds, 100, id="-".join(kinds)) for kinds in QUICK),
    *(pytest.param(k, 2000, marks=pytest.mark.slow, id="-".join([*k, "many"])) for k in PRIMITIVES),
]


@pytest.mark.parametrize(("kinds", "count"), CASES)
def test_contacts_are_those_of_mujoco(kinds, count) -> None:
    m = scene(*kinds)
    d = mujoco.MjData(m)
    given, want = [], []
    for q in poses(m, np.random.default_rng(count), count):
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        mujoco.mj_collision(m, d)
        given.append((d.geom_xpos.copy(), d.geom_xmat.reshape(-1, 3, 3).copy()))
        want.append([(c.dist, c.pos.copy(), c.frame.reshape(3, 3).copy()) for c in d.contact])
    p, R = (jnp.asarray(np.stack(x)) for x in zip(*given, strict=True))
    sizes = jnp.asarray(m.geom_size)

    @jax.jit
    @jax.vmap
    def ours(p, R):
        one, other = ((p[k], R[k], sizes[k]) for k in (0, 1))
        return arrays(PAIRS[kinds], one, other, MARGIN)

    distance, position, frame, exists = (np.asarray(x) for x in ours(p, R))
    assert exists.shape == (count, COUNTS[kinds])
    assert [int(x) for x in exists.sum(1)] == [len(x) for x in want]
    assert np.mean(exists.sum(1) > 0) > 0.1 and len(set(exists.sum(1))) > 1
    for k, contacts in enumerate(want):
        for i, (dist, pos, axes) in zip(np.flatnonzero(exists[k]), contacts, strict=True):
            np.testing.assert_allclose(distance[k, i], dist, atol=1e-12)
            np.testing.assert_allclose(position[k, i], pos, atol=1e-12)
            np.testing.assert_allclose(frame[k, i], axes, atol=1e-10)
