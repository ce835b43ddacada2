"""The shapes of a URDF as geoms: cylinders, spheres, capsules, and meshes.

`package://name/path` is looked for in the folders above the file, as no search path is known here:
in one that is named so, and beneath each.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from urllib.parse import unquote

import mujoco

from rbjax.loading.urdf.numbers import number, origin, read_numbers

_ROUND = {
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}
READ = (".stl", ".obj", ".msh")


def add_shapes(spec: mujoco.MjSpec, body: object, link: ET.Element, folder: Path, at: str) -> None:
    """Give a body the collision shapes of its link or, if it has none, the visual ones. Shapes that
    MuJoCo cannot read are left out. at: the place in the file, for messages."""
    for tag in ("collision", "visual"):
        added = [_add(spec, body, shape, folder, at) for shape in link.findall(tag)]
        if any(added):
            return


def _add(spec: mujoco.MjSpec, body: object, shape: ET.Element, folder: Path, at: str) -> bool:
    mesh = shape.find("geometry/mesh")
    found = [(kind, shape.find(f"geometry/{kind}")) for kind in _ROUND]
    given = dict(zip(("pos", "quat"), origin(shape, at), strict=True))
    if shape.tag == "visual":
        given |= {"contype": 0, "conaffinity": 0, "group": 1}
    if mesh is not None:
        path = find_mesh(mesh.get("filename", ""), folder)
        if path is None:
            return False
        scale = read_numbers(mesh, "scale", 3, at, 1.0)
        name = f"{path} {scale}"
        if spec.mesh(name) is None:
            spec.add_mesh(name=name, file=str(path), scale=scale)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **given)
        return True
    for kind, element in found:
        if element is not None:
            size = [number(element, "radius", at), number(element, "length", at) / 2, 0.0]
            body.add_geom(type=_ROUND[kind], size=size, **given)
            return True
    return False


def find_mesh(name: str, folder: Path) -> Path | None:
    """The file that a URDF in a folder means by a name; None if it is absent or not readable."""
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
