"""Robot files compiled by MuJoCo: reading, error messages with a fix, missing mesh files.

A missing mesh is ignored if it is only visual. It is an error if a mass is computed from it.
"""

from __future__ import annotations

import math
import posixpath
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import mujoco

from rbjax.errors import ModelError, UnknownName
from rbjax.loading.mjcf.cables import read_with_cables
from rbjax.loading.mjcf.fields import message_of
from rbjax.loading.urdf.inertials import write_inertials
from rbjax.loading.urdf.reader import Mimics, read_urdf
from rbjax.loading.urdf.tree import is_urdf

_LONG = 300  # largest number of characters of a path in a message
_SCENES = Path(__file__).parent / "scenes"


def scenes() -> tuple[str, ...]:
    """List the names of the bundled scenes, for `load`.

    Returns:
        The names, for `rb.load`.

    Example:
        >>> import rbjax as rb
        >>> "cart_pole" in rb.scenes()
        True
    """
    return tuple(sorted(p.stem for p in _SCENES.glob("*.xml")))


def compile_model(
    source: Any, *, floating_base: bool | None = False, shapes: Collection[str] = ()
) -> mujoco.MjModel:
    """Compile the `mujoco.MjModel` of any source that `load` accepts.

    floating_base: None lets a URDF float, and does not change MJCF.
    shapes: links of a URDF whose shapes are compiled.
    """
    return compile_source(source, floating_base=floating_base, shapes=shapes)[0]


def compile_source(
    source: Any, *, floating_base: bool | None, shapes: Collection[str] | None = ()
) -> tuple[mujoco.MjModel, str, Mimics, tuple[str, ...]]:
    """Compile a source; return the model, and for a URDF a text about impossible inertials, the
    mimic joints, and the entries of `Model.dropped`.

    shapes: links of a URDF whose shapes are compiled; None for all shapes except meshes.
    """
    if isinstance(source, mujoco.MjModel):
        return source, "", Mimics(), ()
    name, spec = describe(source), spec_of(source)
    if spec is not None:
        if floating_base and not isinstance(source, mujoco.MjSpec):
            raise ModelError(
                f"{name}: floating_base=True is for URDF; in MJCF give the root body a <freejoint/>"
            )
        return _compile(spec, name), "", Mimics(), ()
    text, path = read_text(source)
    folder, floats = Path() if path is None else path.parent, floating_base is not False
    urdf = read_urdf(text, name, floating_base=floats, shapes=shapes, folder=folder)
    compiled = _compile(urdf.spec, name)
    odd = write_inertials(compiled, urdf.inertials, name)
    return compiled, odd, urdf.mimics, urdf.left_out


def spec_of(source: Any) -> mujoco.MjSpec | None:
    """Parse the spec of an MJCF source; return None for a URDF."""
    if isinstance(source, mujoco.MjSpec):
        return source
    if not isinstance(source, (str, Path)):
        raise ModelError(
            f"load: source is {type(source).__name__}, expected a path, an XML string, "
            f"mujoco.MjSpec, mujoco.MjModel or one of the scenes {', '.join(scenes())}"
        )
    text, path = read_text(source)
    name = describe(source)
    if is_urdf(text, name):
        return None
    with_cables = read_with_cables(text, path, name)
    if with_cables is not None:
        return with_cables
    try:
        read = mujoco.MjSpec
        return read.from_string(text) if path is None else read.from_file(str(path))
    except Exception as error:
        raise ModelError(f"{name}: MuJoCo cannot parse it: {message_of(error)}") from error


def read_text(source: str | Path) -> tuple[str, Path | None]:
    """Return the text of a source, and its path if it has one."""
    if isinstance(source, str):
        if source.lstrip().startswith("<"):
            return source, None
        if source in scenes():
            source = _SCENES / f"{source}.xml"
    path = Path(source)
    if not _exists(path):
        if isinstance(source, str) and path.suffix == "":
            raise UnknownName("scene", describe(source), scenes())
        raise ModelError(f"{describe(path)}: no such file; give an existing MJCF or URDF path")
    if not path.is_file():  # reading a device or a pipe may not end
        raise ModelError(f"{path}: not a regular file; give an MJCF or URDF file")
    try:
        raw = path.read_bytes()
        declared = re.match(rb"""\s*<\?xml[^>]*\sencoding=["']([\w.-]+)""", raw)
        return raw.decode(declared[1].decode() if declared else "utf-8"), path
    except (UnicodeDecodeError, LookupError, OSError) as error:
        raise ModelError(
            f"{path}: cannot be read as text ({error}); give an MJCF or URDF file"
        ) from error


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a name that is too long, or contains a zero byte
        return False


def describe(source: Any) -> str:
    if isinstance(source, (mujoco.MjModel, mujoco.MjSpec)):
        return type(source).__name__
    text = str(source)
    if text.lstrip().startswith("<"):
        return "XML string"
    return text if len(text) <= _LONG else f"{text[:_LONG]}... ({len(text):,} characters)"


def _compile(spec: mujoco.MjSpec, name: str) -> mujoco.MjModel:
    """Compile a copy of a spec without missing visual meshes."""
    while True:
        try:
            return spec.compile()
        except Exception as error:
            smaller = _without_missing_mesh(spec, str(error))
            if smaller is None:
                message = f"{name}: MuJoCo cannot compile it: {message_of(error)}"
                raise ModelError(message) from error
            spec = smaller


def _without_missing_mesh(spec: mujoco.MjSpec, message: str) -> mujoco.MjSpec | None:
    """Copy a spec without the mesh, and its geoms, whose file MuJoCo cannot open.

    The mesh is read from MuJoCo's error message, because only MuJoCo has all its search paths: the
    file's folder, `meshdir`, `strippath`, attached models, files in memory. Return None if the
    message is not about a mesh.
    """
    found = re.search(r"Error opening file '(.*)'", message)
    if found is None:
        return None
    spec = spec.copy()
    gone = {m.name for m in spec.meshes if m.file and _mesh_path(spec, m) == _normal(found[1])}
    if not gone:
        return None
    for geom in list(spec.geoms):
        if geom.meshname in gone:
            if _gives_mass(geom):
                raise ModelError(
                    f"body {geom.parent.name!r}: its mass comes from the mesh {geom.meshname!r}, "
                    f"whose file {found[1]!r} is missing (looked for from the folder "
                    f"{spec.modelfiledir or '.'!r}); add the file, or give the body an <inertial>"
                    f"{_unless_overruled(geom.parent)}"
                )
            spec.delete(geom)
    for mesh in list(spec.meshes):
        if mesh.name in gone:
            spec.delete(mesh)
    return spec


def _mesh_path(spec: mujoco.MjSpec, mesh: mujoco._specs.MjsMesh) -> str:
    """Return the path of a mesh as in MuJoCo's messages."""
    file = mesh.file.replace("\\", "/")
    return _normal(
        posixpath.join(mesh.compiler.meshdir, posixpath.basename(file) if spec.strippath else file)
    )


def _normal(path: str) -> str:
    return posixpath.normpath(path.replace("\\", "/"))


def _gives_mass(geom: mujoco._specs.MjsGeom) -> bool:
    """Check whether MuJoCo computes mass from a geom."""
    body, rule = geom.parent, mujoco.mjtInertiaFromGeom
    compiler = body.compiler
    lowest, highest = compiler.inertiagrouprange
    counted = compiler.inertiafromgeom == rule.mjINERTIAFROMGEOM_TRUE or (
        compiler.inertiafromgeom == rule.mjINERTIAFROMGEOM_AUTO and not body.explicitinertial
    )
    heavy = (geom.density if math.isnan(geom.mass) else geom.mass) != 0
    return bool(counted and heavy and body.name != "world" and lowest <= geom.group <= highest)


def _unless_overruled(body: mujoco._specs.MjsBody) -> str:
    """Return more advice for an error message if the file makes MuJoCo ignore an <inertial>."""
    overruled = body.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    return " and <compiler inertiafromgeom='auto'/>, which lets it count" if overruled else ""
