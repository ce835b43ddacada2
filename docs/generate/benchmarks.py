"""Fills the tables and draws the charts of docs/benchmarks, and copies the data to the site.

`python -m docs.generate.benchmarks` writes what stands between `<!-- table: NAME -->` and
`<!-- end -->` of each page, from benchmarks/results and docs/generate/subjects, and the charts of
docs/benchmarks/figures. tests/docs/test_figures.py finds pages that are out of date.
"""

from __future__ import annotations

import re
from pathlib import Path

from docs.generate import measured
from docs.generate.figures import renewed
from docs.generate.subjects import TABLES
from docs.generate.subjects.charts import CHARTS
from docs.generate.subjects.tables import folded

ROOT = measured.ROOT
FOLDER = ROOT / "docs" / "benchmarks"
PLACE = re.compile(r"(<!-- table: ([\w ,-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
#: longer tables are folded
OPEN = 24


def table(name: str) -> str:
    """A table with its origin, folded if it is long."""
    if name not in TABLES:
        raise LookupError(f"no table {name!r}; docs/generate/subjects has {', '.join(TABLES)}")
    text = TABLES[name].markdown()
    lines = sum(line.startswith("| ") for line in text.splitlines()) - 2
    if lines <= OPEN:
        return f"\n{text}\n\n"
    return f"\n{folded(f'table of {lines} rows', text)}\n\n"


def filled(markdown: str) -> str:
    """A page with its tables and its typed figures as the results are now."""
    return renewed(PLACE.sub(lambda found: found[1] + table(found[2]) + found[3], markdown))


def files() -> dict[Path, str]:
    """Every page and chart of docs/benchmarks as it should be."""
    out = {page: filled(page.read_text()) for page in sorted(FOLDER.glob("*.md"))}
    return out | {FOLDER / "figures" / name: chart.svg() for name, chart in CHARTS.items()}


def stale() -> list[str]:
    """Pages and charts that differ from the results."""
    return [
        str(path.relative_to(ROOT))
        for path, text in files().items()
        if not path.exists() or path.read_text() != text
    ]


def pages(root: Path) -> dict[str, bytes]:
    """The data of the benchmarks, in the folder of the pages that link to it."""
    found = sorted((root / "benchmarks" / "results").glob("*.json"))
    return {f"benchmarks/results/{path.name}": path.read_bytes() for path in found}


def main() -> None:
    changed = stale()
    for path, text in files().items():
        path.write_text(text)
    print("\n".join(changed) or "all pages and charts are up to date")


if __name__ == "__main__":
    main()
