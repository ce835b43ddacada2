"""The pages of the notebooks: text, code, outputs, pictures and times of the executed files."""

import base64
import json

import pytest

from docs.generate import repository
from docs.generate.tutorials import notebooks
from docs.generate.tutorials import pages as tutorials
from tests.docs.pages import ROOT


def write(path, *cells):
    path.write_text(json.dumps({"cells": list(cells)}))
    return path


def code(source, *found, begin=None, end=None):
    times = {"iopub.execute_input": begin, "shell.execute_reply": end} if begin else {}
    return {"cell_type": "code", "source": source, "outputs": list(found),
            "metadata": {"execution": times}}  # fmt: skip


def text(source):
    return {"cell_type": "markdown", "source": source, "metadata": {}}


def shown(kind, data):
    return {"output_type": "display_data", "data": {"text/plain": "a thing", kind: data}}


def test_text_code_and_outputs_in_their_order(tmp_path):
    picture = base64.b64encode(b"a picture").decode()
    path = write(
        tmp_path / "one.ipynb",
        text("# Title\n\nFirst sentence. Second."),
        code("print(1)", {"output_type": "stream", "text": "\x1b[31mred\x1b[0m\n"},
             shown("image/png", picture)),
        text("## Later\nwords"),
        code("x", shown("text/plain", "3"), shown("text/html", "<script>play()</script>")),
    )  # fmt: skip
    found = notebooks.read(path)
    assert (found.title, found.first) == ("Title", "First sentence. Second.")
    assert found.body[1] == "```python\nprint(1)\n```" and found.body[2] == "```text\nred\n```"
    assert found.body[3] == "![Title](one-1.png)" and found.files["one-1.png"] == b"a picture"
    assert found.body[6] == "```text\n3\n```"
    assert 'data="../one-2.html"' in found.body[7] and "play()" in str(found.files["one-2.html"])


def test_an_error_in_a_notebook_is_named(tmp_path):
    error = {"output_type": "error", "ename": "ValueError", "evalue": "no"}
    path = write(tmp_path / "one.ipynb", text("# Title"), code("x", error))
    with pytest.raises(ValueError, match=r"one.ipynb has an error: ValueError: no"):
        notebooks.read(path)


def test_the_time_is_from_the_first_cell_to_the_last(tmp_path):
    path = write(
        tmp_path / "one.ipynb",
        text("# Title"),
        code("a", begin="2026-11-23T10:00:01Z", end="2026-11-23T10:00:02Z"),
        code("b", begin="2026-11-23T10:00:30Z", end="2026-11-23T10:01:01Z"),
    )
    found = notebooks.read(path)
    assert (found.seconds, found.date) == (60.0, "2026-11-23")


def test_every_notebook_has_a_page_with_time_and_source():
    found = tutorials.pages(ROOT)
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        page = found[f"tutorials/{path.stem}.md"]
        assert "Runs in " in page and "Runs in 0 s" not in page
        assert f"tutorials/files/{path.stem}.py" in found
        assert ("colab.research.google.com" in page) == bool(repository.address(ROOT))
        assert f"({path.stem}.md)" in found["tutorials/index.md"]


def test_links_to_colab_follow_the_address_of_the_repository(tmp_path):
    (tmp_path / "pyproject.toml").write_text(
        '[project.urls]\nRepository = "https://github.com/someone/rbjax/"\n'
    )
    found = repository.colab(tmp_path, "notebooks/a.ipynb")
    assert found.endswith("/github/someone/rbjax/blob/main/notebooks/a.ipynb")
