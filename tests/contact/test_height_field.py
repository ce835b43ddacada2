"""Contacts of height fields: all triangles by brute force, MuJoCo's GJK, derivatives, borders."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.geometry.height_field import field_box, field_capsule, field_sphere
from rbjax.contact.geometry.shapes import Shape
from rbjax.lanes import Mat3, Vec3

ROWS, COLUMNS, HALF = 6, 9, (0.8, 0.5)
pytestmark = pytest.mark.filterwarnings("ignore:.*left out of the model.*contacts")


def heights(scale: float = 0.15) -> np.ndarray:
    h = scale * np.random.default_rng(0).uniform(size=(ROWS, COLUMNS))
    return h.astype(np.float32).astype(np.float64)


def field(h: jax.Array, R: np.ndarray | None = None, p: tuple = (0.0, 0.0, 0.0)) -> Shape:
    R = np.eye(3) if R is None else R
    return Shape(Vec3(*map(jnp.asarray, p)), Mat3(*jnp.asarray(R).reshape(9)), Vec3(*HALF, 0.1), h)


def ball(center: jax.Array, radius: float) -> Shape:
    return Shape(Vec3(*center), Mat3.identity(), Vec3(radius, 0.0, 0.0))


def triangles(h: np.ndarray) -> np.ndarray:
    """Corners (n, 3, 3) of all triangles."""
    x, y = np.linspace(-HALF[0], HALF[0], COLUMNS), np.linspace(-HALF[1], HALF[1], ROWS)
    P = np.stack([*np.meshgrid(x, y), h], -1)
    a, b, c, d = P[:-1, :-1], P[:-1, 1:], P[1:, :-1], P[1:, 1:]
    return np.concatenate([np.stack(t, -2).reshape(-1, 3, 3) for t in ((a, b, d), (a, d, c))])


def nearest(point: np.ndarray, tri: np.ndarray) -> tuple[float, np.ndarray]:
    """Distance to the nearest point of all triangles, by the regions of Ericson, 5.1.5."""
    best = (np.inf, point)
    for a, b, c in tri:
        ab, ac, ap, bp, cp = b - a, c - a, point - a, point - b, point - c
        d1, d2, d3, d4, d5, d6 = ab @ ap, ac @ ap, ab @ bp, ac @ bp, ab @ cp, ac @ cp
        va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
        if d1 <= 0 and d2 <= 0:
            q = a
        elif d3 >= 0 and d4 <= d3:
            q = b
        elif d6 >= 0 and d5 <= d6:
            q = c
        elif vc <= 0 and d1 >= 0 and d3 <= 0:
            q = a + ab * d1 / (d1 - d3)
        elif vb <= 0 and d2 >= 0 and d6 <= 0:
            q = a + ac * d2 / (d2 - d6)
        elif va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:
            q = b + (c - b) * (d4 - d3) / ((d4 - d3) + (d5 - d6))
        else:
            q = a + ab * vb / (va + vb + vc) + ac * vc / (va + vb + vc)
        best = min(best, (float(np.linalg.norm(point - q)), q), key=lambda x: x[0])
    return best


def points(count: int, seed: int = 0) -> np.ndarray:
    """Points above and below the surface, within a cell of it."""
    rng = np.random.default_rng(seed)
    p = rng.uniform([-HALF[0], -HALF[1], 0.0], [*HALF, 0.2], (count, 3))
    p[:, 2] += rng.uniform(-0.05, 0.05, count)
    return p


def test_the_nearest_point_is_that_of_all_triangles() -> None:
    h, r = heights(), 0.03
    tri, p = triangles(h), points(300)

    @jax.jit
    @jax.vmap
    def ours(c):
        (found,) = field_sphere(field(jnp.asarray(h)), ball(c, r), 1.0)
        return found.distance, found.position.array, found.normal.array, found.exists

    distance, position, normal, exists = map(np.asarray, ours(jnp.asarray(p)))
    assert exists.all() and (distance < -r).sum() > 50
    for k, c in enumerate(p):
        d, q = nearest(c, tri)
        sign = 1.0 if distance[k] > -r else -1.0
        np.testing.assert_allclose(distance[k], sign * d - r, atol=1e-12)
        np.testing.assert_allclose(normal[k], sign * (c - q) / d, atol=1e-10)
        np.testing.assert_allclose(position[k], 0.5 * (q + c - r * normal[k]), atol=1e-12)


def test_points_far_above_have_no_contact_and_a_lower_bound_of_the_distance() -> None:
    h, r, reach = jnp.asarray(heights()), 0.03, 0.01

    @jax.vmap
    @rb.threads
    def both(c):
        found = (field_sphere(field(h), ball(c, r), x)[0] for x in (reach, jnp.inf))
        return [(x.distance, x.exists) for x in found]

    p = points(300)
    (near, exists), (whole, _) = both(jnp.asarray(p))
    np.testing.assert_array_equal(exists, whole <= reach)
    searched = np.asarray(near == whole)
    assert 20 < (~searched).sum() < 200 and searched[np.asarray(exists)].all()
    assert (near <= whole).all() and (near[~searched] > reach).all()


def test_operations_of_a_sphere_and_of_a_box() -> None:
    h = jnp.asarray(heights())

    def distances(pair, c):
        return [x.distance for x in pair(field(h), ball(c, 0.05)._replace(size=Vec3(*c)), 0.01)]

    count = {
        pair: rb.compiler.explain(functools.partial(distances, pair), jnp.ones(3)).operations
        for pair in (field_sphere, field_box)
    }
    assert count[field_sphere] < 1700 and count[field_box] < 8 * 1700


def scene(h: np.ndarray, body: str) -> mujoco.MjModel:
    data = " ".join(f"{x / h.max():.9g}" for x in (h - h.min()).ravel())
    return mujoco.MjModel.from_xml_string(f"""<mujoco><asset>
      <hfield name="h" nrow="{ROWS}" ncol="{COLUMNS}" size="{HALF[0]} {HALF[1]} 0.15 1"
        elevation="{data}"/></asset>
      <worldbody><geom name="ground" type="hfield" hfield="h" euler="10 20 30" pos=".1 .2 .3"/>
      <body><freejoint/>{body}</body></worldbody></mujoco>""")


def test_spheres_above_the_surface_touch_as_in_mujoco() -> None:
    """MuJoCo has a contact for each prism in reach. The least distance is ours."""
    m = scene(heights(), '<geom name="ball" type="sphere" size=".04" margin=".02"/>')
    d, model, rng = mujoco.MjData(m), rb.load(m), np.random.default_rng(1)
    mujoco.mj_forward(m, d)
    R, o = d.geom_xmat[0].reshape(3, 3), d.geom_xpos[0]
    detect, count = jax.jit(lambda q: rb.contact.detect(model, q)), 0
    for _ in range(300):
        local = rng.uniform([-HALF[0], -HALF[1], 0.0], [*HALF, 0.2])
        d.qpos[:] = [*(o + R @ local), 1, 0, 0, 0]
        mujoco.mj_kinematics(m, d)
        mujoco.mj_collision(m, d)
        found = detect(jnp.asarray(d.qpos))
        if found.distance[0] < -0.035:  # the center is below the surface or close to it
            continue
        assert bool(found.exists[0]) == bool(len(d.contact))
        if len(d.contact):
            count += 1
            least = min(d.contact, key=lambda c: c.dist)
            np.testing.assert_allclose(found.distance[0], least.dist, atol=1e-6)
            np.testing.assert_allclose(found.position[0], least.pos, atol=1e-5)
            np.testing.assert_allclose(found.frame[0, 0], least.frame[:3], atol=1e-4)
    assert count > 30


def test_capsules_and_boxes_touch_at_their_ends_and_corners() -> None:
    h = jnp.asarray(heights())
    axis = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    shape = Shape(Vec3(0.05, -0.02, 0.2), Mat3(*axis.reshape(9)), Vec3(0.04, 0.1, 0.06))
    found = field_capsule(field(h), shape, 1.0)
    for contact, y in zip(found, (-0.12, 0.08), strict=True):
        (want,) = field_sphere(field(h), ball(jnp.array([0.05, y, 0.2]), 0.04), 1.0)
        np.testing.assert_allclose(contact.distance, want.distance, atol=1e-14)
    box = field_box(field(h), shape, 1.0)
    assert len(box) == 8
    corner = shape.p.array + axis @ np.array([0.04, 0.1, -0.06])
    (want,) = field_sphere(field(h), ball(corner, 0.0), 1.0)
    np.testing.assert_allclose(box[3].distance, want.distance, atol=1e-14)


@pytest.mark.parametrize("shape", [(2, 2), (2, 5), (3, 3), (200, 150)])
def test_small_and_large_fields(shape) -> None:
    """A plane through the field, with a program whose length does not depend on its size."""
    rows, columns = shape
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, columns), np.linspace(-0.5, 0.5, rows))
    h = jnp.asarray(0.3 + 0.5 * x - 0.25 * y)
    n = np.array([-0.5, 0.25, 1.0]) / np.sqrt(1.3125)
    c = jnp.array([0.1, 0.2, 0.303])
    f = jax.jit(lambda h, c: field_sphere(field(h), ball(c, 0.05), 1.0)[0])
    found = f(h, c)
    np.testing.assert_allclose(found.distance, n @ (c - jnp.array([0, 0, 0.3])) - 0.05, atol=1e-13)
    np.testing.assert_allclose(found.normal.array, n, atol=1e-13)
    eqns = len(jax.make_jaxpr(f)(h, c).jaxpr.eqns[0].params["jaxpr"].eqns)
    small = len(jax.make_jaxpr(f)(jnp.zeros((6, 9)), c).jaxpr.eqns[0].params["jaxpr"].eqns)
    assert eqns == small


def test_there_is_no_contact_outside_of_the_field() -> None:
    h = jnp.asarray(heights())
    for center, inside in (
        ([0.79, 0, 0.1], True), ([0.81, 0, 0.1], False), ([0, -0.49, 0.1], True),
        ([0, -0.51, 0.1], False), ([5.0, 5.0, 0.0], False), ([0, 0, -3.0], True),
    ):  # fmt: skip
        (found,) = field_sphere(field(h), ball(jnp.asarray(center), 0.1), 0.5)
        assert bool(found.exists) == inside and np.isfinite(found.distance)


def test_derivatives_by_the_point_and_by_the_heights() -> None:
    h, c = jnp.asarray(heights()), jnp.array([0.123, 0.087, 0.2])

    def outputs(h, c):
        (found,) = field_sphere(field(h), ball(c, 0.05), 1.0)
        return jnp.concatenate([found.distance[None], found.position.array, found.normal.array])

    for k in (0, 1):
        J = jax.jacfwd(outputs, k)(h, c)
        np.testing.assert_allclose(jax.jacrev(outputs, k)(h, c), J, atol=1e-12)
        assert np.abs(J[0]).max() > 0.1
        d = np.random.default_rng(k).normal(size=(h, c)[k].shape)

        def moved(e, k=k, d=d):
            return outputs(h + e * d, c) if k == 0 else outputs(h, c + e * d)

        differences = (moved(1e-6) - moved(-1e-6)) / 2e-6
        tangent = jnp.tensordot(J, d, d.ndim)
        np.testing.assert_allclose(tangent, differences, atol=1e-7)
    at_zero = jax.jacfwd(lambda c: outputs(jnp.zeros((ROWS, COLUMNS)), c))(jnp.zeros(3))
    assert np.isfinite(at_zero).all()
    np.testing.assert_allclose(at_zero[0], [0, 0, 1], atol=1e-14)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_threads_and_dtypes(dtype) -> None:
    m = scene(heights(), '<geom name="b" type="box" size=".05 .06 .07"/>')
    model = rb.load(m).astype(dtype)
    q = jnp.array([0.1, 0.2, 0.45, 0.9, 0.1, 0.3, 0.2], dtype)

    def distance(q, h):
        geoms = model.geoms.replace(heights=(h,))
        return rb.contact.detect(model.replace(geoms=geoms), q, reach=1.0).distance

    h = model.geoms.heights[0]
    found = distance(q, h)
    assert found.dtype == dtype and found.shape == (8,)
    tolerance = 40 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(rb.threads(distance)(q, h), found, atol=tolerance)
    gradient = rb.threads(jax.grad(lambda h: distance(q, h).sum()))(h)
    np.testing.assert_allclose(
        gradient, jax.grad(lambda h: distance(q, h).sum())(h), atol=tolerance
    )
    assert (gradient != 0).any()


def test_a_flat_field_acts_as_a_plane() -> None:
    """Accelerations of a ball, a capsule and a box that sink into a field of 64 x 64 equal heights,
    where MuJoCo has a contact for each prism in reach."""
    bodies = "".join(
        f'<body pos="{0.3 * k - 0.3} .01 .045"><freejoint/><geom {geom}/></body>'
        for k, geom in enumerate(
            ('size=".05"', 'type="capsule" size=".05 .1" euler="0 88 0"',
             'type="box" size=".05 .05 .05" euler="1 2 0"')
        )
    )  # fmt: skip
    field = f'<hfield name="h" nrow="64" ncol="64" size="1 1 .1 .1" elevation="{"0 " * 4096}"/>'
    found = []
    for ground in ('type="plane" size="0 0 1"', 'type="hfield" hfield="h"'):
        world = f"<worldbody><geom {ground}/>{bodies}</worldbody>"
        model = rb.load(f"<mujoco><asset>{field}</asset>{world}</mujoco>", contacts=True)
        state = model.default_state()
        v = jnp.asarray(np.random.default_rng(0).normal(size=model.nv)).at[2::6].set(-0.1)
        found.append(rb.acceleration(model, state.replace(v=v)))
    assert (np.asarray(found[0])[[2, 8, 14]] > 1).all()  # the ground pushes
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-9)
