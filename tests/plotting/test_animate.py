"""Animations of any trajectory: files that open, frames at their times, errors in a sentence."""

import base64
import itertools
import json
import re
import warnings
import zlib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import rbjax as rb
from rbjax.plotting import movie_files, offscreen
from rbjax.plotting.film import film, frames


def swing(batch: int | None = None, steps: int = 50):
    model = rb.load("double_pendulum")
    q = jnp.array([1.0, 0.4])
    q = q if batch is None else q + 0.1 * jnp.arange(batch)[:, None]
    return model, rb.rollout(model, rb.State(q, 0 * q), None, 0.01, steps=steps)


def data_of(page: Path) -> dict:
    text = page.read_text()
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.S)
    assert found and "http" not in text.replace("http-equiv", ""), "no network"
    return json.loads(found[1])


def floats(text: str, kind: str = "<f4") -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), kind)


@pytest.mark.parametrize("source", [None, "double_pendulum"])
def test_a_gif_plays_in_real_time(source: str | None, tmp_path: Path) -> None:
    model, run = swing()
    counts: list[tuple[int, int]] = []
    file = rb.plotting.animate(
        model, run, tmp_path / "a.gif", source=source, fps=20, size=(160, 120),
        progress=lambda done, total: counts.append((done, total)),
    )  # fmt: skip
    with Image.open(file) as picture:
        assert picture.size == (160, 120) and picture.n_frames == 11
        shown, times = [], []
        for i in range(11):
            picture.seek(i)
            shown.append(np.asarray(picture.convert("L"), float))
            times.append(picture.info["duration"])
    assert times[:-1] == [50] * 10  # ms
    assert all(np.abs(a - b).max() > 50 for a, b in itertools.pairwise(shown))
    assert counts[-1] == (11, 11)


def test_a_page_holds_the_poses_of_every_body(tmp_path: Path) -> None:
    model, run = swing()
    file = rb.plotting.animate(model, run, tmp_path / "a.html", fps=100, title="a < b")
    data = data_of(file)
    poses = floats(data["poses"]).reshape(data["frames"], model.nb, 7)
    at = 37
    expected = rb.forward_kinematics(model, run.q[at])
    np.testing.assert_allclose(poses[at, :, :3], expected.p, atol=1e-6)
    np.testing.assert_allclose(
        rb.rotations.quaternion.to_matrix(poses[at, :, 3:].astype(float)), expected.R, atol=1e-6
    )
    assert "<title>a &lt; b</title>" in file.read_text()


def test_it_is_silent_where_nobody_looks_on(tmp_path: Path, capfd) -> None:
    model, run = swing(steps=5)
    rb.plotting.animate(model, run, tmp_path / "a.gif", size=(80, 60))
    assert "".join(capfd.readouterr()).strip() == ""


def test_a_batch_shows_so_many_samples(tmp_path: Path) -> None:
    model, run = swing(batch=4)
    assert data_of(rb.plotting.animate(model, run, tmp_path / "a.html"))["samples"] == 4
    few = rb.plotting.animate(model, run, tmp_path / "b.html", samples=2)
    assert data_of(few)["samples"] == 2


def test_frames_between_states_lie_on_the_motion() -> None:
    model = rb.load("free_body")
    v = jnp.array([0.3, 0, 0, 0.5, 1.0, -2.0])
    q = [model.joints.reference]
    for dt in (0.1, 0.25, 0.05):  # uneven times, at one velocity
        q.append(rb.integrate(model, q[-1], dt * v))
    path = rb.Trajectory(jnp.array([0, 0.1, 0.35, 0.4]), jnp.stack(q), jnp.stack([v] * 4), True)
    ts, found = frames(model, path, 40.0, 0.5, 1)
    np.testing.assert_allclose(np.diff(ts), 0.0125)
    for t, at in zip(ts, found[0], strict=True):
        expected = rb.integrate(model, q[0], t * v)
        np.testing.assert_allclose(rb.difference(model, expected, at), 0, atol=1e-12)


def test_a_motion_that_blows_up_is_shown_until_then() -> None:
    model, run = swing()
    lost = rb.Trajectory(run.ts, run.q.at[30:].set(jnp.nan), run.v, jnp.array(False))
    with pytest.warns(UserWarning, match="not finite after t = 0.29 s"):
        ts, q = frames(model, lost, 100.0, 1.0, 1)
    assert len(ts) == 30 and np.isfinite(q).all()


def test_what_goes_far_is_followed() -> None:
    model = rb.load("quadrotor")
    q = jnp.tile(model.joints.reference, (50, 1))
    shapes = rb.plotting.solids("quadrotor")

    def view(reach: float):
        at = q.at[:, 0].set(jnp.linspace(0, reach, 50))
        return film(model, np.linspace(0, 1, 50), np.asarray(at)[None], shapes)

    near, far = view(0.5), view(50.0)
    assert np.ptp(near.centre, axis=0).max() == 0
    np.testing.assert_allclose(np.ptp(far.centre[:, 0]), 50.0, rtol=1e-3)
    assert far.size.max() < 3


@pytest.mark.parametrize("flat", [True, False])
def test_the_view_holds_every_point(flat: bool) -> None:
    model, run = swing()
    camera = None if flat else rb.plotting.Camera(30, 30)
    shapes = rb.plotting.skeleton(model)
    ts, q = frames(model, run, 25, 1, 1)
    shown = film(model, ts, q, shapes, camera=camera)
    assert not flat or abs(shown.camera.azimuth + 90) < 1  # a plane x z, seen from -y
    for frame in range(len(ts)):
        for s in shapes:
            points = s.points @ shown.R[0, frame, s.body].T + shown.p[0, frame, s.body]
            seen = (points - shown.centre[frame]) @ shown.camera.axes[:2].T
            assert (np.abs(seen) <= shown.size / 2).all()


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("a.avi", {}, "ends in .gif, .mp4, .html"),
        ("nowhere/a.gif", {}, "no such folder"),
        ("a.gif", {"fps": 0}, "fps is 0"),
        ("a.gif", {"renderer": "magic"}, "expected one of drawing, mujoco"),
        ("a.gif", {"renderer": "mujoco"}, "give it as source="),
    ],
)
def test_what_cannot_be_written(name: str, options: dict, says: str, tmp_path: Path) -> None:
    model, run = swing()
    with pytest.raises(rb.InputError, match=says):
        rb.plotting.animate(model, run, tmp_path / name, **options)


def test_a_trajectory_of_another_model(tmp_path: Path) -> None:
    _, run = swing()
    with pytest.raises(rb.InputError, match="give the model that made the trajectory"):
        rb.plotting.animate(rb.load("pendulum"), run, tmp_path / "a.gif")


def test_mp4_without_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(movie_files, "ffmpeg", lambda: None)
    model, run = swing()
    with pytest.raises(rb.InputError, match=r"needs ffmpeg.*write a\.gif or a\.html"):
        rb.plotting.animate(model, run, tmp_path / "a.mp4")


def false_ffmpeg(folder: Path, ending: str) -> str:
    """A program that takes frames as ffmpeg does, and writes how many bytes came."""
    program = folder / "ffmpeg"
    program.write_text(f'#!/bin/sh\nfor last; do :; done\nwc -c > "$last"\n{ending}\n')
    program.chmod(0o755)
    return str(program)


def test_mp4_pipes_every_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = false_ffmpeg(tmp_path, "exit 0")
    monkeypatch.setattr(movie_files, "ffmpeg", lambda: program)
    model, run = swing()
    file = rb.plotting.animate(model, run, tmp_path / "a.mp4", fps=20, size=(160, 120))
    assert int(file.read_text()) == 11 * 160 * 120 * 3


def test_mp4_says_what_ffmpeg_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = false_ffmpeg(tmp_path, "echo no such codec >&2; exit 1")
    monkeypatch.setattr(movie_files, "ffmpeg", lambda: program)
    model, run = swing(steps=5)
    with pytest.raises(rb.RbjaxError, match="no such codec"):
        rb.plotting.animate(model, run, tmp_path / "a.mp4", size=(160, 120))


def test_mujoco_renders_where_it_can(tmp_path: Path) -> None:
    model, run = swing(steps=10)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        file = rb.plotting.animate(
            model, run, tmp_path / "a.gif", source="double_pendulum", renderer="mujoco",
            size=(160, 120),
        )  # fmt: skip
    with Image.open(file) as picture:
        assert picture.n_frames == 3
    if any("renderer does not work" in str(w.message) for w in said):
        pytest.skip("no OpenGL here without a display: the sentence was said, rbjax drew")


def test_without_opengl_a_sentence_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(offscreen, "_PROGRAM", "import sys; sys.exit('no libEGL.so')")
    model, run = swing(steps=5)
    with pytest.warns(UserWarning, match=r"does not work here.*no libEGL.so.*drawn by rbjax"):
        file = rb.plotting.animate(
            model, run, tmp_path / "a.gif", source="double_pendulum", renderer="mujoco",
            size=(160, 120),
        )  # fmt: skip
    assert file.read_bytes().startswith(b"GIF89a")
