"""A newcomer's questions find their page among the first three, by the words of titles and text.

As the site's search does, a page is found if it has all words (here without the smallest ones);
words of the title count most, then headings, then the text.
"""

import math
import re

import pytest

from docs.generate import tree
from tests.docs.pages import DOCS, PAGES

SMALLEST = {"a", "an", "how", "i", "my", "of", "on", "the", "to", "do", "in"}
QUESTIONS = {
    "how to load my URDF": "howto/models/load_a_urdf.md",
    "batch on a GPU": "howto/motion/batch_on_a_gpu.md",
    "fit friction": "howto/identification/fit_friction.md",
    "close a loop": "howto/constraints/close_a_loop.md",
    "swing up": "howto/control/swing_up.md",
    "export a film": "howto/output/export_a_film.md",
    "add a force": "howto/motion/own_force.md",
    "choose a solver": "howto/motion/choose_a_solver.md",
    "read a sensor": "howto/contact/read_a_sensor.md",
    "run PPO": "howto/learning/run_ppo.md",
}


def words(text: str) -> list[str]:
    return re.findall(r"[a-z0-9]+", text.lower())


def score(asked: list[str], page: str, path: str) -> float:
    """How well a page answers; 0 if a word is missing."""
    title = words(page.split("\n", 1)[0] + " " + path.rpartition("/")[2].removesuffix(".md"))
    headings = words(" ".join(re.findall(r"^##+ (.*)$", page, re.MULTILINE)))
    text = words(page)
    total = 0.0
    for word in asked:
        found = [sum(w.startswith(word) for w in part) for part in (title, headings, text)]
        if not any(found):
            return 0.0
        share = found[2] / math.sqrt(len(text))
        total += 10 * min(found[0], 1) + 2 * min(found[1], 1) + min(share, 1.0)
    return total


@pytest.mark.parametrize("question", QUESTIONS)
def test_a_question_finds_its_page(question):
    asked = [word for word in words(question) if word not in SMALLEST]
    pages = {p.relative_to(DOCS).as_posix(): p.read_text() for p in PAGES[1:]}
    ranked = sorted(pages, key=lambda path: -score(asked, pages[path], path))
    assert QUESTIONS[question] in ranked[:3], ranked[:5]


def test_pages_that_answer_are_two_clicks_away():
    """A tab, then the index of the how-to pages."""
    text = (DOCS / "howto" / "index.md").read_text()
    assert all(path.removeprefix("howto/") in text for path in QUESTIONS.values())
    assert "howto" in tree.TABS


def test_a_job_fits_on_a_screen():
    pages = (DOCS / "howto").glob("*/*.md")
    assert not [page.name for page in pages if len(page.read_text().splitlines()) > 60]
