"""The viewer in a real browser: skipped without viser, playwright or chromium."""

from __future__ import annotations

import numpy as np
import pytest

import rbjax as rb
from rbjax.viewer import view
from tests.plotting.browser import opened, picture, until
from tests.plotting.test_contact_arrows import forces
from tests.plotting.test_web_page import balls, colored
from tests.viewer.test_scene import ARM

pytest.importorskip("viser", reason="the viewer needs viser")
pytestmark = pytest.mark.slow


def test_sliders_move_the_robot() -> None:
    viewer = view(rb.load(ARM), source=ARM.replace("1 0 0 0.5", "1 0 0 1"), port=8231)
    try:
        with opened(viewer.url, (900, 480)) as page:
            until(page, lambda: len(colored(picture(page), (255, 0, 0))) > 100)
            page.wait_for_timeout(1500)  # the scene fades in
            before = colored(picture(page), (255, 0, 0))
            assert page.locator("text=shoulder").count() == 1
            viewer.controls.sliders[0].value = 0.9
            until(page, lambda: moved(page, (255, 0, 0), before) > 10)
    finally:
        viewer.stop()


def moved(page, color: tuple[int, int, int], before: np.ndarray) -> float:
    """Pixels by which the middle of a colour has moved."""
    now = colored(picture(page), color)
    return float(np.abs(now.mean(0) - before.mean(0)).max()) if len(now) else 0.0


def test_a_motion_plays_and_stops() -> None:
    model, path = balls(30)
    green = "<mujoco><worldbody><body pos='0 0 .1'><freejoint/><geom size='.3' rgba='0 .8 .1 1'/>"
    viewer = view(
        model, path, source=green + "</body></worldbody></mujoco>", port=8232,
        contacts=forces(30.0, lead=(6,)),
    )  # fmt: skip
    try:
        with opened(viewer.url, (900, 480)) as page:
            until(page, lambda: page.locator("text=29 ghosts").count() == 1)
            until(page, lambda: len(colored(picture(page), (0, 204, 26))) > 100)
            page.get_by_role("button", name="stop", exact=True).click()
            until(page, lambda: not viewer.controls.playing)
            page.get_by_role("button", name="play", exact=True).click()
            until(page, lambda: viewer.controls.playing)
    finally:
        viewer.stop()
