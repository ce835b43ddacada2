"""Each animation is one small file without a network, and stands in the page."""

import re

import pytest

from docs.generate import animations

PAGE = (animations.ROOT / "docs" / "animations" / "index.md").read_text()


@pytest.fixture(scope="module")
def made():
    return animations.pages(animations.ROOT)


@pytest.mark.parametrize("name", animations.MADE)
def test_the_file_is_small_and_alone(name, made):
    text = made[f"animations/{name}.html"]
    assert len(text.encode()) <= animations.LARGEST
    assert not re.findall(r"(?:src|href)=\"(?!data:)|https?://(?!www\.w3\.org)|import\(", text)
    assert f'src="{name}.html"' in PAGE


def test_no_other_file_is_in_the_folder():
    found = {path.stem for path in animations.FOLDER.iterdir()}
    assert found == set(animations.MADE)


def test_it_is_made_again(tmp_path):
    path = tmp_path / "grasping.html"
    animations.MADE["grasping"](path)
    assert path.stat().st_size <= animations.LARGEST
