"""The oldest versions of its packages that rbjax accepts, as constraints of pip: a line a package.

python tests/oldest.py > oldest.txt
pip install --editable '.[test]' --constraint oldest.txt
"""

import re
import tomllib
from pathlib import Path

#: extras whose packages rbjax imports, each beside the oldest versions of all others
EXTRAS = ("plots", "cli", "stability")


def constraints() -> list[str]:
    """Return "name==version" for each required or optional package with a lower bound."""
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    extras = [x for name in EXTRAS for x in project["optional-dependencies"][name]]
    pairs = (re.match(r"([\w-]+)>=([\d.]+)", x) for x in [*project["dependencies"], *extras])
    return [f"{x[1]}=={x[2]}" for x in pairs if x]


if __name__ == "__main__":
    print("\n".join(constraints()))
