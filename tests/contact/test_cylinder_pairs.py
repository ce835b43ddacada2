"""Contacts of a cylinder with a cylinder or a box: the least overlap over many directions, MuJoCo's
GJK and EPA, contacts of flat ends, sides and edges, kernels."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.geometry.narrow_phase import PAIRS
from rbjax.lanes import quaternion_matrix
from tests.contact.test_narrow_phase import SIZES, arrays, poses, scene
from tests.robots import load_quietly

KINDS = ("cylinder", "box")
REACH = 0.05
#: poses of a call
BATCH = 100
#: distance and normal, of distance, position and normal
CERTAIN = np.array([0, 4, 5, 6])


@functools.cache
def program(kind: str):
    """Distance, position, normal and existence of the contacts of a cylinder with a shape."""

    def one(p, R, sizes, reach):
        pair = PAIRS["cylinder", kind]
        distance, position, frame, exists = arrays(
            pair, *((p[k], R[k], sizes[k]) for k in (0, 1)), reach
        )
        return distance, position, frame[:, 0], exists

    return jax.jit(jax.vmap(rb.threads(one), (0, 0, 0, None)))


def ours(kind: str, p, R, dtype=jnp.float64, reach=REACH, sizes=None) -> list[np.ndarray]:
    sizes = np.array([SIZES["cylinder"], SIZES[kind]]) if sizes is None else np.asarray(sizes)
    n, pad = len(p), np.arange(BATCH) % len(p)  # one program for all tests
    sizes = jnp.asarray(np.broadcast_to(sizes, (n, 2, 3))[pad], dtype)
    p, R = jnp.asarray(np.asarray(p)[pad], dtype), jnp.asarray(np.asarray(R)[pad], dtype)
    found = program(kind)(p, R, sizes, jnp.asarray(reach, dtype))
    return [np.asarray(x)[:n] for x in found]


def support(kind: str, R: np.ndarray, size: np.ndarray, n: np.ndarray) -> np.ndarray:
    """The greatest n . x of a shape about its center, for directions n (k, 3)."""
    m = n @ R
    if kind == "box":
        return np.abs(m) @ size
    return np.abs(m[:, 2]) * size[1] + size[0] * np.hypot(m[:, 0], m[:, 1])


def greatest(separation, directions: np.ndarray, rng: np.random.Generator) -> float:
    """Maximize over the sphere: the best samples, then random steps that become shorter."""
    value = separation(directions)
    best = -np.inf
    for start in np.argsort(value)[::-1][[0, 3, 10]]:
        n, top, width = directions[start], value[start], 0.05
        for _ in range(50):
            tried = n + width * rng.normal(size=(60, 3))
            tried /= np.linalg.norm(tried, axis=1, keepdims=True)
            found = separation(tried)
            k = found.argmax()
            n, top = (tried[k], found[k]) if found[k] > top else (n, top)
            width *= 1.0 if found[k] >= top else 0.6
        best = max(best, top)
    return best


def at_depth(kind: str, count: int, depth: np.ndarray, seed: int = 3) -> tuple:
    """Poses (count, 2) of both shapes with a given distance; a third have parallel axes."""
    m = scene("cylinder", kind)
    d, p, R = mujoco.MjData(m), [], []
    for q in poses(m, np.random.default_rng(seed), count):
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        p.append(d.geom_xpos.copy())
        R.append(d.geom_xmat.reshape(2, 3, 3).copy())
    p, R = np.stack(p), np.stack(R)
    across = (p[:, 1] - p[:, 0]) / np.linalg.norm(p[:, 1] - p[:, 0], axis=1, keepdims=True)
    low, high = np.zeros(count), np.ones(count)
    for _ in range(50):
        middle = 0.5 * (low + high)
        p[:, 1] = p[:, 0] + across * middle[:, None]
        below = ours(kind, p, R, reach=np.inf)[0][:, 0] < depth
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return p, R


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_distance_is_the_greatest_separation(kind) -> None:
    rng = np.random.default_rng(0)
    count = 40
    sizes = rng.uniform(0.05, 0.3, (count, 2, 3))
    m = scene("cylinder", kind)
    q = poses(m, rng, count)
    d, p, R = mujoco.MjData(m), [], []
    for row in q:
        d.qpos[:] = row
        mujoco.mj_kinematics(m, d)
        p.append(d.geom_xpos.copy())
        R.append(d.geom_xmat.reshape(2, 3, 3).copy())
    p, R = np.stack(p), np.stack(R)
    distance, _, normal, exists = ours(kind, p, R, reach=np.inf, sizes=sizes)
    assert exists[:, 0].all() and np.isfinite(distance).all()
    sphere = rng.normal(size=(4000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    for k in range(count):

        def separation(n: np.ndarray, k: int = k) -> np.ndarray:
            both = support("cylinder", R[k, 0], sizes[k, 0], n)
            both = both + support(kind, R[k, 1], sizes[k, 1], n)
            return np.abs(n @ (p[k, 1] - p[k, 0])) - both

        assert distance[k, 0] >= greatest(separation, sphere, rng) - 1e-9
        np.testing.assert_allclose(distance[k, 0], separation(normal[k, :1])[0], atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(normal[k], axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_mujoco_has_no_direction_of_less_overlap(kind) -> None:
    """MuJoCo's direction is the same in most poses; in the rest its overlap is larger."""
    count = 100
    depth = np.random.default_rng(1).uniform(-5e-3, -1e-4, count)
    p, R = at_depth(kind, count, depth)
    distance, _, normal, exists = ours(kind, p, R, reach=0.0)
    assert exists[:, 0].all()
    m = scene("cylinder", kind)
    m.geom_margin[:] = 0
    m.opt.ccd_tolerance, m.opt.ccd_iterations = 1e-10, 200
    d, agree = mujoco.MjData(m), []
    for k in range(count):
        for i in (0, 1):
            d.qpos[7 * i : 7 * i + 3] = p[k, i]
            mujoco.mju_mat2Quat(d.qpos[7 * i + 3 : 7 * i + 7], R[k, i].ravel())
        mujoco.mj_kinematics(m, d)
        mujoco.mj_collision(m, d)
        assert d.ncon
        theirs = min(d.contact, key=lambda c: c.dist)
        n = theirs.frame[None, :3]
        both = support("cylinder", R[k, 0], m.geom_size[0], n)
        both = both + support(kind, R[k, 1], m.geom_size[1], n)
        assert n[0] @ (p[k, 1] - p[k, 0]) - both[0] <= distance[k, 0] + 1e-9
        agree.append(np.linalg.norm(n[0] - normal[k, 0]) < 1e-3)
        if agree[-1]:
            np.testing.assert_allclose(theirs.dist, distance[k, 0], atol=1e-5)
    assert np.mean(agree) > 0.7


def turned(axis, angle: float) -> np.ndarray:
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], float)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


#: kind, position and rotation of the second shape, distances, and the points across the normal
#: of a cylinder of radius 0.12 and half length 0.09, a box of half sides 0.09, 0.11, 0.14
SCENES = {
    "flat end on a face": ("box", (0, 0, 0.229), np.eye(3), [-0.001] * 4, None),
    "flat end over a corner": ("box", (0.1, 0.1, 0.229), np.eye(3), [-0.001] * 3, None),
    "two flat ends": ("cylinder", (0.05, 0, 0.179), np.eye(3), [-0.001] * 4, None),
    "flat ends that share a sliver": ("cylinder", (0.23, 0, 0.179), np.eye(3), [-0.001] * 4, None),
    "parallel sides": ("cylinder", (0.239, 0, 0.1), np.eye(3), [-0.001] * 2,
                       [(0.1195, 0, 0.01), (0.1195, 0, 0.09)]),
    "sides that cross": ("cylinder", (0.239, 0, 0.02), turned((1, 0, 0), 0.5), [-0.001],
                         [(0.1195, 0, 0.02)]),
    "side on a face": ("box", (0.209, 0, 0.1), np.eye(3), [-0.001] * 2,
                       [(0.1195, 0, -0.04), (0.1195, 0, 0.09)]),
    "edge across a side": ("box", (0.12 + np.hypot(0.09, 0.14) - 0.001, 0, 0),
                           turned((0, 1, 0), np.arctan2(0.14, 0.09)), [-0.001],
                           [(0.1195, 0, 0)]),
    "corner on a flat end": ("box", (0, 0, 0.09 + np.sqrt(0.09**2 + 0.11**2 + 0.14**2) - 0.001),
                             None, [-0.001], [(0, 0, 0.0895)]),
    "side over the rim of a flat end": ("cylinder", (0, 0.17, 0.209), turned((1, 0, 0), np.pi / 2),
                                        [-0.001] * 2, None),
}  # fmt: skip


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", SCENES)
def test_contacts_of_faces_lines_and_corners(name, dtype) -> None:
    kind, p, R, distances, points = SCENES[name]
    if R is None:  # the diagonal of the box along z
        x = np.array([0.09, 0.11, 0.14]) / np.sqrt(0.09**2 + 0.11**2 + 0.14**2)
        v = np.cross(x, (0, 0, 1.0))
        R = turned(v / np.linalg.norm(v), np.arccos(x[2]))
    tolerance = 1e-5 if dtype == jnp.float32 else 1e-9
    places, axes = np.array([[(0, 0, 0), p]], float), np.stack([np.eye(3), R])[None]
    distance, position, normal, exists = (x[0] for x in ours(kind, places, axes, dtype, 0.0))
    assert distance.dtype == dtype and np.isfinite(position).all() and np.isfinite(normal).all()
    assert exists.sum() == len(distances), (distance, exists, position)
    np.testing.assert_allclose(distance[exists], distances, atol=tolerance)
    if points is not None:
        found = position[exists]
        order = np.lexsort(found.round(4).T)
        wanted = np.array(points)
        want = wanted[np.lexsort(wanted.round(4).T)]
        np.testing.assert_allclose(found[order], want, atol=1e4 * tolerance)
    # every contact is in both shapes, to half of the overlap
    for x in position[exists]:
        assert np.hypot(x[0], x[1]) < 0.12 + 1e-3 and abs(x[2]) < 0.09 + 1e-3
        y = R.T @ (x - p)
        if kind == "box":
            assert (np.abs(y) < np.array(SIZES["box"]) + 1e-3).all()
        else:
            assert np.hypot(y[0], y[1]) < 0.12 + 1e-3 and abs(y[2]) < 0.09 + 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_coincident_centers_and_far_shapes_are_finite(kind) -> None:
    p = np.array([[(0, 0, 0), (0, 0, 0)], [(0, 0, 0), (0, 0, 9)]], float)
    R = np.broadcast_to(np.eye(3), (2, 2, 3, 3))
    for dtype in (jnp.float32, jnp.float64):
        distance, position, normal, exists = ours(kind, p, R, dtype)
        assert all(np.isfinite(x).all() for x in (distance, position, normal))
        assert exists[0, 0] and not exists[1].any() and (distance[1] > 8).all()


@pytest.mark.parametrize("kind", KINDS)
def test_threads(kind) -> None:
    p, R = (jnp.asarray(x) for x in at_depth(kind, 12, np.full(12, -1e-3)))
    sizes = jnp.asarray([SIZES["cylinder"], SIZES[kind]])

    def deepest(p, R):
        pair = PAIRS["cylinder", kind]
        return arrays(pair, *((p[k], R[k], sizes[k]) for k in (0, 1)), 0.0)[0][0]

    np.testing.assert_allclose(jax.vmap(rb.threads(deepest))(p, R), -1e-3, atol=1e-9)
    slope = jax.vmap(rb.threads(jax.grad(deepest)))(p, R)
    np.testing.assert_allclose(slope[:, 0], -slope[:, 1], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(slope[:, 0], axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_derivatives(kind, dtype) -> None:
    """Differences at generic poses; finite values where axes are parallel or centers coincide."""
    sizes = jnp.asarray([SIZES["cylinder"], SIZES[kind]], dtype)

    def first(p, R, x):
        moved = [(p[k] + x[k, 3:], rotation(x[k, :3]) @ R[k], sizes[k]) for k in (0, 1)]
        distance, position, frame, _ = arrays(PAIRS["cylinder", kind], *moved, 1.0)
        return jnp.concatenate([distance[:1], position[0], frame[0, 0]])

    def rotation(x):
        return jnp.stack(list(quaternion_matrix(1.0, *(x / 2)))).reshape(3, 3)

    def both(p, R, x, dx):
        value, slope = jax.jvp(lambda x: first(p, R, x), (x,), (dx,))
        return value, slope, jax.grad(lambda x: first(p, R, x)[CERTAIN].sum())(x)

    f = jax.jit(jax.vmap(rb.threads(both)))
    p, R = at_depth(kind, 30, np.full(30, -1e-3))
    p[-4:] = np.array([[(0, 0, 0)] * 2, [(0, 0, 0), (0, 0, 0.18)], [(0, 0, 0), (0.24, 0, 0)],
                       [(0, 0, 0), (0.21, 0, 0.23)]])  # fmt: skip
    R[-4:] = np.eye(3)
    p, R = jnp.asarray(p, dtype), jnp.asarray(R, dtype)
    dx = jnp.asarray(np.random.default_rng(0).normal(size=(30, 2, 6)), dtype)
    value, slope, reverse = f(p, R, 0 * dx, dx)
    assert value.dtype == dtype
    assert all(np.isfinite(x).all() for x in (value, slope, reverse))
    # of the distance and the normal; the point of a contact may be one of several at one place
    np.testing.assert_allclose(
        (reverse * dx).sum((1, 2)),
        slope[:, CERTAIN].sum(1),
        atol=1e-8 if dtype == jnp.float64 else 0.05,
    )
    if dtype == jnp.float64:
        there, back = (f(p, R, h * dx, dx)[0] for h in (1e-6, -1e-6))
        error = np.abs((there - back) / 2e-6 - slope)[:26]
        assert (error[np.arange(26) % 3 > 0] < 1e-5).all()  # axes that are not parallel


def test_a_cylinder_rests_on_a_box() -> None:
    text = """<mujoco><worldbody><geom type="box" size=".3 .3 .05"/>
    <body pos="0 0 .149"><freejoint/><geom type="cylinder" size=".06 .1" mass="1"/></body>
    </worldbody></mujoco>"""
    model = load_quietly(text)
    assert model.dropped == ()
    m = mujoco.MjModel.from_xml_string(text)
    m.opt.tolerance = 0
    d = mujoco.MjData(m)
    state = model.default_state()
    np.testing.assert_allclose(rb.acceleration(model, state)[:2], 0, atol=1e-9)
    end = rb.rollout(model, state, steps=400, dt=0.002).q[-1]
    mujoco.mj_step(m, d, 400)
    np.testing.assert_allclose(end[2], d.qpos[2], atol=2e-5)
    np.testing.assert_allclose(end[3:7], [1, 0, 0, 0], atol=1e-6)
