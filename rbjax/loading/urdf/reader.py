"""A URDF as a `mujoco.MjSpec`.

The spec contains bodies, joints and frames. It contains the same placeholder inertial for every
body, because MuJoCo's compiler rejects zeros and rounded inertias. `inertials` writes the file's
numbers into the compiled model.

A floating joint is a free joint if its parent is the ground or a root at rest. Deeper in the tree
MuJoCo has no free joint, and it is three slides and a ball, with the coordinates

    q = [position; quaternion] of the child in the joint's frame,   v = [its rate; angular velocity]

Position and linear velocity are in the axes of the joint's frame, angular velocity in the axes of
the child.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from rbjax.constraints import JointPolynomial
from rbjax.errors import ModelError
from rbjax.loading.mjcf.fields import message_of
from rbjax.loading.urdf.inertials import Inertial, add_placeholder, read_inertial
from rbjax.loading.urdf.shapes import add_primitives, add_shapes
from rbjax.loading.urdf.tree import (
    GROUND,
    LinkTree,
    UrdfJoint,
    left_out,
    number,
    origin,
    read_numbers,
    read_tree,
)

_FREE, _BALL = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
_SLIDE, _HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
_TYPES = {
    "revolute": _HINGE, "continuous": _HINGE, "prismatic": _SLIDE, "spherical": _BALL,
}  # fmt: skip
_MOVING = ("revolute", "continuous", "prismatic")  # with one coordinate
_AXES = {"TX": (1, 0, 0), "TY": (0, 1, 0), "TZ": (0, 0, 1)}
#: compiler settings that change inertials, or that apply only to MJCF files
_IGNORED = (
    "balanceinertia", "boundmass", "boundinertia", "settotalmass", "meshdir", "texturedir",
    "assetdir", "angle", "eulerseq",
)  # fmt: skip


@dataclass(frozen=True)
class Mimics:
    """The mimic joints of a file."""

    couplings: tuple[JointPolynomial, ...] = ()  # a joint that mimics a fixed one is fixed
    names: tuple[str, ...] = ()  # "joint of driver"
    others: tuple[str, ...] = ()  # of joints with several coordinates, not supported

    def left_out(self, *, constraints: bool) -> tuple[str, ...]:
        """List the entries of `Model.dropped`."""
        names = ", ".join((*(() if constraints else self.names), *self.others))
        return (f"mimic joints, which move on their own ({names})",) if names else ()


@dataclass(frozen=True)
class Urdf:
    """A URDF as a spec, and the parts that the spec does not contain."""

    spec: mujoco.MjSpec  # the tree, with placeholders as inertials
    inertials: dict[str, Inertial]  # inertials by link
    mimics: Mimics  # mimic joints
    left_out: tuple[str, ...]  # entries of `Model.dropped`


def read_urdf(
    text: str, name: str, *, floating_base: bool, shapes: Collection[str] | None = (),
    folder: Path = Path(),
) -> Urdf:  # fmt: skip
    """Read the robot of a URDF.

    shapes: links whose shapes are read; None for all shapes except meshes.
    folder: folder of the file.

    Raises:
        ModelError: the joints are not a tree, or a number is missing or wrong.
    """
    robot = ET.fromstring(text)
    tree = read_tree(robot, name)
    dropped = left_out(tree, name, floating_base=floating_base)
    inertials = {x: read_inertial(e, f"{name}: link {x!r}") for x, e in tree.links.items()}
    if floating_base and tree.root == GROUND:
        _free_ground(tree, inertials, name)
    spec = _settings(robot, name)
    bodies = {GROUND: spec.worldbody}
    for joint in _from_the_ground(tree, floating_base=floating_base):
        at = f"{name}: joint {joint.name!r}"
        position, quat = origin(joint.element, at)
        body = bodies[joint.parent].add_body(name=joint.child, pos=position, quat=quat)
        bodies[joint.child] = body
        add_placeholder(body)
        _add_joints(body, joint, at)
    for link, element in tree.links.items():
        where = f"{name}: link {link!r}"
        if shapes is None:
            add_primitives(bodies[link], element, where)
        elif link in shapes:
            add_shapes(spec, bodies[link], element, folder, where)
    inertials = {x: inertials[x] for x in inertials if x in tree.links}
    return Urdf(spec, inertials, read_mimics(tree, name), dropped)


def _free_ground(tree: LinkTree, inertials: dict[str, Inertial], name: str) -> None:
    """Make the root 'world' a moving link, unless another link already floats on it."""
    if any(x.kind == "floating" and x.parent == GROUND for x in tree.joints):
        return
    children, front, mass = tree.children(), [GROUND], False
    while front:
        mass |= any(inertials[link].mass > 0 for link in front)
        front = [x.child for link in front for x in children[link] if x.kind == "fixed"]
    if not mass:
        raise ModelError(
            f"{name}: floating_base=True, but the root link 'world' and the links that are "
            f"fixed to it have no mass, which a floating base needs: the link named 'world' "
            f"is the ground; load without floating_base, or give it an <inertial>"
        )
    own = inertials.pop(GROUND)
    tree.rename_ground()
    inertials[tree.root] = own


def _from_the_ground(tree: LinkTree, *, floating_base: bool) -> list[UrdfJoint]:
    """List the joints from the ground on, parents before children. A link that floats on a fixed
    root is moved to the ground."""
    children, root = tree.children(), tree.root
    if root != GROUND and floating_base:
        children[GROUND] = [UrdfJoint("floating_base", "floating", GROUND, root)]
    elif root != GROUND:
        floating = [x for x in children[root] if x.kind == "floating"]
        children[root] = [x for x in children[root] if x.kind != "floating"]
        children[GROUND] = [*floating, UrdfJoint("", "fixed", GROUND, root)]
        for joint in floating:
            joint.parent = GROUND
    out, front = [], [GROUND]
    while front:
        joints = [joint for link in front for joint in children[link]]
        out += joints
        front = [joint.child for joint in joints]
    return out


def _settings(robot: ET.Element, name: str) -> mujoco.MjSpec:
    """Make an empty spec with the options of the URDF's <mujoco> extension."""
    root = ET.Element("mujoco", model=robot.get("name", "robot"))
    extension = robot.find("mujoco")
    for element in () if extension is None else extension:
        if element.tag in ("option", "size", "compiler"):
            root.append(element)
    compiler = root.find("compiler")
    compiler = ET.SubElement(root, "compiler") if compiler is None else compiler
    for attribute in _IGNORED:
        compiler.attrib.pop(attribute, None)
    compiler.attrib |= {"fusestatic": "false", "inertiafromgeom": "false", "angle": "radian"}
    compiler.attrib |= {"strippath": "false", "discardvisual": "false"}
    try:
        return mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise ModelError(f"{name}: MuJoCo cannot parse it: {message_of(error)}") from error


def _add_joints(body: Any, joint: UrdfJoint, at: str) -> None:
    """Add the joints to a body that are equivalent to a joint of the file."""
    element = ET.Element("joint") if joint.element is None else joint.element
    limit, dynamics, axis = (element.find(tag) for tag in ("limit", "dynamics", "axis"))
    ends = [number(limit, key, at) for key in ("lower", "upper")]
    effort = abs(number(limit, "effort", at))
    passive = {
        "damping": [number(dynamics, "damping", at), 0.0, 0.0],
        "frictionloss": number(dynamics, "friction", at),
    }
    limits: dict[str, Any] = {}
    if effort:
        limits["actfrcrange"] = [-effort, effort]
    if ends[0] != ends[1] and joint.kind != "continuous":
        limits["range"] = ends
    along = [1.0, 0.0, 0.0] if axis is None else read_numbers(axis, "xyz", 3, at)
    if joint.kind == "floating" and joint.parent == GROUND:
        body.add_joint(name=joint.name, type=_FREE, **passive)
    elif joint.kind == "floating":
        for suffix, direction in _AXES.items():
            body.add_joint(name=f"{joint.name}_{suffix}", type=_SLIDE, axis=direction)
        body.add_joint(name=f"{joint.name}_R", type=_BALL)
    elif joint.kind == "planar":
        quat, turned = np.empty(4), np.empty(3)
        mujoco.mju_quatZ2Vec(quat, np.asarray(along, float))
        for suffix, given in (("TX", limits), ("TY", {})):
            mujoco.mju_rotVecQuat(turned, np.array(_AXES[suffix], float), quat)
            given = {"type": _SLIDE, "axis": turned} | given | passive
            body.add_joint(name=f"{joint.name}_{suffix}", **given)
        body.add_joint(name=f"{joint.name}_RZ", type=_HINGE, axis=along, **passive)
    elif joint.kind == "spherical":
        limits.pop("actfrcrange", None)
        body.add_joint(name=joint.name, type=_BALL, **limits, **passive)
    elif joint.kind != "fixed":
        kind = _TYPES[joint.kind]
        body.add_joint(name=joint.name, type=kind, axis=along, **limits, **passive)


def read_mimics(tree: LinkTree, name: str) -> Mimics:
    """Read the mimic joints of a robot. Mimics on fixed joints are ignored."""
    kinds = {joint.name: joint.kind for joint in tree.joints}
    couplings, names, others = [], [], []
    for joint in tree.joints:
        for mimic in () if joint.element is None else joint.element.findall("mimic"):
            driver, where = mimic.get("joint", ""), f"{name}: joint {joint.name!r}"
            if driver not in kinds or driver == joint.name:
                raise ModelError(
                    f"{where} mimics {driver!r}, expected another one of the joints "
                    f"{', '.join(sorted(kinds))}"
                )
            line = [number(mimic, "offset", where), number(mimic, "multiplier", where, 1.0)]
            if joint.kind in _MOVING and kinds[driver] in (*_MOVING, "fixed"):
                leader = None if kinds[driver] == "fixed" else driver
                couplings.append(JointPolynomial(joint.name, leader, jnp.asarray(line, float)))
                names.append(f"{joint.name} of {driver}")
            elif joint.kind != "fixed":
                others.append(f"{joint.name} of {driver}")
    return Mimics(tuple(couplings), tuple(names), tuple(others))
