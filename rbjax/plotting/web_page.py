"""A film as one self-contained HTML page, drawn by WebGL 2 without other files or a network.

`page.html` has the layout and `page.js` the program. Arrays are compressed by zlib, in base64:

    vertices    points and normals (n, 6), f32, in the frame of the body of each vertex
    colors      (n, 4), bytes
    bodies      (n,), of the vertices; 65535 for the world
    poses       (F, bodies, 7) of the first sample: position, quaternion; f32
    ghosts      (frames, samples - 1, bodies, 7) of the others, 16-bit integers: differences between
                successive frames of positions in units of `unit` from `origin`, and of quaternions
                in units of 1/2047; first all low bytes, then all high bytes
"""

from __future__ import annotations

import base64
import html
import json
import zlib
from importlib import resources
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.plotting.film import Film
from rbjax.plotting.surfaces import surface
from rbjax.rotations import quaternion
from rbjax.style import RED

Array = np.ndarray
#: bytes of the poses of all ghosts before compression; with more, frames are left out
_MOST_BYTES = 32_000_000
#: with more samples the surfaces of ghosts are coarse
CROWD = 48
_WORLD = 65535
#: unit of positions of ghosts, relative to the picture
_FINE = 2e-4


def write_page(path: Path, film: Film, title: str, *, fps: float, speed: float) -> None:
    """Write a film as one HTML page. speed: seconds of motion per second of the page."""
    path.write_text(page_text(page_data(film, fps, speed), title))


def page_text(data: dict[str, Any], title: str) -> str:
    """Return the page of `page_data`."""

    def read(name: str) -> str:
        return resources.files("rbjax.plotting").joinpath(name).read_text()

    text = read("page.html").replace("__SCRIPT__", read("page.js"))
    text = text.replace("__TITLE__", html.escape(title or "rbjax"))
    return text.replace("__DATA__", json.dumps(data))


def page_data(film: Film, fps: float, speed: float) -> dict[str, Any]:
    """Return the data of a page, as the script reads it."""
    samples, frames, bodies = film.p.shape[:3]
    poses = np.concatenate([film.p, quaternion.from_matrix(jnp.asarray(film.R))], -1)
    middle = film.centre if film.middle is None else film.middle
    crowd = samples > CROWD
    return {
        "fps": fps,
        "speed": speed,
        "start": float(film.ts[0]),
        "frames": frames,
        "samples": samples,
        "bodies": bodies,
        "azimuth": film.camera.azimuth,
        "elevation": film.camera.elevation,
        "floor": film.floor,
        "size": film.size.tolist(),
        "follow": film.follow,
        "centre": _packed(film.centre if film.follow else film.centre[:1], "<f4"),
        "middle": _packed(middle, "<f4"),
        "robot": _mesh(film, coarse=False),
        "crowd": _mesh(film, coarse=True) if crowd else None,
        "poses": _packed(poses[0], "<f4"),
        "ghosts": _ghosts(poses[1:], float(film.size.max())) if samples > 1 else None,
        "paths": [_packed(p, "<f4") for p in film.paths],
        "strong": film.strong,
        "pushes": 0 if film.arrows is None else film.arrows.shape[1],
        "arrows": "" if film.arrows is None else _packed(film.arrows, "<f4"),
        "force": [int(RED[k : k + 2], 16) for k in (1, 3, 5)],
    }


def _mesh(film: Film, *, coarse: bool) -> dict[str, Any]:
    """Merge the surfaces of all solids. Triangles are in four groups: of the robot and of the
    world, opaque and translucent."""
    groups: dict[str, list[Array]] = {"robot": [], "clear": [], "world": [], "glass": []}
    vertices, colors, owners, count = [], [], [], 0
    for s in film.shapes:
        own = surface(s, film.R[0, 0], film.p[0, 0], coarse=coarse)
        if own is None or (coarse and s.body < 0):
            continue
        fixed, opaque = s.body < 0, s.alpha >= 0.99 or s.end is not None
        name = ("world" if opaque else "glass") if fixed else ("robot" if opaque else "clear")
        groups[name].append(own.triangles + count)
        vertices.append(np.concatenate([own.points, own.normals], -1))
        color = np.round(255 * np.array([*s.color, s.alpha])).clip(0, 255)
        colors.append(np.tile(color, (len(own.points), 1)))
        owners.append(own.bodies)
        count += len(own.points)
    indices = {name: np.concatenate(x) if x else np.zeros((0, 3)) for name, x in groups.items()}
    body = np.concatenate(owners) if owners else np.zeros(0)
    return {
        "vertices": _packed(np.concatenate(vertices), "<f4"),
        "colors": _packed(np.concatenate(colors), "u1"),
        "bodies": _packed(np.where(body < 0, _WORLD, body), "<u2"),
        "triangles": {name: _packed(x, "<u4") for name, x in indices.items()},
    }


def _ghosts(poses: Array, size: float) -> dict[str, Any]:
    """Round the poses (S, F, n, 7) of the samples after the first. With many of them only every
    k-th frame is kept. size: of the picture, m."""
    every = max(1, int(np.ceil(2 * poses.size / _MOST_BYTES)))
    kept = np.moveaxis(poses[:, ::every], 0, 1)
    low, high = kept[..., :3].min((0, 1, 2)), kept[..., :3].max((0, 1, 2))
    unit = np.maximum((high - low) / 65535, _FINE * size)
    place = np.round((kept[..., :3] - low) / unit) - 32768
    turn = np.round(2047 * kept[..., 3:])
    rounded = np.concatenate([place, turn], -1).astype("<i2")
    steps = np.diff(rounded, axis=0, prepend=np.zeros_like(rounded[:1]))  # wraps around
    return {
        "every": every,
        "frames": len(rounded),
        "origin": (low + 32768 * unit).tolist(),
        "unit": unit.tolist(),
        "poses": _packed(np.ascontiguousarray(steps).view("u1").reshape(-1, 2).T, "u1"),
    }


def _packed(x: Any, dtype: str) -> str:
    return base64.b64encode(zlib.compress(np.ascontiguousarray(x, dtype).tobytes(), 6)).decode()
