"""Write the clips and the strip of README: `python -m docs.generate.pictures [NAME ...]`.

`--dark` writes only the dark variants of the stored pictures.
"""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import numpy as np

from docs.generate.pictures import motions, plane
from docs.generate.pictures.painting import save, save_dark

FOLDER = Path(__file__).parents[2] / "clips"
CLIPS = {
    f.__name__: f
    for f in (
        motions.walking_policy, motions.contact, plane.parking_a_trailer, motions.flexible,
        plane.first_hour, motions.swing_up, motions.loops, motions.through_a_gate,
        motions.tumbling_body,
    )
}  # fmt: skip
#: the panels of the strip, 152 x 150 each, with white gaps
STRIP = ("walking_policy", "contact", "parking_a_trailer", "flexible", "first_hour")


def frames_of(name: str) -> list[np.ndarray]:
    """The frames of a clip, or of the strip: clips side by side."""
    if name != "strip":
        return list(CLIPS[name]((270, 180)))
    panels = [list(CLIPS[panel]((152, 150))) for panel in STRIP]
    gap = np.full((150, 10, 3), 255, np.uint8)
    rows = (
        [x for part in parts for x in (gap, part[..., :3])] for parts in zip(*panels, strict=True)
    )
    return [np.concatenate(row[1:], axis=1) for row in rows]


def main(arguments: list[str]) -> None:
    """Write the named clips, or all of them and the strip."""
    names = [name for name in arguments if name != "--dark"]
    for name in names or [*CLIPS, "strip"]:
        path, most = FOLDER / f"{name}.webp", 1_000_000 if name == "strip" else 150_000
        if "--dark" not in arguments:
            save(frames_of(name), path, most)
        save_dark(path, most)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(sys.argv[1:])
