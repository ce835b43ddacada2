"""The tree of a URDF: its checked links and joints, and the numbers of its attributes.

A link named 'world' at the root is the ground. Any other root is fixed to the ground or, with a
floating base, is on a free joint.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from rbjax.errors import ModelError, listed
from rbjax.loading.mjcf.dropped import COLLISION, FIXED, INVERTED, MESHES

#: largest number of bodies in a file, which MuJoCo reads in half a minute; its limit in a chain
#: is 1023
_MANY, _DEEPEST = 20_000, 1000

_KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical")


_XACRO = "; run xacro first: `xacro robot.urdf.xacro > robot.urdf`"

GROUND = "world"


def is_urdf(text: str, name: str) -> bool:
    """Check whether the XML's root element is <robot>."""
    if not text.strip():
        raise ModelError(f"{name}: the file is empty; expected MJCF (<mujoco>) or URDF (<robot>)")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise ModelError(
            f"{name}: not well-formed XML: {error}; expected MJCF (<mujoco>) or URDF (<robot>)"
            f"{_XACRO if 'xacro:' in text else ''}"
        ) from error
    if any("/xacro}" in x.tag or (x.tag[0] == "{" and "<xacro:" in text) for x in root.iter()):
        raise ModelError(f"{name}: got xacro's macros, expected URDF{_XACRO}")
    if root.tag not in ("mujoco", "mujocoinclude", "robot"):
        raise ModelError(
            f"{name}: root element <{root.tag}>, expected <mujoco> (MJCF) or <robot> (URDF)"
        )
    many = _bodies(root)
    if many > _MANY:
        raise ModelError(
            f"{name}: got {many:,} bodies, expected at most {_MANY:,}, for the time that MuJoCo "
            f"takes to read them grows with their square; load one of the robots of a crowd, and "
            f"jax.vmap over states"
        )
    return root.tag == "robot"


def _bodies(root: ET.Element) -> int:
    """Count the bodies of a file, with the copies of <replicate>."""
    if root.tag == "robot":
        return len(root.findall("link"))
    count, front = 0, [(root, 1)]
    while front:
        element, times = front.pop()
        if element.tag == "replicate":
            times *= _count(element)
        count += times * (element.tag == "body")
        front += [(child, times) for child in element]
    return count


def _count(replicate: ET.Element) -> int:
    try:
        return max(int(replicate.get("count", "1")), 0)
    except ValueError:  # MuJoCo's parser rejects it
        return 1


@dataclass
class UrdfJoint:
    """A joint of a URDF. `element` is its XML element; None for a joint that is not in the file."""

    name: str
    kind: str
    parent: str
    child: str
    element: ET.Element | None = None


@dataclass
class LinkTree:
    """The links by name, the joints in the order of the file, and the root link."""

    links: dict[str, ET.Element]
    joints: list[UrdfJoint]
    root: str

    def children(self) -> dict[str, list[UrdfJoint]]:
        """Return the joints below each link."""
        out: dict[str, list[UrdfJoint]] = {name: [] for name in (GROUND, *self.links)}
        for joint in self.joints:
            out[joint.parent].append(joint)
        return out

    def unused(self, name: str) -> str:
        """Return the name, with the prefix "rbjax_" if a link or joint has it already."""
        while name in self.links or any(name == joint.name for joint in self.joints):
            name = f"rbjax_{name}"
        return name

    def rename_ground(self) -> None:
        """Rename a link 'world' that is not the ground to 'world_link'."""
        new = self.unused("world_link")
        self.links = {new if name == GROUND else name: x for name, x in self.links.items()}
        self.root = new if self.root == GROUND else self.root
        for joint in self.joints:
            joint.parent = new if joint.parent == GROUND else joint.parent
            joint.child = new if joint.child == GROUND else joint.child


def read_tree(robot: ET.Element, name: str) -> LinkTree:
    """Read the tree of a <robot>; raise ModelError if its joints are not a tree."""
    links = robot.findall("link")
    if not links:
        raise ModelError(f"{name}: <robot> has no <link>, expected at least one{_XACRO}")
    for kind in ("link", "joint"):
        names = [element.get("name", "") for element in robot.findall(kind)]
        twice = sorted(repr(n) for n, times in Counter(names).items() if times > 1)
        if twice:
            raise ModelError(
                f"{name}: more than one {kind} is named {', '.join(twice)}; give each its own name"
            )
    by_name = {link.get("name", ""): link for link in links}
    joints = [_joint(element, by_name, name) for element in robot.findall("joint")]
    tree = LinkTree(by_name, joints, _root(joints, set(by_name), name))
    if tree.root != GROUND and GROUND in by_name:
        tree.rename_ground()
    return tree


def _joint(element: ET.Element, links: dict[str, ET.Element], name: str) -> UrdfJoint:
    own, kind = element.get("name", ""), element.get("type", "")
    if kind not in _KINDS:
        raise ModelError(
            f"{name}: joint {element.get('name')!r} has the invalid joint type "
            f"{element.get('type')!r}, expected one of {', '.join(_KINDS)}; correct its type"
        )
    ends = []
    for end in ("parent", "child"):
        found = element.find(end)
        ends.append("" if found is None else found.get("link", ""))
        if ends[-1] not in links:
            raise ModelError(
                f"{name}: joint {element.get('name')!r} has {end} {ends[-1]!r}, "
                f"expected one of the links {', '.join(sorted(links))}"
            )
    parent, child = ends
    return UrdfJoint(own, kind, parent, child, element)


def _root(joints: list[UrdfJoint], links: set[str], name: str) -> str:
    """Return the only link without a parent, or raise ModelError."""
    children: dict[str, list[str]] = {}
    below: set[str] = set()
    for joint in joints:
        if joint.child in below:
            raise ModelError(
                f"{name}: link {joint.child!r} is the child of two joints; a URDF is a tree, "
                f"so close loops with constraints instead"
            )
        below.add(joint.child)
        children.setdefault(joint.parent, []).append(joint.child)
    roots = sorted(links - below)
    if len(roots) != 1:
        what = f"{len(roots)} roots ({', '.join(roots)})" if roots else "a cycle and no root"
        raise ModelError(f"{name}: the joints leave {what}, expected one root link")
    reached, front, depth = {roots[0]}, [roots[0]], 1
    while front:
        front = [child for link in front for child in children.get(link, ())]
        reached.update(front)
        depth += 1
        if depth > _DEEPEST:
            raise ModelError(
                f"{name}: more than {_DEEPEST} links in a chain, such as {front[0]!r}, which "
                f"MuJoCo does not read; expected a shorter one: weld or split it"
            )
    if reached != links:
        raise ModelError(
            f"{name}: links {', '.join(sorted(links - reached))} form a cycle apart from the root "
            f"{roots[0]!r}; a URDF is a tree"
        )
    return roots[0]


def left_out(tree: LinkTree, name: str, *, floating_base: bool) -> tuple[str, ...]:
    """List the entries of `Model.dropped`: inverted limits, collision shapes, a fixed root with a
    mass."""
    out = []
    inverted = []
    for joint in tree.joints:
        limit = None if joint.element is None else joint.element.find("limit")
        if limit is not None and joint.kind in ("revolute", "prismatic"):
            where = f"{name}: joint {joint.name!r}"
            if number(limit, "lower", where) > number(limit, "upper", where):
                inverted.append(joint.name)
    if inverted:
        out.append(f"{INVERTED} ({listed(inverted)})")
    colliding = [link for link, x in tree.links.items() if x.find("collision") is not None]
    if colliding:
        out.append(f"{COLLISION} of links ({listed(colliding)})")
    meshes = [k for k, x in tree.links.items() if x.find("collision/geometry/mesh") is not None]
    if meshes:
        out.append(f"{MESHES} of links ({listed(meshes)})")
    floats = any(x.kind == "floating" and x.parent == tree.root for x in tree.joints)
    mass = tree.links[tree.root].find("inertial/mass")
    moves = floating_base or floats or tree.root == GROUND
    if mass is not None and not moves and mass.get("value", "0").strip() not in ("0", "0.0"):
        out.append(f"{FIXED}, whose mass does not count ({tree.root})")
    return tuple(out)


def read_numbers(
    element: ET.Element | None, key: str, count: int, where: str, usual: Any = None
) -> np.ndarray:
    """Read `count` numbers of an attribute.

    Return zeros if the element is absent, and `usual` if the attribute is absent.

    Raises:
        ModelError: the attribute is not `count` finite numbers, or is absent and has no `usual`.
    """
    if element is None:
        return np.zeros(count)
    text = element.get(key)
    if text is None:
        if usual is None:
            raise ModelError(f"{where}: <{element.tag}> has no {key}, expected a number; add it")
        return np.broadcast_to(np.asarray(usual, float), count)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        expected = "one finite number" if count == 1 else f"{count} finite numbers"
        raise ModelError(
            f"{where}: <{element.tag} {key}={text!r}>, expected {expected}; correct it"
        )
    return np.array(values)


def number(element: ET.Element | None, key: str, where: str, usual: float = 0.0) -> float:
    """Read one number of an attribute, with the default `usual`."""
    return float(read_numbers(element, key, 1, where, usual)[0])


def origin(element: ET.Element | None, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Read the position (3,) and the quaternion (4,) of the <origin> of an element."""
    found = None if element is None else element.find("origin")
    position = read_numbers(found, "xyz", 3, where, 0.0)
    quat = np.empty(4)
    mujoco.mju_euler2Quat(quat, read_numbers(found, "rpy", 3, where, 0.0), "XYZ")
    return position, quat
