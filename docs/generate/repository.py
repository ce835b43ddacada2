"""The address of the repository, in one place: `project.urls.Repository` of pyproject.toml.

While it is not set, pages have no links into the repository.
"""

from __future__ import annotations

import tomllib
from pathlib import Path


def address(root: Path) -> str:
    """The repository's address, such as "https://github.com/OWNER/rbjax"; "" if it is not set."""
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    return project.get("urls", {}).get("Repository", "").rstrip("/")


def colab(root: Path, path: str) -> str:
    """The address that opens a notebook of the repository in Colab; "" if it has no address."""
    if not (found := address(root)):
        return ""
    place = found.removeprefix("https://github.com/")
    return f"https://colab.research.google.com/github/{place}/blob/main/{path}"
