"""The shapes of a URDF as geoms: boxes, cylinders, spheres, capsules, and meshes.

The search path of `package://name/path` is unknown. So `name/path` is searched in each folder above
the file, and `path` in a folder above the file with the name of the package.
"""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import mujoco

from rbjax.errors import ModelError
from rbjax.loading.urdf.tree import number, origin, read_numbers

#: number of entries of the size of a shape
_SIZES = {"box": 3, "cylinder": 2, "sphere": 1, "capsule": 2}
_KINDS = {name: getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}") for name in _SIZES}
READ = (".stl", ".obj", ".msh")


def add_shapes(spec: mujoco.MjSpec, body: Any, link: ET.Element, folder: Path, at: str) -> None:
    """Add the round shapes and meshes of a link to its body: collision shapes or, if there are
    none, visual ones. Skip meshes that MuJoCo cannot read. at: place in the file, for messages."""
    for tag in ("collision", "visual"):
        found = [
            _add_mesh(spec, body, shape, folder, at) or _add_primitive(body, shape, at, box=False)
            for shape in link.findall(tag)
        ]
        if any(found):
            return


def add_primitives(body: Any, link: ET.Element, at: str) -> None:
    """Add all shapes of a link with a size, except meshes, to its body."""
    for shape in (*link.findall("collision"), *link.findall("visual")):
        with contextlib.suppress(ModelError):  # the dynamics does not require shapes
            _add_primitive(body, shape, at)


def _given(shape: ET.Element, at: str) -> dict[str, Any]:
    """Return the pose and the collision masks of a shape, with MuJoCo's masks for a URDF."""
    given = dict(zip(("pos", "quat"), origin(shape, at), strict=True))
    seen = {"contype": 0, "conaffinity": 0, "group": 1}
    return given | (seen if shape.tag == "visual" else {})


def _add_mesh(spec: mujoco.MjSpec, body: Any, shape: ET.Element, folder: Path, at: str) -> bool:
    mesh = shape.find("geometry/mesh")
    path = None if mesh is None else find_mesh(mesh.get("filename", ""), folder)
    if path is None:
        return False
    scale = read_numbers(mesh, "scale", 3, at, 1.0)
    name = f"{path} {scale}"
    if spec.mesh(name) is None:
        spec.add_mesh(name=name, file=str(path), scale=scale)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **_given(shape, at))
    return True


def _add_primitive(body: Any, shape: ET.Element, at: str, *, box: bool = True) -> bool:
    for name, kind in _KINDS.items():
        element = shape.find(f"geometry/{name}")
        if element is not None and (box or name != "box"):
            size: Any
            if name == "box":
                size = read_numbers(element, "size", 3, at) / 2
            else:
                radius, length = (number(element, key, at) for key in ("radius", "length"))
                size = [radius, length / 2, 0.0]
            if min(size[: _SIZES[name]]) <= 0 and box:
                return False
            body.add_geom(type=kind, size=size, **_given(shape, at))
            return True
    return False


def find_mesh(name: str, folder: Path) -> Path | None:
    """Find the mesh file of a name in a URDF; None if it is absent or not readable."""
    name = unquote(name)
    folder = folder.resolve()
    places: list[Path] = []
    if name.startswith("package://"):
        package, _, rest = name[len("package://") :].partition("/")
        for above in (folder, *folder.parents):
            places += [above / rest] if above.name == package else [above / package / rest]
    else:
        places.append(folder / name.removeprefix("file://"))
    found = (p for p in places if p.suffix.lower() in READ and p.is_file())
    return next(found, None)
