"""`python -m docs.generate`: the site's Markdown, as the site generator reads it.

Copies docs/ to .cache/docs, adds the generated pages, and writes .cache/mkdocs.yml: the root's
mkdocs.yml with the order of pages.
"""

from __future__ import annotations

import json
import time

from docs.generate import tree
from docs.generate.markdown.convert import convert
from docs.generate.reference import rooms

OUT = tree.ROOT / ".cache" / "docs"


def main() -> None:
    tree.copy_sources(tree.ROOT, OUT)
    for name in tree.generators():
        start = time.perf_counter()
        found = tree.generated(name, tree.ROOT)
        tree.write(found, OUT)
        print(f"{name}: {len(found)} files, {time.perf_counter() - start:.1f} s")
    links = rooms.links()
    for page in OUT.rglob("*.md"):
        path = page.relative_to(OUT).as_posix()
        page.write_text(convert(page.read_text(), links, path))
    (OUT.parent / "links.json").write_text(json.dumps(links))
    (OUT.parent / "signatures.json").write_text(json.dumps(rooms.signatures()))
    nav = json.dumps(tree.navigation(OUT), ensure_ascii=False, indent=1)
    config = (tree.ROOT / "mkdocs.yml").read_text()
    config = config.replace("paths: [.]", "paths: [..]").replace("[docs/gen", "[../docs/gen")
    (OUT.parent / "mkdocs.yml").write_text(f"{config}\nnav: {nav}\n")


if __name__ == "__main__":
    main()
