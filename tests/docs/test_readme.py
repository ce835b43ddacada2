"""README: its length, its program and what it prints, its pictures."""

import re
from pathlib import Path

import pytest
from PIL import Image

from docs.generate.pictures.__main__ import CLIPS as CLIPS_MADE
from tests.docs.pages import FENCE, ROOT, blocks

TEXT = (ROOT / "README.md").read_text()
CLIPS = ROOT / "docs" / "clips"


def test_it_is_short_and_begins_with_a_picture_and_code():
    lines = TEXT.splitlines()
    assert len(lines) <= 150
    first = lines[:40]
    assert any("<img" in line for line in first)
    assert first.count("```python") == 1 and first.index("```python") < 25


def test_the_program_prints_what_the_page_says(capsys):
    """The printed digits are the same in single and double precision."""
    (program,) = blocks(TEXT)
    (printed,) = (text for _, info, text in FENCE.findall(TEXT) if info == "text")
    exec(compile(program, "README.md", "exec"), {"__name__": "readme"})
    assert capsys.readouterr().out == printed


def test_the_program_is_short():
    (program,) = blocks(TEXT)
    assert len([line for line in program.splitlines() if line.strip()]) <= 12


def test_every_cell_of_the_comparison_leads_to_a_benchmark():
    table = TEXT.split("## Why")[1].split("## Clips")[0]
    rows = [line.strip("|").split("|") for line in table.splitlines() if line.startswith("|")][2:]
    assert len(rows) == 6
    assert all("](docs/benchmarks/" in cell for row in rows for cell in row[1:])


@pytest.mark.parametrize("name", sorted(path.name for path in CLIPS.iterdir()))
def test_a_clip_is_small_and_moves(name: str):
    path = CLIPS / name
    most, width = (1_000_000, 800) if name.startswith("strip") else (150_000, 270)
    assert path.stat().st_size <= most
    with Image.open(path) as film:
        assert film.width == width and 40 <= film.n_frames <= 48  # equal frames are one


def test_every_clip_leads_to_its_notebook():
    shown = re.findall(
        r'\[<picture>.*?<img src="docs/clips/(\w+)\.webp"[^>]*></picture>\]'
        r"\((notebooks/\w+)\.ipynb\)",
        TEXT,
    )
    assert len(shown) == 9
    assert all(Path(notebook).name == clip for clip, notebook in shown)
    assert {clip for clip, _ in shown} == set(CLIPS_MADE)
    names = {clip for clip, _ in shown} | {"strip"}
    assert {x for n in names for x in (n, f"{n}-dark")} == {p.stem for p in CLIPS.iterdir()}
    for dark, light in re.findall(
        r'srcset="docs/clips/([\w-]+).*?<img src="docs/clips/(\w+)', TEXT
    ):
        assert dark == f"{light}-dark"


def test_the_citation_has_the_version_of_the_package():
    import rbjax

    assert f"version: {rbjax.__version__}\n" in (ROOT / "CITATION.cff").read_text()
