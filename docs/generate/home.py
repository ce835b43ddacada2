"""The home page of the site: README, with its links as of the site."""

from __future__ import annotations

import re
from pathlib import Path

from docs.generate import tree


def pages(root: Path) -> tree.Pages:
    return {"index.md": home((root / "README.md").read_text())}


def home(readme: str) -> str:
    """README without the comments that its figures are made from, and with links to pages."""
    text = re.sub(r"<!--.*?-->", "", readme, flags=re.DOTALL)
    text = re.sub(r"<source [^>]*>|</?picture>", "", text)  # the style sheet has dark pictures
    text = re.sub(r"(\]\(|src=\")docs/", r"\1", text)
    text = re.sub(r"\]\(notebooks/(\w+)\.ipynb\)", r"](tutorials/\1.md)", text)
    text = re.sub(r"\[([^\]]*)\]\((?:LICENSE|CITATION\.cff|CHANGELOG\.md)\)", r"\1", text)
    # a width in pixels is that of GitHub's column
    return re.sub(r'(<img [^>]*?) width="\d+"', r"\1", text)
