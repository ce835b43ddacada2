"""HTML pages of motions: their data, and what a browser shows."""

from __future__ import annotations

import base64
import zlib
from functools import cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.plotting import web_page
from rbjax.plotting.film import film
from rbjax.plotting.web_page import page_data
from tests.plotting.browser import opened, picture
from tests.plotting.test_contact_arrows import BALL, forces


def floats(text: str, kind: str = "<f4") -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), kind)


@cache
def balls(samples: int, frames: int = 6) -> tuple[rb.Model, rb.Trajectory]:
    """Balls that leave a place in all directions, the first along x at 2 m/s."""
    model, ts = rb.load(BALL), np.linspace(0, 1, frames)
    turn = 2 * np.pi * np.arange(samples) / samples
    v = 2 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    q = np.tile(model.default_state().q, (samples, frames, 1))
    q[..., :3] += v[:, None] * ts[:, None]
    q = jnp.asarray(q)
    return model, rb.Trajectory(jnp.asarray(ts), q, jnp.zeros((*q.shape[:-1], 6)), jnp.array(True))


def film_of(samples: int, frames: int = 6):
    model, path = balls(samples, frames)
    return film(model, np.asarray(path.ts), np.asarray(path.q), rb.plotting.solids(BALL))


@pytest.mark.parametrize("most", [32_000_000, 40 * 7 * 2 * 3])
def test_ghosts_are_rounded(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Units of 1/5000 of the picture; with little room, every second frame."""
    monkeypatch.setattr(web_page, "_MOST_BYTES", most)
    shown = film_of(41)
    ghosts = page_data(shown, 5.0, 1.0)["ghosts"]
    low, high = floats(ghosts["poses"], "u1").reshape(2, -1).astype(int)
    steps = (low + 256 * high).astype("<u2").view("<i2").reshape(ghosts["frames"], 40, 1, 7)
    assert ghosts["every"] == (1 if most > 1e6 else 2)
    whole = np.cumsum(steps, 0, dtype=np.int16)  # wraps around
    place = ghosts["origin"] + whole[..., :3] * np.array(ghosts["unit"])
    kept = np.moveaxis(shown.p[1:, :: ghosts["every"]], 0, 1)
    np.testing.assert_allclose(place, kept, atol=2e-4 * shown.size.max() / 2)
    np.testing.assert_allclose(whole[..., 3:] / 2047, np.tile([1, 0, 0, 0], (*kept.shape[:3], 1)))


def test_a_crowd_has_coarse_surfaces() -> None:
    few, many = (page_data(film_of(n), 5.0, 1.0) for n in (web_page.CROWD, web_page.CROWD + 1))
    assert few["crowd"] is None
    fine, coarse = (
        floats(many[name]["triangles"]["robot"], "<u4").size for name in ("robot", "crowd")
    )
    assert coarse < fine / 5


def test_triangles_are_grouped() -> None:
    """The robot and the world, opaque and translucent; the vertices of the world have no body."""
    xml = BALL.replace('<geom type="plane"', '<geom type="box" pos="1 0 0" size=".1 .1 .1"/>'
                       '<geom type="box" pos="2 0 0" size=".1 .1 .1" rgba="1 0 0 .3"/>'
                       '<geom type="plane"')  # fmt: skip
    model, path = balls(1)
    shown = film(model, np.asarray(path.ts), np.asarray(path.q), rb.plotting.solids(xml))
    mesh = page_data(shown, 5.0, 1.0)["robot"]
    counts = {name: floats(x, "<u4").size for name, x in mesh["triangles"].items()}
    assert counts["world"] == counts["glass"] == 36 and counts["robot"] > 36 and not counts["clear"]
    bodies, colors = floats(mesh["bodies"], "<u2"), floats(mesh["colors"], "u1").reshape(-1, 4)
    assert {*bodies} == {0, 65535} and {*colors[:, 3]} == {255, 77}


def test_a_large_batch_needs_little_room(tmp_path: Path) -> None:
    model, path = balls(2000)
    file = rb.plotting.animate(model, path, tmp_path / "a.html", samples=2000, source=BALL, fps=20)
    assert file.stat().st_size < 1_000_000  # 2000 samples, 21 frames, 14 bytes: 588 kB before zlib


def seek(page, frame: int) -> None:
    page.wait_for_selector("body[data-ready=yes]")
    page.evaluate(
        "f => { const at = document.getElementById('at'); at.value = f; at.oninput(); }", frame
    )
    page.wait_for_timeout(200)


def press(page, name: str) -> None:
    page.evaluate(
        "n => { const x = document.getElementById(n); x.checked = !x.checked; x.oninput(); }", name
    )
    page.wait_for_timeout(200)


def colored(image: np.ndarray, color: tuple[int, ...]) -> np.ndarray:
    """Pixels of the scene with the hue of a colour."""
    image, color = image[40:420], np.array(color) / np.linalg.norm(color)
    size = np.maximum(np.linalg.norm(image, axis=-1), 1)
    return np.argwhere((image @ color / size > 0.98) & (np.ptp(image, axis=-1) > 40))


def test_a_browser_shows_the_robot_its_forces_and_ghosts(tmp_path: Path) -> None:
    model, path = balls(40)
    green = BALL.replace('size=".1" mass', 'size=".1" rgba="0 .8 .1 1" mass')
    red = tuple(int(rb.plotting.RED[k : k + 2], 16) for k in (1, 3, 5))
    file = rb.plotting.animate(
        model, path, tmp_path / "a.html", source=green, samples=40, fps=20, title="Balls",
        contacts=forces(30.0, lead=(6,)), camera=rb.plotting.Camera(-90.0, 30.0),
    )  # fmt: skip
    with opened(f"file://{file}") as page:
        seek(page, 0)
        assert page.title() == "Balls"
        assert page.inner_text("#time") == "t = 0.00 s"
        force, start = colored(picture(page), red), colored(picture(page), (0, 204, 26))
        press(page, "forces")
        assert len(force) > 50 and len(start) > 50 and not len(colored(picture(page), red))
        seek(page, 10)
        assert page.inner_text("#time") == "t = 0.50 s" and page.inner_text("#play") == "play"
        crowd = len(colored(picture(page), (0, 204, 26)))
        press(page, "ghosts")
        alone = colored(picture(page), (0, 204, 26))
        assert len(alone) > 50 and abs(alone - start.mean(0)).max() > 50  # it moved to the right
        assert alone[:, 1].mean() > start[:, 1].mean() + 50 and crowd >= len(alone)
        press(page, "follow")
        followed = colored(picture(page), (0, 204, 26))
        np.testing.assert_allclose(followed.mean(0), start.mean(0), atol=8)
        page.click("#play")
        page.wait_for_timeout(300)
        assert page.inner_text("#time") != "t = 0.50 s"


def test_a_browser_without_webgl_says_so(tmp_path: Path) -> None:
    model, path = balls(2)
    file = rb.plotting.animate(model, path, tmp_path / "a.html", source=BALL)
    file.write_text(file.read_text().replace('getContext("webgl2"', 'getContext("none"'))
    with opened(f"file://{file}") as page:
        page.wait_for_selector("body[data-ready=error]")
        assert "needs WebGL 2" in page.inner_text("#error")
