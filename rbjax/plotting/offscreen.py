"""MuJoCo's renderer without a window, in a separate process.

MuJoCo chooses the OpenGL backend from the environment when it is first imported, and a missing
driver may end the process. So another process renders. It tries EGL, then OSMesa, unless the
variable `MUJOCO_GL` selects one. The environment of this process does not change.

The file has no beams of `Model.with_beam`. Capsules are added to the scene for their segments.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from rbjax.loading import compile_model
from rbjax.plotting.film import Film

# Reads a folder's model.mjb, q.npy, tubes.npz, view.json; writes raw pictures to standard output.
_PROGRAM = """
import json, sys
import mujoco, numpy as np
folder = sys.argv[1]
m = mujoco.MjModel.from_binary_path(f"{folder}/model.mjb")
q, view = np.load(f"{folder}/q.npy"), json.load(open(f"{folder}/view.json"))
tubes = np.load(f"{folder}/tubes.npz")
width, height = view["size"]
m.vis.global_.offwidth, m.vis.global_.offheight = width, height
d, camera = mujoco.MjData(m), mujoco.MjvCamera()
camera.azimuth, camera.elevation = view["azimuth"], view["elevation"]
camera.distance = view["distance"]
m.vis.map.zfar = max(m.vis.map.zfar, 4 * view["distance"] / m.stat.extent)
with mujoco.Renderer(m, height, width) as renderer:
    for row, centre, ends in zip(q, view["centre"], tubes["ends"]):
        d.qpos[:] = row[:m.nq]  # joints added to the model follow
        mujoco.mj_forward(m, d)
        camera.lookat[:] = centre
        renderer.update_scene(d, camera)
        scene, kind, none = renderer.scene, mujoco.mjtGeom.mjGEOM_CAPSULE, np.zeros(3)
        for (a, b), radius, color in zip(ends, tubes["radius"], tubes["color"]):
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, kind, none, none, np.eye(3).ravel(), color)
            mujoco.mjv_connector(geom, kind, radius, a, b)
            scene.ngeom += 1
        sys.stdout.buffer.write(renderer.render().tobytes())
"""


def render(
    source: Any, floating_base: bool, q: np.ndarray, film: Film, size: tuple[int, int]
) -> Iterator[np.ndarray] | None:
    """Render pictures (height, width, 3) of configurations q (F, nq) of a robot file.

    Return None, with a warning, if no OpenGL backend renders without a display.
    """
    chosen = os.environ.get("MUJOCO_GL")
    for gl in [chosen] if chosen else ["egl", "osmesa"]:
        with tempfile.TemporaryDirectory() as folder:
            _write(Path(folder), source, floating_base, q[:1], film, size)
            tried = _start(folder, gl)
            _, said = tried.communicate()
        if tried.returncode == 0:
            return _pictures(gl, source, floating_base, q, film, size)
    last = said.decode(errors="replace").strip().splitlines()
    warnings.warn(
        "MuJoCo's renderer does not work here without a display "
        f"(MUJOCO_GL={gl}: {last[-1] if last else 'it ended without a word'}); "
        "the geoms are drawn by rbjax instead. Installing libegl1 or libosmesa6 may help.",
        stacklevel=3,
    )
    return None


def _write(
    folder: Path, source: Any, floating_base: bool, q: np.ndarray, film: Film, size: Any
) -> None:
    m = compile_model(source, floating_base=floating_base)
    mujoco.mj_saveModel(m, str(folder / "model.mjb"))
    np.save(folder / "q.npy", np.asarray(q, float))
    ends, radius, color = _tubes(film)
    np.savez(folder / "tubes.npz", ends=ends, radius=radius, color=color)
    # the distance fits the film's height; MuJoCo's azimuth is the direction of view
    half = max(film.size[1], film.size[0] * size[1] / size[0]) / 2
    view = {
        "size": list(size),
        "azimuth": film.camera.azimuth + 180.0,
        "elevation": -film.camera.elevation,
        "distance": float(1.15 * half / np.tan(np.radians(m.vis.global_.fovy) / 2)),
        "centre": film.centre.tolist(),
    }
    (folder / "view.json").write_text(json.dumps(view))


def _tubes(film: Film) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the segments of flexible links of the first sample: ends (F, n, 2, 3), m, radius (n,),
    m, of a circle with the area of the section, and colour (n, 4)."""
    tubes = [s for s in film.shapes if s.end is not None]
    at = np.array([(s.body, s.end) for s in tubes], int).reshape(-1, 2)
    sizes = [np.linalg.norm(s.points, axis=-1) for s in tubes]
    radius = np.array([np.sqrt(x.min() * x.max()) for x in sizes])
    color = np.array([(*s.color, s.alpha) for s in tubes], np.float32).reshape(-1, 4)
    return film.p[0][:, at], radius, color


def _start(folder: str, gl: str | None) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, folder],
        env=os.environ | {"MUJOCO_GL": gl or ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def _pictures(
    gl: str | None, source: Any, floating_base: bool, q: np.ndarray, film: Film, size: Any
) -> Iterator[np.ndarray]:
    width, height = size
    with tempfile.TemporaryDirectory() as folder:
        _write(Path(folder), source, floating_base, q, film, size)
        with _start(folder, gl) as process:
            assert process.stdout is not None
            for _ in range(len(q)):
                data = process.stdout.read(3 * width * height)
                yield np.frombuffer(data, np.uint8).reshape(height, width, 3)
