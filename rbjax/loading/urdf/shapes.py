"""The shapes of a URDF that MuJoCo can read: cylinders, spheres, capsules, and meshes it finds.

`package://name/path` is looked for in the folders above the file, as no search path is known here:
in one that is named so, and beneath each.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from urllib.parse import unquote

ROUND = ("cylinder", "sphere", "capsule")
READ = (".stl", ".obj", ".msh")


def take_shapes(link: ET.Element, folder: Path | None) -> None:
    """Remove a link's shapes; with the folder of the file only those that MuJoCo cannot read, and
    those that are only seen if others stay.

    Names of meshes that stay are absolute paths afterwards.
    """
    stay = False
    for shape in (*link.findall("collision"), *link.findall("visual")):
        if folder is None or (stay and shape.tag == "visual") or not _stays(shape, folder):
            link.remove(shape)
        else:
            for material in shape.findall("material"):
                shape.remove(material)
            stay = True


def _stays(shape: ET.Element, folder: Path) -> bool:
    mesh = shape.find("geometry/mesh")
    if mesh is None:
        return any(shape.find(f"geometry/{kind}") is not None for kind in ROUND)
    path = find_mesh(mesh.get("filename", ""), folder)
    if path is not None:
        mesh.set("filename", str(path))
    return path is not None


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
