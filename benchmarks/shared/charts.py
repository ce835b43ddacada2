"""Charts at the size at which a page of the documentation shows them, about 720 pixels wide."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from PIL import Image

#: width in inches; at 130 dots an inch, text of 9 points is then as large as that of the page
PAGE = 8.4


def save_chart(figure: Any, path: Path, colors: int = 128) -> None:
    """Write a figure as a PNG and close it. Few colours make a small file; 0 keeps all."""
    figure.savefig(path)
    plt.close(figure)
    if not colors:
        return
    picture = Image.open(path).convert("RGB")
    picture.quantize(colors, dither=Image.Dither.NONE).save(path, optimize=True)


def saved(pattern: str) -> list[dict[str, Any]]:
    """The rows of the results file that matches, such as "work-formulations-*.json"."""
    (path,) = sorted((Path(__file__).parents[1] / "results").glob(pattern))
    return json.loads(path.read_text())["rows"]
