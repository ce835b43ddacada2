"""The examples of the guides run as they stand, each page from top to bottom."""

import re
from pathlib import Path

import pytest

PAGES = ["docs/extending.md"]


@pytest.mark.parametrize("page", PAGES)
def test_examples_run(page):
    text = (Path(__file__).parents[1] / page).read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert blocks
    scope: dict = {}
    for block in blocks:
        exec(compile(block, page, "exec"), scope)
