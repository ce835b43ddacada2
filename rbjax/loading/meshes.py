"""Meshes whose file is absent: left out where only seen, refused where they give mass."""

from __future__ import annotations

import math
import posixpath
import re

import mujoco

from rbjax.errors import ModelError


def without_missing_mesh(spec: mujoco.MjSpec, message: str) -> mujoco.MjSpec | None:
    """A copy without the mesh, and its geoms, whose file MuJoCo's message says it cannot open.

    MuJoCo is asked, because only it knows all the places where it looks: a file's folder, `meshdir`
    and `strippath`, those of attached models, files in memory. None if no mesh is meant.
    """
    found = re.search(r"Error opening file '(.*)'", message)
    if found is None:
        return None
    spec = spec.copy()
    gone = {m.name for m in spec.meshes if m.file and _path(spec, m) == _normal(found[1])}
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


def _path(spec: mujoco.MjSpec, mesh: mujoco._specs.MjsMesh) -> str:
    """Where MuJoCo looks for a mesh, as its messages write it."""
    file = mesh.file.replace("\\", "/")
    return _normal(
        posixpath.join(mesh.compiler.meshdir, posixpath.basename(file) if spec.strippath else file)
    )


def _normal(path: str) -> str:
    return posixpath.normpath(path.replace("\\", "/"))


def _gives_mass(geom: mujoco._specs.MjsGeom) -> bool:
    """Whether MuJoCo would count a geom in its body's mass."""
    body, rule = geom.parent, mujoco.mjtInertiaFromGeom
    compiler = body.compiler
    lowest, highest = compiler.inertiagrouprange
    counted = compiler.inertiafromgeom == rule.mjINERTIAFROMGEOM_TRUE or (
        compiler.inertiafromgeom == rule.mjINERTIAFROMGEOM_AUTO and not body.explicitinertial
    )
    heavy = (geom.density if math.isnan(geom.mass) else geom.mass) != 0
    return bool(counted and heavy and body.name != "world" and lowest <= geom.group <= highest)


def _unless_overruled(body: mujoco._specs.MjsBody) -> str:
    """What else is needed where the file says that an <inertial> does not count."""
    overruled = body.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    return " and <compiler inertiafromgeom='auto'/>, which lets it count" if overruled else ""
