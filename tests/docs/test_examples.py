"""The Python blocks of each page run, in one scope, in a temporary folder.

What the blocks of the folders `PRINTED` print is compared with the page: numbers to 10 %, because
machines round differently, and all numbers below 1e-9 are rounding errors.
"""

import contextlib
import io
import re

import matplotlib
import pytest

from tests.docs.pages import FENCE, PAGES, blocks, name, programs

RUN = [page for page in PAGES if blocks(page.read_text())]
#: pages whose programs other tests run
ELSEWHERE = {
    "README.md": "tests/docs/test_readme.py",
    "docs/guides/adapters.md": "tests/envs/adapters/test_page.py",
}

PRINTED = tuple(f"docs/{x}/" for x in ("howto", "start", "theory", "reference", "guides"))
NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?")


def same(printed: str, shown: str) -> bool:
    """Whether two texts have the same words, and numbers that agree."""
    words = [[w.split() for w in NUMBER.split(x)] for x in (printed, shown)]
    numbers = [NUMBER.findall(x) for x in (printed, shown)]
    if words[0] != words[1]:
        return False
    pairs = [(float(a), float(b)) for a, b in zip(*numbers, strict=True)]
    return all(max(abs(a), abs(b)) < 1e-9 or abs(a - b) <= 0.1 * abs(b) for a, b in pairs)


@pytest.fixture(autouse=True)
def settings_of_matplotlib():
    """A page's style ends with it."""
    with matplotlib.rc_context():
        yield


@pytest.mark.parametrize("page", [p for p in RUN if name(p) not in ELSEWHERE], ids=name)
def test_examples_run(page, tmp_path, monkeypatch):
    """A page over a second is listed in tests/slow.txt, with its name in brackets."""
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "figures").mkdir()
    scope: dict = {"__name__": "page"}
    for block, shown in programs(page.read_text()):
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compile(block, name(page), "exec"), scope)
        if name(page).startswith(PRINTED):
            printed = "".join(
                line
                for line in out.getvalue().splitlines(keepends=True)
                if not line.startswith("Failed to import")  # MJX without warp
            )
            assert same(printed, shown or ""), f"the page says:\n{shown}\nit prints:\n{printed}"


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if "{.slow}" in p.read_text()], ids=name)
def test_long_blocks_run(page, tmp_path, monkeypatch):
    """Blocks of a minute, each by itself."""
    monkeypatch.chdir(tmp_path)
    for _, info, code in FENCE.findall(page.read_text()):
        if ".slow" in info:
            exec(compile(code, name(page), "exec"), {"__name__": "page"})


def test_numbers_are_compared():
    assert same("a 1.02 b\n", "a 1.00 b") and same("gap 3e-16", "gap 9e-15")
    assert (
        not same("error 2e-6", "error 4e-6")
        and not same("a 1.2 b", "a 1.0 b")
        and not same("a 1 b", "a 1 c")
    )
    assert not same("1 2", "1")
