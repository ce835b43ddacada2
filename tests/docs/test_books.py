"""Each row of the table of the books' sections names code; test_names finds that it exists."""

import re

from tests.docs.pages import DOCS

PAGE = (DOCS / "theory" / "index.md").read_text()


def test_every_row_names_code():
    rows = [line for line in PAGE.splitlines() if re.match(r"\| [\dA-D]", line)]
    assert len(rows) > 60
    without = [row for row in rows if not re.search(r"`[\w/]+\.py:\w", row)]
    assert not without, without
