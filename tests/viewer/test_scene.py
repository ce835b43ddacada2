"""Nodes and controls of a viewer on a server without a network, against forward kinematics."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.plotting.contact_arrows import with_arrows
from rbjax.plotting.film import film, frames
from rbjax.viewer.controls import JointSliders, MotionControls, ranges
from rbjax.viewer.scene import FilmScene
from tests.plotting.test_contact_arrows import BALL, forces
from tests.viewer.false_server import FalseServer

ARM = """<mujoco><compiler angle="radian"/><worldbody>
  <geom type="box" size="0.1 0.1 0.1" pos="2 0 0"/>
  <body name="upper"><joint name="shoulder" axis="0 1 0" range="-1 2" limited="true"/>
  <geom type="capsule" fromto="0 0 0 1 0 0" size="0.05"/><geom size="0.08"/>
  <body name="lower" pos="1 0 0"><joint name="elbow" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 1 0 0" size="0.05" rgba="1 0 0 0.5"/></body></body></worldbody>
  <keyframe><key name="bent" qpos="0.5 -1"/></keyframe></mujoco>"""


@pytest.fixture(scope="module")
def arms() -> tuple[rb.Model, rb.Trajectory]:
    model = rb.load(ARM)
    speeds = jnp.array([[1.0, -0.5], [0.2, 0.1], [-0.3, 2.0]])
    ts = jnp.linspace(0, 1, 11)
    q = speeds[:, None] * ts[:, None]
    return model, rb.Trajectory(
        ts, q, jnp.broadcast_to(speeds[:, None], q.shape), jnp.ones(3, bool)
    )


def scene_of(arms, samples: int = 3) -> tuple[FalseServer, FilmScene]:
    model, run = arms
    ts, q = frames(model, run, 10.0, 1.0, samples)
    server = FalseServer()
    return server, FilmScene(server, film(model, ts, q, rb.plotting.solids(ARM)))


def test_bodies_are_where_kinematics_has_them(arms) -> None:
    model, run = arms
    server, scene = scene_of(arms)
    for at in (0.0, 4.0, 7.5, 10.0):
        scene.show(at)
        for sample in range(3):
            speed = run.v[sample, 0]
            expected = rb.forward_kinematics(model, speed * at / 10)
            for body in range(2):
                if sample == 0:
                    node = server.nodes[f"/robot/{body}"]
                    place, turn = node.position, node.wxyz
                else:
                    node = next(node for b, node in scene.ghosts if b == body)
                    place = node.batched_positions[sample - 1]
                    turn = node.batched_wxyzs[sample - 1]
                # between frames points move on chords of arcs of 0.1 rad: 0.1^2 / 8
                tolerance = 1e-6 if at == int(at) else 3e-3
                np.testing.assert_allclose(place, expected.p[body], atol=tolerance)
                R = rb.rotations.quaternion.to_matrix(np.asarray(turn, float))
                np.testing.assert_allclose(R, expected.R[body], atol=tolerance)


def test_solids_are_merged_by_body_and_color(arms) -> None:
    server, scene = scene_of(arms)
    meshes = [name for name, node in server.nodes.items() if hasattr(node, "faces")]
    assert sum(name.startswith("/world") for name in meshes) == 1
    assert sum(name.startswith("/robot/0/") for name in meshes) == 1  # capsule and sphere
    (red,) = (server.nodes[name] for name in meshes if name.startswith("/robot/1/"))
    assert red.color == (255, 0, 0) and red.opacity == 0.5
    assert len(scene.ghosts) == 2


def test_ghosts_spread_on_a_grid_about_the_robot(arms) -> None:
    _, scene = scene_of(arms)
    scene.spread = 2.0
    offsets = scene._offsets(9)
    assert not offsets[0].any() and len(np.unique(offsets, axis=0)) == 9
    assert {*offsets.ravel()} == {-2.0, 0.0, 2.0}
    assert len(scene._offsets(1)) == 1 and len(scene._offsets(1000)) == 1000


def test_a_reset_is_not_a_motion() -> None:
    """A jump farther than half of the picture shows the earlier frame until the next."""
    ball = rb.load(BALL)
    q = jnp.tile(ball.default_state().q, (3, 1)).at[:, 0].set(jnp.array([0.0, 0.01, 9.0]))
    server = FalseServer()
    scene = FilmScene(
        server, film(ball, np.arange(3.0), np.asarray(q)[None], rb.plotting.solids(BALL))
    )
    scene.size = 1.0
    seen = []
    for at in (0.5, 1.5, 2.0):
        scene.show(at)
        seen.append(float(server.nodes["/robot/0"].position[0]))
    np.testing.assert_allclose(seen, [0.005, 0.01, 9.0], atol=1e-6)


def test_arrows_of_contacts() -> None:
    model = rb.load(BALL)
    q = np.tile(model.default_state().q, (1, 3, 1))
    shown = film(model, np.arange(3.0), q, rb.plotting.solids(BALL))
    contacts = jax.tree.map(
        lambda a, b: jnp.stack([a, b, a]), forces(9.81, 4.0), forces(0.0, 0.0)
    )  # fmt: skip
    shown = with_arrows("view", shown, model, contacts, np.arange(3.0))
    server = FalseServer()
    scene, node = FilmScene(server, shown), server.nodes["/forces"]
    assert node.visible and node.points.shape == (2, 2, 3)
    scene.show(1.0)
    assert not node.visible
    scene.forces_shown = False
    scene.show(2.0)
    assert not node.visible


def test_controls_of_a_motion(arms) -> None:
    server, scene = scene_of(arms)
    camera = SimpleNamespace(position=np.zeros(3))
    server.clients[0] = SimpleNamespace(camera=camera)
    controls = MotionControls(server, scene, 10.0)
    controls.tick(0.0)
    controls.tick(0.3)
    assert controls.slider.value == pytest.approx(0.3)
    controls.speed.value = "2"
    controls.tick(0.1)
    assert controls.slider.value == pytest.approx(0.5)
    assert not camera.position.any()
    controls.play.click()
    controls.tick(1.0)
    assert controls.slider.value == pytest.approx(0.5) and controls.play.label == "play"
    controls.follow.value, controls.slider.value = True, 0.8  # the user moves the slider
    controls.tick(1.0)
    assert controls.time == 0.8 and not controls.playing
    np.testing.assert_allclose(camera.position, scene.middle(8.0) - scene.middle(5.0), atol=1e-6)
    controls.play.click()
    controls.tick(0.2)
    assert controls.slider.value == 1.0
    controls.tick(1.0)  # after a rest, from the start
    assert controls.slider.value == 0.0
    controls.spread.value, controls.ghosts.value = 1.0, False
    controls.tick(0.1)
    assert scene.spread == 2 * scene.size and not any(node.visible for _, node in scene.ghosts)


def test_sliders_of_joints(arms) -> None:
    model, _ = arms
    server, shapes = FalseServer(), rb.plotting.solids(ARM)
    scene = FilmScene(server, film(model, np.zeros(1), np.zeros((1, 1, 2)), shapes))
    controls = JointSliders(server, scene, model)
    assert [s.label for s in controls.sliders] == ["shoulder", "elbow"]
    assert (controls.sliders[0].min, controls.sliders[0].max) == (-1.0, 2.0)

    def check(q) -> None:
        controls.tick(0.0)
        for body, place in enumerate(rb.forward_kinematics(model, jnp.array(q)).p):
            np.testing.assert_allclose(server.nodes[f"/robot/{body}"].position, place, atol=1e-6)

    check([0.0, 0.0])
    controls.sliders[0].value, controls.sliders[1].value = 0.7, -1.1
    check([0.7, -1.1])
    controls.reset.click()
    check([0.0, 0.0])
    controls.keyframe.value = "bent"
    check([0.5, -1.0])
    assert controls.sliders[0].value == 0.0


def test_each_kind_of_joint_has_sliders() -> None:
    free = rb.load(BALL)
    labels = [label for label, _, _ in ranges(free, free.default_state().q, 2.0)]
    assert len(labels) == free.nv and labels[0].endswith("x [m]") and labels[5].endswith("turn z")
    beam = rb.flexible.beam(2.0, [1, 1, 1, 0, 0, 0], {"k_z": 1}, mass=1.0)
    bent = rb.load("<mujoco/>").with_beam("rod", beam)
    found = ranges(bent, bent.default_state().q, 2.0)
    assert len(found) == bent.nv and found[0][2] == pytest.approx(np.pi / 2)  # half a turn


def test_a_beam_moves_its_tube() -> None:
    """The vertices of the tube are at one radius from the line of the beam."""
    steel = rb.flexible.circle(0.03, E=1e7, nu=0.3, density=1000.0)
    model = rb.load("<mujoco/>").with_beam("rod", rb.flexible.beam(2.0, steel, {"k_z": 1}))
    for ghosts, drawn in ((32, 32), (33, 0)):  # all or none
        q = np.zeros((1 + ghosts, 1, model.nq))
        crowd = film(model, np.zeros(1), q, rb.plotting.skeleton(model))
        assert len(FilmScene(FalseServer(), crowd).tubes[0].nodes) == 1 + drawn
    q = np.zeros((2, 3, model.nq))
    q[0, 2, 0] = 0.5
    shown = film(model, np.arange(3.0), q, rb.plotting.skeleton(model))
    server = FalseServer()
    scene = FilmScene(server, shown)
    (tube,) = scene.tubes
    assert len(tube.nodes) == 2  # the robot and a ghost
    scene.show(2.0)
    for sample, node in enumerate(tube.nodes):
        line = shown.p[sample, 2][tube.merged.bodies]
        away = np.linalg.norm(node.vertices - line, axis=-1)
        np.testing.assert_allclose(away, 0.03, atol=1e-5)
