"""The tutorials: each executed notebook of notebooks/ as a page, and their list with pictures."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

from docs.generate import repository
from docs.generate.tutorials import notebooks
from docs.generate.tutorials.notebooks import Notebook

#: the order of the list
ORDER = {
    "Begin": ("first_hour",),
    "Model": ("forces", "joints", "loops", "contact", "flexible", "gpu_threads"),
    "Wheels and planning": ("wheels", "two_robots_of_the_book", "planning", "parking_a_trailer"),
    "Control": (
        "reaching_an_arm", "swing_up", "solving_kinematics", "through_a_gate", "racing_a_car",
        "walking",
    ),
    "Learning": ("training_a_policy", "walking_policy", "policy_on_a_robot"),
    "Identification": (
        "sensors_and_noise", "chaotic_pendulum", "double_pendulum_motors", "legs_in_the_air",
        "slip_by_floor",
    ),
    "Numerics": ("choosing_a_solver", "tumbling_body"),
}  # fmt: skip
#: what a tutorial needs beyond a CPU
NEEDS = {
    "gpu_threads": "a CPU; a GPU runs one robot a thread",
    "walking_policy": "a CPU; its long trainings ran on a GPU",
    "chaotic_pendulum": "a CPU; public recordings, for one part",
    "double_pendulum_motors": "a CPU; public recordings",
    "legs_in_the_air": "a CPU; public recordings",
    "slip_by_floor": "a CPU; public recordings",
}
#: a page that a notebook's text names
PAGE = re.compile(r"`docs/([\w/-]+\.md)`")
#: which picture of a notebook stands in the list, if it is not the first
PICTURE = {
    "walking": 1,
    "wheels": 1,
}
STYLE = (
    "<style>.cards{display:grid;gap:1rem;"
    "grid-template-columns:repeat(auto-fill,minmax(260px,1fr))}"
    ".cards img{border-radius:.2rem;width:100%;height:160px;object-fit:contain}"
    "</style>"
)


def pages(root: Path) -> dict[str, str | bytes]:
    """A page, the pictures and the sources of each notebook, and the list of them."""
    found = {path.stem: path for path in sorted((root / "notebooks").glob("*.ipynb"))}
    listed = [name for names in ORDER.values() for name in names]
    if set(listed) != set(found):
        missing = sorted(set(found) ^ set(listed))
        raise ValueError(f"notebooks/ and ORDER of {__file__} differ by {', '.join(missing)}")
    read = {name: notebooks.read(found[name]) for name in listed}
    clips = {path.stem for path in (root / "docs" / "clips").glob("*.webp")}
    out: dict[str, str | bytes] = {"tutorials/index.md": contents(read, clips)}
    for name, notebook in read.items():
        out[f"tutorials/{name}.md"] = page(notebook, root)
        out |= {f"tutorials/{file}": data for file, data in notebook.files.items()}
        for suffix in ("py", "ipynb"):
            file = root / "notebooks" / f"{name}.{suffix}"
            out[f"tutorials/files/{file.name}"] = file.read_bytes()
    return out


def page(notebook: Notebook, root: Path) -> str:
    """A notebook's page: title, time, where to open it, and the notebook."""
    name = notebook.name
    links = [f"[open as .py](files/{name}.py)", f"[open as .ipynb](files/{name}.ipynb)"]
    if colab := repository.colab(root, f"notebooks/{name}.ipynb"):
        links.append(f"[open in Colab]({colab})")
    runs = f"Runs in {lasts(notebook.seconds)} ({notebook.date}, two cores). Needs {needs(name)}."
    head = f"<small>{runs} {', '.join(links)}</small>"
    body = [
        part if part.startswith("```") else PAGE.sub(r"[`docs/\1`](../\1)", part)
        for part in notebook.body
    ]
    return "\n\n".join([f"# {notebook.title}", head, *body]) + "\n"


def contents(read: dict[str, Notebook], clips: Collection[str] = ()) -> str:
    """The list: a picture, the title, the time and the first sentences of each."""
    out = [
        "# Tutorials",
        "Every notebook of the repository, executed: text, code, what it printed and drew. "
        "Times are those of the last execution, compiling included, on two cores of a CPU.",
        STYLE,
    ]
    for heading, names in ORDER.items():
        cards = "\n\n".join(card(read[name], name in clips) for name in names)
        out.append(f'## {heading}\n\n<div class="cards" markdown="1">\n\n{cards}\n\n</div>')
    return "\n\n".join(out) + "\n"


def card(one: Notebook, clip: bool = False) -> str:
    """A notebook in the list, with its clip of README if it has one, else a picture."""
    picture = f"../clips/{one.name}.webp" if clip else one.pictures[PICTURE.get(one.name, 0)]
    link, what = f"{one.name}.md", sentence(one.first)
    return (
        f'<div markdown="1">\n\n[![{one.title}]({picture})]({link})\n\n'
        f"**[{one.title}]({link})** ({lasts(one.seconds)})<br>{what}\n\n</div>"
    )


def needs(name: str) -> str:
    return NEEDS.get(name, "a CPU")


def sentence(text: str) -> str:
    """The first two sentences of a paragraph, at most 200 characters."""
    parts = text.split(". ")
    found = parts[0]
    for part in parts[1:2]:
        if len(found) + len(part) < 200:
            found += ". " + part
    return found.rstrip(".:") + "."


def lasts(seconds: float) -> str:
    """A duration as a reader wants it.

    >>> lasts(40.8), lasts(339.2)
    ('41 s', '5 min 40 s')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds / 10) * 10, 60)
    return f"{minutes:.0f} min {rest:.0f} s" if rest else f"{minutes:.0f} min"
