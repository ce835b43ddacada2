"""A headless Chromium for tests of pages; they are skipped without playwright or a browser."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from PIL import Image

#: WebGL by software
_OPTIONS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@contextmanager
def opened(url: str, size: tuple[int, int] = (640, 480)) -> Iterator[Any]:
    """Open a page. Its errors fail the test when the page is closed."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
    program = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None)
    if program is None:
        pytest.skip("no chromium here to open a page")
    said: list[str] = []
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=_OPTIONS)
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(url)
        yield page
        browser.close()
    assert not said


def picture(page: Any) -> np.ndarray:
    """Take a screenshot (height, width, 3)."""
    return np.asarray(Image.open(BytesIO(page.screenshot())).convert("RGB"), float)


def until(page: Any, reached: Callable[[], bool], seconds: float = 20.0) -> None:
    """Wait until a condition holds."""
    for _ in range(int(10 * seconds)):
        if reached():
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"not reached in {seconds} s")
