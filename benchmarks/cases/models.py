"""Robots of installed packages that the tests use, and their loading in MuJoCo.

Found through the installed packages; one that is absent only shortens the list (see `MISSING`).
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import mujoco

PLACES = {
    "gymnasium": ("gymnasium", "envs/mujoco/assets"),
    "mjx": ("mujoco.mjx", "test_data"),
    "frax": ("frax", "assets"),
    "upkie": ("upkie_description", "urdf"),
}

UNLOADABLE = {
    "frax/unitree_g1/floating_g1_29dof_rev_1_0.urdf": (
        "six massless links make up the floating base, and MuJoCo refuses a moving body without "
        "mass; 'frax/unitree_g1/g1_29dof_rev_1_0.urdf+free' is the same robot on a free joint"
    ),
}
"""Files that MuJoCo cannot compile whatever is deleted from them, and why."""

SINGULAR = {
    "mjx/actuator/general_dyntype.xml": "four coaxial slides on one body: mass matrix of rank one",
}
"""Models that load and have no forward dynamics, only inverse dynamics and a mass matrix."""


@dataclass(frozen=True)
class ModelFile:
    """A robot file of an installed package; floating_base asks for a free joint at its root."""

    path: Path
    floating_base: bool = False

    def load(self) -> mujoco.MjModel:
        return mujoco_reference(self.path, floating_base=self.floating_base)


def _find() -> tuple[dict[str, ModelFile], dict[str, ModelFile], list[str]]:
    found, refused, missing = {}, {}, []
    for label, (package, folder) in PLACES.items():
        try:
            spec = importlib.util.find_spec(package)
        except ModuleNotFoundError:
            spec = None
        if spec is None or spec.origin is None:
            missing.append(package)
            continue
        root = Path(spec.origin).parent / folder
        for path in sorted(p for p in root.rglob("*") if p.suffix in (".xml", ".urdf")):
            name = f"{label}/{path.relative_to(root).as_posix()}"
            if name in UNLOADABLE:
                refused[name] = ModelFile(path)
                continue
            found[name] = ModelFile(path)
            if path.suffix == ".urdf" and path.stem in ("a2", "g1_29dof_rev_1_0", "upkie"):
                found[name + "+free"] = ModelFile(path, floating_base=True)
    return found, refused, missing


MODELS, REFUSED, MISSING = _find()
"""name -> ModelFile that loads; the same for UNLOADABLE; packages that are not installed."""


def mujoco_reference(source: str | Path, *, floating_base: bool = False) -> mujoco.MjModel:
    """The file or XML text as an MjModel, without the parts that prevent compilation."""
    return load_with_removals(source, floating_base=floating_base)[0]


def load_with_removals(
    source: str | Path, *, floating_base: bool = False
) -> tuple[mujoco.MjModel, list[str]]:
    """The compiled model, and the parts that had to be deleted first.

    floating_base puts a free joint on the root link, which MuJoCo otherwise welds into the world
    with its mass lost.
    """
    text = isinstance(source, str) and source.lstrip().startswith("<")
    spec = mujoco.MjSpec.from_string(source) if text else mujoco.MjSpec.from_file(str(source))
    if floating_base:
        spec.worldbody.first_body().add_freejoint(name="floating_base")
    removed: list[str] = []
    while True:
        try:
            return spec.compile(), removed
        except ValueError as error:
            for remove in (_meshes, _muscles, _bad_tendons):
                reason = remove(spec, str(error))
                if reason and reason not in removed:
                    removed.append(reason)
                    break
            else:
                raise


def _meshes(spec: mujoco.MjSpec, message: str) -> str:
    """Delete all mesh geoms where files are missing and inertials explicit."""
    if "opening file" not in message:
        return ""
    for geom in [g for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_MESH]:
        if geom.parent.name != "world" and not geom.parent.explicitinertial:
            raise ValueError(f"body {geom.parent.name!r} has no inertial and its mesh is missing")
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    return "mesh geoms (files missing; inertials are explicit)"


def _muscles(spec: mujoco.MjSpec, message: str) -> str:
    """Delete all actuators where a muscle's length range does not converge."""
    if "engthrange" not in message:
        return ""
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    return "actuators (a muscle's length range does not converge)"


def _bad_tendons(spec: mujoco.MjSpec, message: str) -> str:
    """Delete tendons and equalities where a fixed tendon runs over a ball or free joint."""
    if "tendon" not in message:
        return ""
    for element in [*spec.equalities, *spec.tendons]:
        spec.delete(element)
    return "tendons and equalities (a fixed tendon over a ball joint)"


def switch_off_constraints(model: mujoco.MjModel) -> list[str]:
    """Leave an MjModel, in place, the smooth dynamics alone; return what it had that is off now.

    Off: contact, limits, friction loss, equalities; tendons (springs, dampers, armature); air or
    water; gravity compensation; nonlinear spring and damper terms; damping and armature that
    actuators have at tendons; flexes' springs. Solver and cone become Newton and pyramidal, which
    MJX takes. What stays: rigid bodies, gravity, joint armature, linear joint springs and dampers,
    actuators.
    """
    bits = mujoco.mjtDisableBit
    touching = model.geom_contype.any() or model.geom_conaffinity.any() or model.npair
    off = [
        ("contact", bool(touching)),
        ("joint limits", bool(model.jnt_limited.any() or model.tendon_limited.any())),
        ("friction loss", bool(model.dof_frictionloss.any() or model.tendon_frictionloss.any())),
        ("equality", model.neq > 0),
        ("tendons", model.ntendon > 0),
        ("fluid", bool(model.opt.density or model.opt.viscosity)),
        ("gravity compensation", bool(model.body_gravcomp.any())),
        ("flex", model.nflex > 0),
    ]
    model.opt.disableflags |= bits.mjDSBL_CONSTRAINT | bits.mjDSBL_CONTACT | bits.mjDSBL_LIMIT
    model.opt.disableflags |= bits.mjDSBL_FRICTIONLOSS | bits.mjDSBL_EQUALITY
    model.geom_contype[:] = model.geom_conaffinity[:] = 0  # else MJX refuses some pairs of shapes
    model.opt.density = model.opt.viscosity = 0.0
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    pulls = model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    for field in ("actuator_damping", "actuator_armature"):
        off.append((field.replace("_", " "), bool(getattr(model, field)[pulls].any())))
        getattr(model, field)[pulls] = 0.0
    silent = "body_gravcomp dof_frictionloss tendon_stiffness tendon_damping tendon_armature"
    silent += " tendon_frictionloss tendon_stiffnesspoly tendon_dampingpoly flex_stiffness"
    silent += " flex_damping flex_edgestiffness flex_edgedamping"  # said above
    zeroed = dict.fromkeys(silent.split(), "")
    zeroed |= {"jnt_stiffnesspoly": "nonlinear springs", "dof_dampingpoly": "nonlinear dampers"}
    zeroed |= {"actuator_dampingpoly": "nonlinear actuator damping"}
    for field, name in zeroed.items():
        values = getattr(model, field, None)  # several are new in MuJoCo 4
        if values is not None:
            off.append((name, bool(name) and bool(values.any())))
            values[:] = 0.0
    return sorted({name for name, had in off if had})


if __name__ == "__main__":
    for name, entry in MODELS.items():
        model, removed = load_with_removals(entry.path, floating_base=entry.floating_base)
        off = switch_off_constraints(model)
        print(
            f"{name:56s} nq {model.nq:3d} nv {model.nv:3d}  removed: {'; '.join(removed)}", end=""
        )
        print(f"  off: {', '.join(off)}")
    for name in REFUSED:
        print(f"{name}: {UNLOADABLE[name]}")
