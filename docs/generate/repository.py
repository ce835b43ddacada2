"""The address of the repository, in one place: `project.urls.Repository` of pyproject.toml."""

from __future__ import annotations

import tomllib
from pathlib import Path

#: until the repository is public
PLACEHOLDER = "https://github.com/OWNER/rbjax"


def address(root: Path) -> str:
    """The repository's address, such as "https://github.com/OWNER/rbjax"."""
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    return project.get("urls", {}).get("Repository", PLACEHOLDER).rstrip("/")


def colab(root: Path, path: str) -> str:
    """The address that opens a notebook of the repository in Colab."""
    place = address(root).removeprefix("https://github.com/")
    return f"https://colab.research.google.com/github/{place}/blob/main/{path}"
