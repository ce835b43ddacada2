"""Sections of the report from notebooks: title, first paragraph and figures of each.

A notebook is a script with cells, in the percent format of jupytext. It runs in a separate process
(`python -m rbjax.demo.notebooks SOURCE FOLDER`), because it may change JAX's configuration. The
process saves the figures, and prints their names and captions in JSON as its last line.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from rbjax.demo.report import ReportSection
from rbjax.errors import RbjaxError

#: where the wheel has the notebooks, which stand in `notebooks/` of a checkout
INSTALLED = Path(__file__).parent / "scripts"
#: folder of the notebooks
FOLDER = INSTALLED if INSTALLED.is_dir() else Path(__file__).parents[2] / "notebooks"
#: notebook -> its weight in progress bars
NOTEBOOKS = {
    "forces": 10, "joints": 10, "loops": 15, "wheels": 15, "planning": 10, "gpu_threads": 5,
    "swing_up": 30, "contact": 12, "walking": 12,
}  # fmt: skip


def cells(source: str) -> Iterator[tuple[bool, str]]:
    """Split a notebook into cells. Yield, for each, whether it is code, and its text."""
    for cell in re.split(r"^# %%", source, flags=re.MULTILINE)[1:]:
        head, _, text = cell.partition("\n")
        is_code = "[markdown]" not in head
        yield is_code, text if is_code else re.sub(r"^# ?", "", text, flags=re.MULTILINE).strip()


def notebook(
    folder: Path, say: Callable[[str], None], *, name: str, notebooks: Path = FOLDER
) -> ReportSection:
    """Run a notebook and make a section of the report from it.

    Raises:
        RbjaxError: an error in the notebook.
    """
    source = notebooks / f"{name}.py"
    words = [text for is_code, text in cells(source.read_text()) if not is_code]
    title, _, rest = words[0].partition("\n")
    say(f"notebook: {title.removeprefix('# ')}")
    command = [sys.executable, "-m", "rbjax.demo.notebooks", str(source), str(folder.resolve())]
    package = str(Path(__file__).parents[2])
    path = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"PYTHONPATH": path, "MPLBACKEND": "Agg"}
    run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if run.returncode:
        raise RbjaxError(f"the notebook {source} failed:\n{run.stderr[-2000:]}")
    pictures = json.loads(run.stdout.splitlines()[-1])
    return ReportSection(
        title.removeprefix("# "),
        (rest.strip().split("\n\n")[0].replace("\n", " "),),
        tuple((file, caption) for file, caption in pictures),
        note=f"The figures of the notebook {source.name}, which has the code.",
    )


def run_cells(source: Path, folder: Path) -> list[tuple[str, str]]:
    """Run the cells of a notebook in this process, and save its figures.

    Returns:
        (file name, caption) of each figure. The caption is the last heading before it.
    """
    import matplotlib.pyplot as plt

    scope: dict[str, object] = {"__name__": "__main__", "__file__": str(source)}
    heading = source.stem
    pictures: list[tuple[str, str]] = []
    for is_code, text in cells(source.read_text()):
        if not is_code:
            headings = re.findall(r"^#+ (.*)", text, flags=re.MULTILINE)
            heading = headings[-1] if headings else heading
            continue
        exec(compile(text, str(source), "exec"), scope)
        for number in plt.get_fignums():
            name = f"{source.stem}_{len(pictures) + 1}.png"
            plt.figure(number).savefig(folder / name, bbox_inches="tight", dpi=130)
            plt.close(number)
            pictures.append((name, heading))
    return pictures


if __name__ == "__main__":
    print(json.dumps(run_cells(*map(Path, sys.argv[1:3]))))
