"""Numbers of README, the pages and the charts equal those of benchmarks/results."""

import doctest
import re

import pytest

from docs.generate import benchmarks, figures, measured
from docs.generate.figures import kinds
from docs.generate.subjects import TABLES, bars, tables
from docs.generate.tutorials import pages as tutorials
from rbjax import style
from tests import tolerances
from tests.docs.pages import DOCS, prose


def test_typed_numbers_equal_the_results():
    """`python -m docs.generate.figures` mends them."""
    assert not figures.differing()


def test_benchmark_pages_and_charts_are_up_to_date():
    """`python -m docs.generate.benchmarks` mends them."""
    assert not benchmarks.stale()


def test_every_results_file_is_in_a_table_of_a_page():
    shown = {
        name
        for page in benchmarks.FOLDER.glob("*.md")
        for _, name, _ in benchmarks.PLACE.findall(page.read_text())
    }
    assert shown == set(TABLES)
    used = {name for table in TABLES.values() for name in table.names()}
    assert used == set(measured.names())


def test_charts_have_the_colours_of_rbjax():
    assert bars.PALETTE == (
        style.BLUE,
        style.ORANGE,
        style.GREEN,
        style.PURPLE,
        style.RED,
        style.TEAL,
    )
    assert (bars.INK, bars.GRID) == (style.INK, style.GRID)


#: a speed or a ratio of speeds, such as "1.5x", "12 us" and "3 million"
SPEED = re.compile(r"(?<![\w.])\d[\d.,]*(?:x\b| ?(?:us|ns|million|M steps|M/s)\b)(?!<!-- =)")


def unmarked(text: str) -> str:
    """A text without programs, formulas and numbers that name their figure."""
    return re.sub(r"`[^`]*`", "", figures.TYPED.sub("", prose(text)))


@pytest.mark.parametrize("folder", ["guides", "howto", "start", "theory"])
def test_no_speed_is_typed(folder):
    """A speed on these pages is a figure."""
    for page in sorted((DOCS / folder).rglob("*.md")):
        assert not SPEED.findall(unmarked(page.read_text())), page


def test_no_measured_number_of_the_goals_is_typed():
    """Cells of the columns behind "asked" and of "below" have no other numbers."""
    heads, checked = [], 0
    for line in unmarked((DOCS / "develop" / "goals.md").read_text()).splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if "|" in line else []
        heads = cells if cells and not heads else heads if cells else []
        for head, cell in zip(heads[1:], cells[1:], strict=True):
            if head not in ("asked", "test") and cell not in (head, "---"):
                checked += 1
                assert not re.search(r"(?<![A-Za-z])\d", cell), line
    assert checked > 100


def test_a_wrong_number_is_found(tmp_path):
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("at 12<!-- = gpu.contact.go1.rollout --> million")
    (found,) = figures.differing(tmp_path)
    assert "README.md" in found and "12" in found


def test_a_tolerance_and_a_cell_are_read():
    assert kinds.Held("body/test_tops.py", "TOLERANCE = ").value() == 1e-11
    assert kinds.Held("forces/test_pid.py", "))) < ").value() == tolerances.F64_PARITY
    page = "benchmarks/work-precision.md"
    assert kinds.Cell(page, ("pendulum", "H200"), "mjx/rbjax").value() > 10
    for missing in (kinds.Held("body/test_tops.py", "BOUND = "), kinds.Cell(page, ("rope",), "on")):
        with pytest.raises(LookupError, match=r"no (number|row)"):
            missing.value()


def test_a_page_without_its_table_is_stale():
    filled = benchmarks.filled("<!-- table: mpc -->\n<!-- end -->")
    assert "| ticks |" in filled and filled == benchmarks.filled(filled)


@pytest.mark.parametrize("module", [figures, measured, tables, tutorials])
def test_examples_of_the_generators(module):
    assert doctest.testmod(module).failed == 0
