"""The Python blocks of each page run, in one scope, in a temporary folder."""

import matplotlib
import pytest

from tests.docs.pages import PAGES, blocks, name

RUN = [page for page in PAGES if blocks(page.read_text())]
#: pages whose programs other tests run
ELSEWHERE = {
    "README.md": "tests/docs/test_readme.py",
    "docs/guides/adapters.md": "tests/envs/adapters/test_page.py",
}


@pytest.mark.parametrize("page", [p for p in RUN if name(p) not in ELSEWHERE], ids=name)
def test_examples_run(page, tmp_path, monkeypatch):
    """A page over a second is listed in tests/slow.txt, with its name in brackets."""
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "figures").mkdir()
    scope: dict = {"__name__": "page"}
    for block in blocks(page.read_text()):
        exec(compile(block, name(page), "exec"), scope)
