"""Contacts of a capsule and a cylinder: the nearest of many points of the axis, MuJoCo's GJK, two
contacts on a flat end, axes that enter the cylinder."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.geometry.capsule_cylinder import capsule_cylinder
from tests.contact.test_narrow_phase import MARGIN, SIZES, arrays, poses, scene
from tests.robots import load_quietly

RADIUS, HALF = SIZES["capsule"][:2]
CYLINDER = SIZES["cylinder"][:2]


@jax.jit
@jax.vmap
def ours(p: jax.Array, R: jax.Array) -> tuple[jax.Array, ...]:
    sizes = jnp.asarray([SIZES["capsule"], SIZES["cylinder"]], p.dtype)
    return arrays(capsule_cylinder, *((p[k], R[k], sizes[k]) for k in (0, 1)), MARGIN)


def placed(count: int) -> tuple:
    """Places of both shapes, and MuJoCo's contacts at the tightest tolerance."""
    m = scene("capsule", "cylinder")
    m.opt.ccd_tolerance, m.opt.ccd_iterations = 1e-10, 200
    d, p, R, want = mujoco.MjData(m), [], [], []
    for q in poses(m, np.random.default_rng(5), count):
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        mujoco.mj_collision(m, d)
        p.append(d.geom_xpos.copy())
        R.append(d.geom_xmat.reshape(2, 3, 3).copy())
        want.append([(c.dist, c.frame[:3].copy()) for c in d.contact])
    return np.stack(p), np.stack(R), want


def test_distances_are_those_of_the_nearest_point_of_the_axis() -> None:
    p, R, want = placed(600)
    distance, position, frame, exists = map(np.asarray, ours(jnp.asarray(p), jnp.asarray(R)))
    t = np.linspace(-HALF, HALF, 2001)
    outside, agreeing = 0, []
    for k in range(len(p)):
        axis = R[k, 1].T @ (p[k, 0] - p[k, 1] + np.outer(t, R[k, 0][:, 2])).T
        radial = np.maximum(np.hypot(axis[0], axis[1]) - CYLINDER[0], 0)
        gap = np.hypot(radial, np.maximum(np.abs(axis[2]) - CYLINDER[1], 0)).min()
        if gap < 1e-6:  # the axis enters the cylinder
            assert -RADIUS - 0.2 < distance[k, 0] <= -RADIUS + 1e-6
            continue
        outside += 1
        np.testing.assert_allclose(distance[k, 0], gap - RADIUS, atol=2e-6)
        if want[k] and exists[k].any():
            least, normal = min(want[k], key=lambda x: x[0])
            i = int(np.argmin(np.where(exists[k], distance[k], np.inf)))
            # the center of the ball, from the position midway between the surfaces, is on the axis
            center = position[k, i] - frame[k, i, 0] * (RADIUS + distance[k, i] / 2) - p[k, 0]
            assert np.linalg.norm(np.cross(center, R[k, 0][:, 2])) < 1e-12
            agreeing.append(
                abs(distance[k, i] - least) < 1e-6 and np.abs(frame[k, i, 0] - normal).max() < 1e-3
            )
        assert exists[k, 0] == (distance[k, 0] <= MARGIN)
    assert outside > 400 and len(agreeing) > 100
    assert np.mean(agreeing) > 0.97  # the rest are faces at which MuJoCo's search ends early


def test_a_capsule_on_the_flat_end_has_the_two_contacts_of_mujoco() -> None:
    text = """<mujoco><worldbody><geom type="cylinder" size=".1 .1"/><body pos="0 .01 {}"
      euler="{} 0 0"><freejoint/><geom type="capsule" size=".1 .15"/></body></worldbody></mujoco>"""
    for height, tilt, count in ((0.199, 90, 2), (0.199, 90.2, 2), (0.25, 0, 0), (0.349, 0, 1)):
        m = mujoco.MjModel.from_xml_string(text.format(height, tilt))
        d = mujoco.MjData(m)
        mujoco.mj_forward(m, d)
        model = load_quietly(m, contacts=True)
        assert model.dropped == ()
        found = rb.contact.detect(model, jnp.asarray(d.qpos))
        exists = np.asarray(found.exists)
        if height == 0.25:
            assert exists.sum() == d.ncon == 1  # inside: through the nearer end
            continue
        assert exists.sum() == d.ncon == count
        order = np.argsort([c.pos[1] for c in d.contact])
        mine = np.flatnonzero(exists)[np.argsort(np.asarray(found.position)[exists, 1])]
        for i, j in zip(mine, order, strict=True):
            c = d.contact[j]
            np.testing.assert_allclose(found.distance[i], c.dist, atol=2e-6)
            np.testing.assert_allclose(found.frame[i, 0], c.frame[:3], atol=5e-3)
            np.testing.assert_allclose(found.position[i], c.pos, atol=1e-3)


@pytest.mark.parametrize("dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("center", "axis", "distance", "outward"),
    [
        ((0.0, 0.0, 0.05), (1, 0, 0), -0.04 - RADIUS, (0, 0, 1)),
        ((0.0, 0.0, -0.05), (1, 0, 0), -0.04 - RADIUS, (0, 0, -1)),
        ((0.11, 0.0, 0.0), (0, 0, 1), -0.01 - RADIUS, (1, 0, 0)),
        ((0.0, 0.1, 0.0), (1, 0, 0), -0.02 - RADIUS, (0, 1, 0)),
    ],
)
def test_an_axis_that_enters_leaves_along_the_shortest_way(
    dtype, center, axis, distance, outward
) -> None:
    z = np.array(axis, float)
    x = np.array([0.0, 1.0, 0.0])
    R = jnp.asarray(np.stack([np.stack([x, np.cross(z, x), z], 1), np.eye(3)]))
    p = jnp.asarray([center, (0.0, 0.0, 0.0)])
    found = ours(p[None].astype(dtype), R[None].astype(dtype))
    np.testing.assert_allclose(found[0][0, 0], distance, atol=1e-6)
    np.testing.assert_allclose(-found[2][0, 0, 0], outward, atol=1e-6)
    assert found[3].tolist() == [[True, False]] and found[0].dtype == dtype


def test_threads() -> None:
    p, R, _ = placed(20)
    p, R = jnp.asarray(p), jnp.asarray(R)
    sizes = jnp.asarray([SIZES["capsule"], SIZES["cylinder"]])

    def distance(p, R):
        found = arrays(capsule_cylinder, *((p[k], R[k], sizes[k]) for k in (0, 1)), MARGIN)
        return jnp.where(found[3], found[0], 0.0).at[0].set(found[0][0])

    want = ours(p, R)
    want = jnp.where(want[3], want[0], 0.0).at[:, 0].set(want[0][:, 0])
    np.testing.assert_allclose(jax.vmap(rb.threads(distance))(p, R), want, atol=1e-14)
    slope = jax.vmap(rb.threads(jax.grad(lambda p, R: distance(p, R)[0])))(p, R)
    np.testing.assert_allclose(slope[:, 0], -slope[:, 1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(slope[:, 0], axis=1), 1.0, atol=1e-9)
