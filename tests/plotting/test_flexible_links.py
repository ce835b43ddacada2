"""Beams in pictures: tubes along their lines, on the bodies that carry them."""

import warnings
from dataclasses import replace

import matplotlib.figure
import numpy as np
import pytest

import rbjax as rb
from rbjax.flexible.modal import BeamSection, Interface, add_modal_body, beam_mesh, craig_bampton
from rbjax.plotting import offscreen
from rbjax.plotting.film import film
from rbjax.plotting.flexible_links import flexible_links, tubes

RADIUS, LENGTH = 0.03, 2.0
ARM = """<mujoco><worldbody><body name="arm"><joint axis="0 1 0"/><geom size=".1" mass="1"/></body>
  </worldbody></mujoco>"""


@pytest.fixture(scope="module")
def rod():
    steel = rb.flexible.circle(RADIUS, E=1e7, nu=0.3, density=1000.0)
    return rb.flexible.beam(LENGTH, steel, {"k_z": 1}, points=9)


@pytest.fixture(scope="module")
def arm(rod):
    turned = {"position": (0.5, 0.2, 0.0), "orientation": (0.5**0.5, 0.5**0.5, 0.0, 0.0)}
    return rb.load(ARM).with_beam("rod", rod, "arm", frames={"third": 1 / 3}, **turned)


def test_stations_are_on_the_arc(arm):
    """Constant curvature k: (sin(k s), 1 - cos(k s)) / k in the base frame, on the turned arm."""
    k, angle = 0.8, 0.4
    q = np.array([[angle, k, 0.0], [0.0, 1e-9, 0.0]])
    R, p = rb.plotting.poses(arm, q)
    s = np.linspace(0, LENGTH, 49)
    c, d = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0, d], [0, 1, 0], [-d, 0, c]])
    base = turn @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # x stays, y goes to z
    arc = np.stack([np.sin(k * s), 1 - np.cos(k * s), 0 * s], -1) / k
    expected = turn @ [0.5, 0.2, 0.0] + arc @ base.T
    stations = slice(arm.nb, None)
    np.testing.assert_allclose(p[0, stations], expected, atol=1e-8)  # quadrature at 9 points
    np.testing.assert_allclose(R[0, stations][:, :, 2], np.tile(base[:, 2], (49, 1)), atol=1e-12)
    for name, station in (("rod", -1), ("third", arm.nb + 16)):
        np.testing.assert_allclose(p[0, station], p[0, arm.body(name)], atol=1e-9)
        np.testing.assert_allclose(R[0, station], R[0, arm.body(name)], atol=1e-12)


def test_the_tube_has_the_radius_of_the_section(arm):
    for solid in tubes(arm):
        np.testing.assert_allclose(np.linalg.norm(solid.points, axis=1), RADIUS, rtol=1e-12)


@pytest.mark.parametrize("given", ["inertia", "stiffness", "nothing"])
def test_sections_given_as_numbers(given):
    """A strip of 0.2 by 0.05 m: J = m h^2 / 12, EI / EA = h^2 / 12; else 1/160 of the length."""
    y, z = 0.2**2 / 12, 0.05**2 / 12
    inertia = [1.5 * (y + z), 1.5 * z, 1.5 * y] if given == "inertia" else [0, 0, 0]
    axial = 1e3 if given == "stiffness" else 0.0
    beam = rb.flexible.beam(2.0, [1.0, 1e3 * z, 1e3 * y, axial, 0, 0], mass=1.5, inertia=inertia)
    (link,) = flexible_links(rb.load("<mujoco/>").with_beam("strip", beam))
    expected = [2 / 160] * 2 if given == "nothing" else 2 * np.sqrt([y, z])
    np.testing.assert_allclose(link.axes, np.tile(expected, (len(link.axes), 1)), rtol=1e-12)


def test_a_taper_is_drawn():
    r = np.linspace(0.06, 0.02, 5)
    section = rb.flexible.circle(r, E=1e7, nu=0.3, density=1000.0)
    beam = rb.flexible.beam(2.0, section, {"k_z": 1}, points=5)
    (link,) = flexible_links(rb.load("<mujoco/>").with_beam("taper", beam))
    assert abs(link.axes[0] - 0.06).max() < 1e-12 and abs(link.axes[-1] - 0.02).max() < 1e-12
    assert (np.diff(link.axes, axis=0) <= 0).all()


def test_a_modal_body_is_drawn_by_lines_between_its_frames():
    """A bar with a frame in the middle: base to middle to tip, not base to tip."""
    section = BeamSection(EA=1e6, EIy=10.0, EIz=20.0, GJ=8.0, mass=2.0, rotary=(0.01, 0, 0))
    mesh = beam_mesh(np.linspace([0, 0, 0], [1, 0, 0], 5), section)
    ends = [Interface("root", [0]), Interface("tip", [4]), Interface("middle", [2])]
    body = craig_bampton(mesh, ends, 0, frame="root").with_frames(["tip", "middle"])
    model = add_modal_body(rb.load(ARM), "bar", body, "arm", frames={"inner": "tip"})
    (link,) = flexible_links(model)
    assert sorted(link.lines) == [(0, 2), (1, 2)]  # stations: base, tip, middle
    q = np.zeros((1, model.nq))
    q[0, :3] = 0.3, 0.1, -0.1
    R, p = rb.plotting.poses(model, q)
    np.testing.assert_allclose(p[0, model.nb + 1], p[0, model.body("inner")], atol=1e-12)
    np.testing.assert_allclose(p[0, model.nb + 2], p[0, model.body("bar")], atol=1e-12)
    np.testing.assert_allclose(R[0, model.nb + 2], R[0, model.body("bar")], atol=1e-12)


def test_the_segments_are_drawn(arm):
    """48 segments, and with them the solids of the file or of the parameters."""
    q = [0.3, 0.5, 0.1]
    for source, others in ((ARM, 1), (None, 3)):
        ax = matplotlib.figure.Figure(figsize=(5, 4)).add_subplot()
        rb.plotting.draw(arm, q, ax=ax, source=source)
        ax.figure.canvas.draw()
        assert len(ax.collections[-1].get_paths()) == 48 + others
    shown = rb.plotting.skeleton(arm)
    R, p = rb.plotting.poses(arm, np.array([q]))
    with pytest.raises(rb.InputError, match="expected at least 52"):
        rb.plotting.draw_solids(shown, R[0, : arm.nb], p[0, : arm.nb], ax=ax)


def test_what_mujoco_adds_to_its_scene(arm):
    q = np.array([[[0.3, 0.5, 0.1], [0.2, 0.1, 0.0]]])
    shown = film(arm, np.zeros(2), q, rb.plotting.skeleton(arm))
    ends, radius, color = offscreen._tubes(shown)
    assert ends.shape == (2, 48, 2, 3) and color.shape == (48, 4)
    np.testing.assert_allclose(radius, RADIUS, rtol=1e-12)
    np.testing.assert_allclose(ends[:, -1, 1], shown.p[0, :, arm.body("rod")], atol=1e-9)


def test_mujoco_shows_a_beam(arm):
    state = arm.default_state()
    pictures = []
    for scale in (1.0, 1e-6):
        shapes = [*rb.plotting.solids(ARM), *tubes(arm)]
        shapes = [s if s.end is None else replace(s, points=s.points * scale) for s in shapes]
        shown = film(arm, np.zeros(1), np.asarray(state.q)[None, None], shapes)
        with warnings.catch_warnings(action="ignore"):
            rendered = offscreen.render(ARM, False, np.asarray(state.q)[None], shown, (80, 60))
        if rendered is None:
            pytest.skip("no OpenGL here without a display")
        pictures.append(next(iter(rendered)).astype(int))
    assert (np.abs(pictures[0] - pictures[1]).max(-1) > 20).sum() > 20  # pixels of the beam
