"""A film as one HTML page that needs no network: solids, poses, and a script that draws them."""

from __future__ import annotations

import base64
import html
import json
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from rbjax.plotting.drawing import FADED
from rbjax.plotting.film import Film
from rbjax.rotations import quaternion


def write(path: Path, film: Film, title: str, *, fps: float, speed: float) -> None:
    """Write a film; poses as 32-bit floats, position and quaternion, in base64."""
    data: dict[str, Any] = {
        "fps": fps,
        "speed": speed,
        "faded": FADED,
        "start": float(film.ts[0]),
        "frames": len(film.ts),
        "samples": len(film.R),
        "bodies": film.p.shape[2],
        "azimuth": film.camera.azimuth,
        "elevation": film.camera.elevation,
        "floor": film.floor,
        "size": film.size.tolist(),
        "solids": [
            {
                "body": s.body,
                "color": [round(255 * c) for c in s.color],
                "alpha": s.alpha,
                "points": _packed(s.points),
            }
            for s in film.shapes
        ],
        "poses": _packed(np.concatenate([film.p, quaternion.from_matrix(film.R)], -1)),
        "centre": _packed(film.centre),
        "paths": [_packed(p) for p in film.paths],
        "strong": film.strong,
    }
    text = resources.files("rbjax.plotting").joinpath("page.html").read_text()
    text = text.replace("__TITLE__", html.escape(title or "rbjax"))
    path.write_text(text.replace("__DATA__", json.dumps(data)))


def _packed(x: np.ndarray) -> str:
    return base64.b64encode(np.asarray(x, "<f4").tobytes()).decode()
