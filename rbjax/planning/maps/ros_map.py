"""Maps of ROS: a YAML file with the parameters, and an image with the cells.

A pixel of value x has the probability of being occupied p = (255 - x) / 255, or x / 255 with
`negate`. It is occupied if p > occupied_thresh, free if p < free_thresh, and unknown otherwise. The
first row of the image has the largest y; `origin` is the pose of the image's lower left corner.
(ROS, *map_server* and *nav2_map_server*, map format, modes trinary and scale)
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from rbjax.errors import InputError, UnknownName
from rbjax.optional import require

KEYS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
MODES = ("trinary", "scale")
UNKNOWN = ("occupied", "free")


def read(file: Any, unknown: str) -> tuple[np.ndarray, float, tuple[float, float]]:
    """Read a map: the occupied cells (nx, ny), the resolution in m, and the origin (2,) in m."""
    where = f"OccupancyGrid.from_ros({str(file)!r})"
    if unknown not in UNKNOWN:
        raise UnknownName("unknown=", unknown, UNKNOWN)
    try:
        text = Path(file).read_text()
    except (OSError, TypeError, UnicodeDecodeError) as error:
        raise InputError(f"{where}: {error}; expected a map.yaml of ROS's map_server") from error
    given = fields(text)
    missing = [key for key in KEYS if key not in given]
    if missing:
        raise InputError(f"{where}: the keys {missing} are missing, expected {list(KEYS)}")
    mode = str(given.get("mode", "trinary")).lower()
    if mode not in MODES:
        raise UnknownName("mode of a map", mode, MODES)
    resolution = _number(where, "resolution", given["resolution"], 0.0, math.inf)
    occupied, free = (
        _number(where, key, given[key], -1e-12, 1.0) for key in ("occupied_thresh", "free_thresh")
    )
    if free > occupied:
        raise InputError(
            f"{where}: free_thresh {free} is above occupied_thresh {occupied}, expected it below"
        )
    origin = given["origin"]
    if not isinstance(origin, list) or len(origin) not in (2, 3):
        raise InputError(f"{where}: origin is {origin!r}, expected [x, y, yaw]")
    x, y, *yaw = (_number(where, "origin", v, -math.inf, math.inf) for v in origin)
    if any(yaw):
        raise InputError(
            f"{where}: the map is turned by yaw = {yaw[0]} rad, expected 0; turn the image, or "
            "plan in the frame of the map"
        )
    image = _image(where, Path(file).parent / str(given["image"]))
    p = image if _flag(where, given["negate"]) else 1.0 - image
    solid = p > occupied if unknown == "free" else ~(p < free)
    return solid[::-1].T, resolution, (x, y)


def fields(text: str) -> dict[str, Any]:
    """Parse a flat YAML file: scalars as text, lists in either style."""
    out: dict[str, Any] = {}
    key = None
    for line in text.splitlines():
        line = line.split(" #")[0].rstrip()
        if not line.strip() or line.lstrip().startswith(("#", "---")):
            continue
        if line.lstrip().startswith("- ") and key is not None:
            if not isinstance(out[key], list):
                out[key] = []
            out[key].append(_scalar(line.lstrip()[2:]))
        elif ":" in line:
            key, _, value = line.partition(":")
            key, value = key.strip(), value.strip()
            inline = value.startswith("[") and value.endswith("]")
            items = value[1:-1].split(",") if inline else []
            out[key] = [_scalar(x) for x in items] if inline else _scalar(value)
    return out


def _scalar(text: str) -> str:
    return text.strip().strip("'\"")


def _number(where: str, name: str, text: Any, above: float, most: float) -> float:
    try:
        x = float(text)
    except (TypeError, ValueError):
        x = math.nan
    if not (above < x <= most) or math.isinf(x):
        raise InputError(
            f"{where}: {name} is {text!r}, expected a finite number"
            + (f" above {max(above, 0):g}" if above > -1 else "")
            + (f" and up to {most:g}" if math.isfinite(most) else "")
        )
    return x


def _flag(where: str, text: Any) -> bool:
    flags = {"0": False, "1": True, "false": False, "true": True, "no": False, "yes": True}
    if str(text).lower() not in flags:
        raise InputError(f"{where}: negate is {text!r}, expected 0 or 1")
    return flags[str(text).lower()]


def _image(where: str, path: Path) -> np.ndarray:
    """Read an image as pixels between 0 and 1, the mean over channels."""
    pillow = require(where, "PIL.Image", "give the cells to OccupancyGrid")
    try:
        with pillow.open(path) as opened:
            image = opened.convert("L") if opened.mode in ("1", "P") else opened
            pixels = np.asarray(image, float)
            full = 65535.0 if image.mode.startswith("I") else 255.0
    except (OSError, ValueError, SyntaxError) as error:  # as Pillow's readers raise them
        raise InputError(f"{where}: image: {error}; expected a PGM or PNG file") from error
    return (pixels.mean(-1) if pixels.ndim == 3 else pixels) / full
