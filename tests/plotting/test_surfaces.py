"""Triangles of solids: enclosed volumes, normals of spheres, edges of boxes, tubes, terrain."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import rbjax as rb
from rbjax.plotting.drawing import shapes_of
from rbjax.plotting.solid_shapes import Solid, capsule, cylinder, solids, sphere
from rbjax.plotting.surfaces import Surface, surface

R, P = np.eye(3)[None], np.zeros((1, 3))
BOX = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [0.1, 0.2, 0.3]


def made(points: np.ndarray, coarse: bool = False) -> Surface:
    found = surface(Solid(points, 0, (1.0, 0.0, 0.0), 1.0), R, P, coarse=coarse)
    assert found is not None
    return found


def volume(s: Surface) -> float:
    """By the divergence theorem, positive if the triangles face outwards."""
    a, b, c = (s.points[s.triangles[:, k]] for k in range(3))
    return float(np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6)


def test_a_box_has_sharp_edges() -> None:
    box = made(BOX)
    assert len(box.triangles) == 12 and len(box.points) == 24
    assert volume(box) == pytest.approx(8 * 0.1 * 0.2 * 0.3)
    assert np.abs(box.normals).max(-1) == pytest.approx(1.0)


@pytest.mark.parametrize(("coarse", "least"), [(False, 0.95), (True, 0.6)])
def test_a_sphere_is_smooth(coarse: bool, least: float) -> None:
    ball = made(sphere(0.5), coarse)
    assert least < volume(ball) / (4 / 3 * np.pi * 0.5**3) < 1  # inscribed
    radial = ball.points / np.linalg.norm(ball.points, axis=-1, keepdims=True)
    assert (ball.normals * radial).sum(-1).min() > (0.99 if not coarse else 0.95)
    if coarse:
        assert len(ball.points) <= 26


@pytest.mark.parametrize("coarse", [False, True])
def test_a_cylinder_has_flat_ends_and_a_smooth_side(coarse: bool) -> None:
    pipe = made(cylinder(0.1, 0.5), coarse)
    along = np.abs(pipe.normals[:, 2])
    assert ((along < 1e-6) | (along > 1 - 1e-6)).all()
    side = along < 0.5
    radial = pipe.points[side, :2] / np.linalg.norm(pipe.points[side, :2], axis=-1, keepdims=True)
    assert (pipe.normals[side, :2] * radial).sum(-1).min() > 0.9


def test_a_segment_belongs_to_two_bodies() -> None:
    """A tube between two turned frames: each end in its frame, normals too."""
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    rotations, places = np.stack([np.eye(3), turn]), np.array([[0.0, 0, 0], [0, 0, 1.0]])
    ring = cylinder(0.1, 0.0)[:24]
    both = np.concatenate([ring, ring @ turn])  # the second ring in its own frame
    tube = surface(Solid(both, 0, (1.0, 0, 0), 1.0, 1), rotations, places)
    assert tube is not None and {*tube.bodies} == {0, 1}
    placed = places[tube.bodies] + np.einsum("nij,nj->ni", rotations[tube.bodies], tube.points)
    normals = np.einsum("nij,nj->ni", rotations[tube.bodies], tube.normals)
    side = np.abs(normals[:, 2]) < 0.5
    np.testing.assert_allclose(normals[side, :2], placed[side, :2] / 0.1, atol=1e-3)


def test_a_flat_solid_has_no_surface() -> None:
    flat = Solid(BOX * [1, 1, 0], 0, (1.0, 0, 0), 1.0)
    assert surface(flat, R, P) is None


def test_a_capsule_of_a_file_and_of_a_model() -> None:
    own, again = solids("pendulum"), solids(rb.load("pendulum"))
    assert len(own) == len(again) > 0
    for a, b in zip(own, again, strict=True):
        np.testing.assert_allclose(a.points, b.points, atol=1e-12)
    made(capsule(np.zeros(3), np.ones(3), 0.1))


TERRAIN = """<mujoco><asset><hfield name="h" nrow="3" ncol="4" size="1.5 1 0.6 0.1"
  elevation="0 0 0 0  0 1 0.5 0  0 0 0 0"/></asset>
  <worldbody><geom type="hfield" hfield="h" pos="0 0 0.2"/>
  <body pos="0 0 2"><freejoint/><geom type="sphere" size="0.1" mass="1"/></body></worldbody>
</mujoco>"""


def test_terrain_is_drawn() -> None:
    """Rows along y, columns along x, elevation times 0.6 m; all triangles face up."""
    field = next(s for s in solids(TERRAIN) if s.body < 0)
    assert field.points.shape == (12, 3) and field.triangles is not None
    np.testing.assert_allclose(field.points[5], [-0.5, 0, 0.8])
    np.testing.assert_allclose(field.points[6], [0.5, 0, 0.5])
    found = surface(field, R, P)
    assert found is not None and len(found.triangles) == 12 and (found.normals[:, 2] > 0).all()
    import matplotlib.figure

    model = rb.load(TERRAIN)
    ax = matplotlib.figure.Figure(figsize=(4, 3)).add_subplot()
    rb.plotting.draw(model, model.default_state(), ax=ax, source=TERRAIN)
    ax.figure.canvas.draw()


def test_hidden_geoms_stand_in_for_meshes() -> None:
    """A model has no visual meshes: a body with nothing else is drawn by its collision geoms."""
    xml = """<mujoco><worldbody><body><joint/><geom size="0.1" group="3"/></body>
      <body><joint/><geom size="0.1" group="3"/><geom size="0.2" group="1" mass="0"/></body>
      </worldbody></mujoco>"""
    assert [s.body for s in solids(xml)] == [1]
    assert sorted(s.body for s in solids(rb.load(xml))) == [0, 1]


def corner(n: int) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """A prism of height 1 over a corner of three unit squares, n squares to a unit."""
    grid = [(i, j) for i in range(2 * n) for j in range(2 * n) if i < n or j < n]
    inside, faces, at = {*grid}, [], {}

    def vertex(*x: int) -> int:
        return at.setdefault(x, len(at))

    for i, j in grid:
        for k in (0, n):
            around = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
            quad = [vertex(*x, k) for x in around][:: 1 if k else -1]
            faces += [(quad[0], quad[1], quad[2]), (quad[0], quad[2], quad[3])]
        for (di, dj), (a, b) in {
            (-1, 0): ((0, 1), (0, 0)), (1, 0): ((1, 0), (1, 1)),
            (0, -1): ((0, 0), (1, 0)), (0, 1): ((1, 1), (0, 1)),
        }.items():  # fmt: skip
            if (i + di, j + dj) not in inside:
                for k in range(n):
                    low, high = (vertex(i + a[0], j + a[1], k + x) for x in (0, 1))
                    low2, high2 = (vertex(i + b[0], j + b[1], k + x) for x in (0, 1))
                    faces += [(low, low2, high2), (low, high2, high)]
    return np.array([*at], float) / n, faces


@pytest.mark.parametrize(("n", "tolerance"), [(1, 1e-6), (24, 0.05)])
def test_a_mesh_is_not_its_hull(n: int, tolerance: float) -> None:
    """The volume of the prism is 3, of its hull 3.5; with many triangles, vertices are merged."""
    points, faces = corner(n)
    numbers = " ".join(f"{x:g}" for x in points.ravel()), " ".join(str(k) for f in faces for k in f)
    xml = f"""<mujoco><asset><mesh name="m" vertex="{numbers[0]}" face="{numbers[1]}"/></asset>
      <worldbody><body><joint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
    (solid,) = solids(xml)
    fine, hull = surface(solid, R, P), surface(solid, R, P, coarse=True)
    assert fine is not None and hull is not None
    assert len(fine.triangles) == len(faces) if n == 1 else len(fine.triangles) <= 4000 < len(faces)
    assert volume(fine) == pytest.approx(3.0, rel=tolerance)
    assert 1.05 * 3.0 < volume(hull) < 3.5 + 1e-6


def test_a_urdf_is_drawn_by_its_collision_shapes() -> None:
    urdf = """<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="1"/>
      <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry>
      <box size="0.1 0.2 0.3"/></geometry></collision></link><joint name="j" type="revolute">
      <parent link="base"/><child link="arm"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
      </joint></robot>"""
    with warnings.catch_warnings(action="ignore"):
        model = rb.load(urdf)
    with warnings.catch_warnings(action="error"):
        (box,) = shapes_of(model, urdf)
    np.testing.assert_allclose(np.ptp(box.points, axis=0), [0.1, 0.2, 0.3])
