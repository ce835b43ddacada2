"""The oldest versions of its packages that rbjax accepts, as constraints of pip: a line a package.

python tests/oldest.py > oldest.txt
pip install --editable '.[test]' --constraint oldest.txt
"""

import re
import tomllib
from pathlib import Path


def constraints() -> list[str]:
    """ "name==version" for each dependency with a lower bound."""
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    pairs = (re.match(r"([\w-]+)>=([\d.]+)", x) for x in project["dependencies"])
    return [f"{x[1]}=={x[2]}" for x in pairs if x]


if __name__ == "__main__":
    print("\n".join(constraints()))
