"""Docstrings of the package drawn at random, for a reading by someone who has not seen the code.

    python -m tests.docstring_sample [COUNT] [SEED]

prints COUNT docstrings (100) with the file, the line and the signature of their function or class.
The reader marks each one that needs a second reading.
"""

from __future__ import annotations

import ast
import random
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1] / "rbjax"


def docstrings() -> Iterator[tuple[str, str, str]]:
    """Place, signature and docstring of each function and class, in a stable order."""
    for path in sorted(ROOT.rglob("*.py")):
        source = path.read_text()
        for node in ast.walk(ast.parse(source)):
            if not isinstance(node, ast.FunctionDef | ast.ClassDef):
                continue
            text = ast.get_docstring(node)
            if text is None:
                continue
            head = ast.get_source_segment(source, node) or ""
            first = node.body[0].lineno - node.lineno
            place = f"{path.relative_to(ROOT.parent)}:{node.lineno}"
            yield place, "\n".join(head.splitlines()[:first]), text


def main() -> None:
    given = [int(x) for x in sys.argv[1:]]
    count, seed = (given + [100, 0][len(given) :])[:2]
    for place, head, text in random.Random(seed).sample(list(docstrings()), count):
        print(f"--- {place}\n{head}\n{text}\n")


if __name__ == "__main__":
    main()
