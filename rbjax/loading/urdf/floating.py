"""What floats in a URDF, made ready for MuJoCo's compiler.

MuJoCo has a free joint only for a body whose parent is the world, and takes the link named 'world'
for the world. So a floating joint below the root moves to a link 'world' that is the root's place,
and one further down becomes three slides and a ball (`add_floats`), whose coordinates

    q = [position; quaternion] of the child in the joint's frame,   v = [its rate; angular velocity]

are those of a free joint, but for where they count from: position and velocity in the axes of the
joint's frame, angular velocity in those of the child.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import mujoco

from rbjax.errors import ModelError

_SLIDES = {"TX": (1, 0, 0), "TY": (0, 1, 0), "TZ": (0, 0, 1)}


def free_name(robot: ET.Element, root: str) -> None:
    """Rename a link 'world' that is not the root: to MuJoCo only the ground has this name."""
    if root != "world" and any(link.get("name") == "world" for link in robot.findall("link")):
        _rename(robot, "world", _unused(robot, "world_link"))


def float_root(robot: ET.Element, root: str, name: str) -> None:
    """A floating joint from the ground, a link 'world', to the root; a root of this name gets
    another one."""
    if root == "world":
        hanging = [j for j in robot.findall("joint") if _end(j, "parent") == root]
        if any(j.get("type") == "floating" for j in hanging):
            return  # the robot floats on the ground already
        if not _mass(robot, root):
            raise ModelError(
                f"{name}: floating_base=True, but the root link 'world' and the links that are "
                f"fixed to it have no mass, and nothing floats without: the link named 'world' is "
                f"the ground; load without floating_base, or give it an <inertial>"
            )
        root = _unused(robot, "world_link")
        _rename(robot, "world", root)
    _hang(robot, root, "floating_base", "floating")


def take_floats(robot: ET.Element, root: str) -> dict[str, str]:
    """The floating joints that MuJoCo has no free joint for, and the links that they move: these
    joints are fixed afterwards. Those below a root that is at rest move from the ground."""
    floating = [j for j in robot.findall("joint") if j.get("type") == "floating"]
    if root != "world" and any(_end(j, "parent") == root for j in floating):
        _hang(robot, root, _unused(robot, f"{root}_at_rest"), "fixed")
        for joint in floating:
            parent = joint.find("parent")
            if parent is not None and parent.get("link") == root:
                parent.set("link", "world")
    found = {}
    for joint in floating:
        if _end(joint, "parent") != "world":
            joint.set("type", "fixed")
            found[joint.get("name", "")] = _end(joint, "child")
    return found


def add_floats(spec: mujoco.MjSpec, floats: dict[str, str]) -> None:
    """Three slides and a ball, name_TX, _TY, _TZ and _R, for each joint of `take_floats`."""
    for name, child in floats.items():
        body = spec.body(child)
        for suffix, axis in _SLIDES.items():
            kind = mujoco.mjtJoint.mjJNT_SLIDE
            body.add_joint(name=f"{name}_{suffix}", type=kind, axis=axis)
        body.add_joint(name=f"{name}_R", type=mujoco.mjtJoint.mjJNT_BALL)


def _hang(robot: ET.Element, root: str, name: str, kind: str) -> None:
    """Put a link 'world' above the root, and a joint between the two."""
    robot.insert(0, ET.Element("link", name="world"))
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link="world")
    ET.SubElement(joint, "child", link=root)


def _end(joint: ET.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _mass(robot: ET.Element, link: str) -> bool:
    """Whether a link, or one that is fixed to it, has an inertial with a mass."""
    welded, front = {link}, [link]
    fixed = [j for j in robot.findall("joint") if j.get("type") == "fixed"]
    while front:
        front = [_end(j, "child") for j in fixed if _end(j, "parent") in front]
        welded.update(front)
    masses = [x.find("inertial/mass") for x in robot.findall("link") if x.get("name") in welded]
    return any(mass is not None and _positive(mass.get("value", "0")) for mass in masses)


def _positive(text: str) -> bool:
    try:
        return float(text) > 0
    except ValueError:  # which `take_inertials` refuses in its own words
        return True


def _unused(robot: ET.Element, name: str) -> str:
    """The name, or one like it that no link or joint has."""
    taken = {x.get("name") for x in robot}
    while name in taken:
        name = f"rbjax_{name}"
    return name


def _rename(robot: ET.Element, old: str, new: str) -> None:
    """Give a link another name, wherever it is named."""
    for link in robot.findall("link"):
        if link.get("name") == old:
            link.set("name", new)
    for joint in robot.findall("joint"):
        for end in (joint.find("parent"), joint.find("child")):
            if end is not None and end.get("link") == old:
                end.set("link", new)
