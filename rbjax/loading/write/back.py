"""Update the values of a robot in the user's own file, and keep the rest of the file unchanged.

Only attributes and elements of the XML are changed, because MuJoCo's writer rounds all numbers to
six digits and drops comments.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from rbjax.arguments import instance
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError, ModelError
from rbjax.forces import JointFriction
from rbjax.loading.loader import from_compiled
from rbjax.loading.sources import compile_source, read_text
from rbjax.loading.urdf.tree import is_urdf
from rbjax.loading.write.contact_values import (
    child,
    children,
    contact_leaves,
    differs,
    write_changed,
)
from rbjax.loading.write.draft import text
from rbjax.model import Model


def write_back(model: Model, source: str | Path, path: str | Path | None = None) -> str:
    """Update the values of a model in the user's own MJCF or URDF file.

    Only values that differ from the file are written: of bodies mass, center of mass and inertia;
    of joints damping, armature, Coulomb friction and (MJCF) stiffness; of MJCF actuators gain, bias
    and gear, of geoms and contact pairs the parameters of contacts, of limits and friction loss
    solref, solimp and margin, and impratio; gravity. Sizes and places of geoms, sensors, names,
    defaults and materials do not change.

    Args:
        model: model of the file, with other values.
        source: the file, its text, or a bundled scene's name.
        path: output file, or None. Relative paths of meshes are kept, so it should be in the folder
            of the source.

    Returns:
        The text of the updated file.

    Raises:
        InputError: a model with other bodies or joints than the file.
        ModelError: the updated file gives another model: the file cannot express its values.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> heavy = model.replace(bodies=model.bodies.replace(mass=2 * model.bodies.mass))
        >>> again = rb.load(rb.write_back(heavy, "pendulum"))
        >>> (again.bodies.mass / model.bodies.mass).tolist()
        [2.0]
    """
    check_model("write_back", model)
    instance("write_back", "source", source, (str, Path), "a path or the text of a file")
    given, place = read_text(source)
    urdf = is_urdf(given, str(source))
    floating = urdf and "free" in model.topology.joint_kinds
    compiled = compile_source(source, floating_base=floating, shapes=None)[0]
    contacts = model.contact is not None
    before = from_compiled(compiled, contacts=contacts)
    for what in ("body_names", "joint_names", "actuator_names"):
        ours, theirs = getattr(model, what), getattr(before, what)
        motors = what == "actuator_names" and not theirs  # load(..., motors=True)
        if ours != theirs and not motors:
            raise InputError(
                f"write_back: the model has {what} {ours}, expected the names of the file, {theirs}"
            )
    model, before = (jax.tree.map(np.asarray, m) for m in (model, before))
    out = _urdf(model, before, given) if urdf else _mjcf(model, before, given, compiled)
    if urdf or place is None:
        found = compile_source(out, floating_base=floating, shapes=None)[0]
    else:
        spec = mujoco.MjSpec.from_string(out)
        spec.modelfiledir = str(place.parent.resolve())  # the folder of the mesh paths
        found = compile_source(spec, floating_base=False, shapes=None)[0]
    again = from_compiled(found, contacts=contacts)
    _check(model, jax.tree.map(np.asarray, again), urdf)
    if path is not None:
        Path(path).write_text(out, encoding="utf-8")
    return out


def _mjcf(model: Model, before: Model, given: str, compiled: mujoco.MjModel) -> str:
    root = _parsed(given)
    world = [body for section in root.iter("worldbody") for body in section.iter("body")]
    if len(world) != model.nb:
        raise InputError(
            f"write_back: the file has {len(world)} <body> elements and the model {model.nb} "
            "bodies, expected as many: it includes or repeats others. Write all into one file, "
            "mujoco.MjSpec.from_file(path).to_xml(), and load that"
        )
    if differs(model.gravity, before.gravity):
        child(root, "option").set("gravity", text(model.gravity))
    for body, inertial in zip(world, _changed_inertials(model, before), strict=True):
        if inertial is not None:
            old = body.find("inertial")
            if old is not None:
                body.remove(old)
            mass, com, I = inertial
            full = text(I[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
            said = {"pos": text(com), "mass": text(mass), "fullinertia": full}
            body.insert(0, ET.Element("inertial", said))
    joints = [x for body in world for x in children(body, "joint", "freejoint")]
    friction = _friction(model)
    own: Any = model.joints
    was_own: Any = before.joints
    if len(joints) == len(model.joint_names):
        for j, (joint, start) in enumerate(zip(joints, model.topology.joint_v, strict=True)):
            for key, at in (("armature", start), ("damping", start), ("stiffness", j)):
                new, was = getattr(own, key)[at], getattr(was_own, key)[at]
                if differs(new, was):
                    # without the damping and armature of actuators
                    kept = getattr(compiled, f"{'jnt' if key == 'stiffness' else 'dof'}_{key}")[at]
                    further = joint.get(key, "").split()[1:]  # higher terms of a polynomial
                    joint.set(key, " ".join([text(kept + new - was), *further]))
            if start in friction:
                joint.set("frictionloss", text(friction[start]))
    sections = [*root.iter("worldbody"), *world]
    write_changed(root, sections, joints, model, before)
    actuators = [one for section in root.iter("actuator") for one in section]
    if len(actuators) == len(before.actuator_names):
        for a, one in enumerate(actuators):
            _write_actuator(one, model, before, a)
    return ET.tostring(root, encoding="unicode") + "\n"


def _parsed(given: str) -> ET.Element:
    """Parse the file with its comments."""
    return ET.fromstring(given, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))


def _changed_inertials(model: Model, before: Model) -> list[Any]:
    """List mass, center of mass and inertia of each body; None if they are unchanged."""
    found = []
    for b in range(model.nb):
        new, old = ([getattr(m.bodies, n)[b] for n in ("mass", "com", "inertia")]
                    for m in (model, before))  # fmt: skip
        found.append(new if any(map(differs, new, old)) else None)
    return found


def _write_actuator(one: ET.Element, model: Model, before: Model, a: int) -> None:
    own: Any = model.actuators
    old: Any = before.actuators
    gain, bias = own.gain[a], own.bias[a]
    if differs(gain, old.gain[a]) or differs(bias, old.bias[a]):
        servo = [gain[0], *gain[1:], bias[0]] == [-bias[1], 0.0, 0.0, 0.0]
        if one.tag == "position" and servo:
            one.attrib.pop("dampratio", None)
            one.set("kp", text(gain[0]))
            one.set("kv", text(-bias[2]))
        else:
            one.tag = "general"
            for key in ("kp", "kv", "dampratio"):
                one.attrib.pop(key, None)
            kind = "affine" if gain[1:].any() else "fixed"
            said = {"gaintype": kind, "gainprm": text(gain), "biasprm": text(bias)}
            one.attrib.update(said | {"biastype": "affine" if bias.any() else "none"})
    seen = np.flatnonzero(old.gear[a])
    if differs(own.gear[a], old.gear[a]) and len(seen) == 1:
        held = one.get("gear", "1").split()
        change = own.gear[a][seen[0]] / old.gear[a][seen[0]]
        one.set("gear", " ".join([text(float(held[0]) * change), *held[1:]]))


def _friction(model: Model) -> dict[int, float]:
    """Map each dof to its Coulomb friction, the sum over the model's elements."""
    found: dict[int, float] = {}
    top = model.topology
    for element in model.forces:
        if isinstance(element, JointFriction):
            joints = [model.joint(j) if isinstance(j, str) else j for j in element.joints]
            dofs = [top.joint_v[j] + k for j in joints for k in range(top.joints[j].nv)]
            for dof, value in zip(dofs, np.ravel(element.coulomb).tolist(), strict=True):
                found[dof] = found.get(dof, 0.0) + value
    return found


def _urdf(model: Model, before: Model, given: str) -> str:
    robot = _parsed(given)
    links = {link.get("name"): link for link in robot.findall("link")}
    for name, changed in zip(model.body_names, _changed_inertials(model, before), strict=True):
        link = links.get(name)
        if link is None or changed is None:
            continue
        mass, com, I = changed
        inertial = child(link, "inertial")
        origin = child(inertial, "origin")
        origin.set("xyz", text(com))
        origin.set("rpy", "0 0 0")
        child(inertial, "mass").set("value", text(mass))
        places = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2),
                  "izz": (2, 2)}  # fmt: skip
        for key, at in places.items():
            child(inertial, "inertia").set(key, text(I[at]))
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    friction = _friction(model)
    for name, start in zip(model.joint_names, model.topology.joint_v, strict=True):
        joint = joints.get(name)
        if joint is None:
            continue
        damping = model.joints.damping[start]
        if differs(damping, before.joints.damping[start]):
            child(joint, "dynamics").set("damping", text(damping))
        loss, was = (float(m.solver.frictionloss[start]) if m.solver else 0.0
                     for m in (model, before))  # fmt: skip
        if start in friction or differs(loss, was):
            child(joint, "dynamics").set("friction", text(friction.get(start, loss)))
    return ET.tostring(robot, encoding="unicode") + "\n"


def _check(model: Model, again: Model, urdf: bool) -> None:
    """Raise ModelError if the written file has other values than the model."""
    wrong = []
    pairs = [("gravity", model.gravity, again.gravity)]
    pairs += [(f"bodies.{n}", getattr(model.bodies, n), getattr(again.bodies, n))
              for n in ("mass", "com", "inertia", "position")]  # fmt: skip
    pairs += [(f"joints.{n}", getattr(model.joints, n), getattr(again.joints, n))
              for n in ("damping", "armature", "stiffness", "placement", "axis")]  # fmt: skip
    if not urdf:
        pairs += [(f"actuators.{n}", getattr(model.actuators, n), getattr(again.actuators, n))
                  for n in ("gear", "gain", "bias") if len(again.actuator_names)]  # fmt: skip
    pairs += [(name, a, b) for name, a, b in contact_leaves(model, again)]
    for name, a, b in pairs:
        size = max(float(np.abs(a).max(initial=0.0)), 1e-300)
        if a.shape != b.shape or np.abs(a - b).max(initial=0.0) > 1e-9 * size:
            wrong.append(name)
    if wrong:
        hint = "; a URDF has no armature, stiffness or gravity" if urdf else ""
        raise ModelError(
            "write_back: the file cannot express these parameters of the model: "
            f"{', '.join(wrong)}{hint}; use `write_mjcf`, which writes a new file"
        )
