"""The pages of tasks: each term has a row, each clip exists and is small."""

import json

import pytest

import rbjax as rb
from docs.generate.tasks import pages as tasks
from docs.generate.tasks.definition import blocks
from tests.docs.pages import DOCS, ROOT

CLIPS = DOCS / "tasks" / "clips"


def check(name, page):
    task = rb.envs.tasks()[name]()
    terms = [t for group in task.observations.values() for t in group]
    listed = [*terms, *task.rewards, *task.variables, *task.events, *task.randomise]
    missing = [t.name for t in listed if f"| `{t.name}` |" not in page]
    assert not missing
    assert all(f"| `{end}` |" in page for end in task.terminations)
    assert "<function" not in page and "partial(" not in page and " 0x" not in page


def test_a_page_has_all_terms():
    name = "cart_pole_balance"
    check(name, tasks.page(name, rb.envs.tasks()[name], None, {}))


def test_all_pages_have_all_terms():
    found = tasks.pages(ROOT)
    for name in rb.envs.tasks():
        check(name, found[f"tasks/{name}.md"])
        assert f"]({name}.md)" in found["tasks/index.md"]


@pytest.mark.parametrize("name", rb.envs.tasks())
def test_the_clip_of_a_task(name):
    caption = json.loads((CLIPS / "clips.json").read_text())[name]["caption"]
    assert caption.endswith(".")
    assert (CLIPS / f"{name}.webp").stat().st_size <= 150_000


def test_no_two_tasks_have_the_same_clip():
    files = [path.read_bytes() for path in CLIPS.glob("*.webp")]
    assert len(set(files)) == len(files)


def test_a_training_is_on_the_page_of_its_task():
    curves = tasks.trainings("cart_pole_swing_up")
    assert {algorithm for algorithm, _ in curves} >= {"ppo", "shac"}
    assert tasks.chart(curves).startswith(b"<?xml")


def test_a_definition_has_prose_lists_and_tables():
    rewards = "Rewards:\n    up      1 if z > 0,\n            else 0\n    slow    |v|\n"
    prose, rows, then, items = blocks(rewards + "And:\n    - one\n      two")
    assert prose == "Rewards:" and then == "And:" and items == "- one two"
    assert "| `up` | 1 if z > 0, else 0 |" in rows and "| `slow` | \\|v\\| |" in rows
