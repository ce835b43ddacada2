"""URDF made ready for MuJoCo's compiler.

MuJoCo reads URDF with habits of its own: it fuses links joined by fixed joints and forgets their
names, gives the root's mass to the world, and stops at meshes that it cannot find and at inertials
that it does not like. Here shapes are removed (the dynamics does not need them) but for those that
are asked for (`urdf_shapes`), names are kept, inertials are taken out (`inertials`), and
`floating_base` gives the root a joint.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from rbjax.errors import ModelError, listed
from rbjax.loading.mjcf.dropped import FIXED, INVERTED
from rbjax.loading.urdf.floating import float_root, free_name, take_floats
from rbjax.loading.urdf.inertials import Inertial, take_inertials
from rbjax.loading.urdf.mimics import Mimics, take_mimics
from rbjax.loading.urdf.shapes import take_shapes

#: settings of MuJoCo's compiler that change inertials; ours are the file's
_TAMPERS = ("balanceinertia", "boundmass", "boundinertia", "settotalmass")

#: bodies of a file, which MuJoCo reads in half a minute; it takes at most 1023 in a chain
_MANY, _DEEPEST = 20_000, 1000

_KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical")

_SHOWN = 4  # names listed before "and N more"

_XACRO = "; run xacro first: `xacro robot.urdf.xacro > robot.urdf`"


def is_urdf(text: str, name: str) -> bool:
    """Whether the XML's root element is <robot>."""
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
    """How many bodies a file has, including the copies of <replicate>."""
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
    except ValueError:  # which MuJoCo's parser rejects
        return 1


@dataclass(frozen=True)
class Urdf:
    """A URDF for MuJoCo's compiler, and the parts that MuJoCo does not get.

    text: the URDF for MuJoCo.
    inertials: by link.
    mimics: the mimic joints.
    floats: floating joints far from the ground, and the links that they move.
    left_out: entries of `Model.dropped`.
    """

    text: str
    inertials: dict[str, Inertial]
    mimics: Mimics
    floats: dict[str, str]
    left_out: tuple[str, ...]


def prepare_urdf(
    text: str, name: str, *, floating_base: bool, shapes: Collection[str] = (),
    folder: Path = Path(),
) -> Urdf:  # fmt: skip
    """The URDF with fixed links kept, a floating root if asked for, and no shapes but those of the
    links named in `shapes`; `folder` is that of the file."""
    robot = ET.fromstring(text)
    there = robot.findall("link")
    if not there:
        raise ModelError(f"{name}: <robot> has no <link>, expected at least one{_XACRO}")
    for kind in ("link", "joint"):
        names = [element.get("name", "") for element in robot.findall(kind)]
        twice = sorted(repr(n) for n, times in Counter(names).items() if times > 1)
        if twice:
            raise ModelError(
                f"{name}: more than one {kind} is named {', '.join(twice)}; give each its own name"
            )
    _check_kinds(robot, name)
    root = _root(robot, {link.get("name", "") for link in there}, name)
    free_name(robot, root)
    left_out = _left_out(robot, root, floating_base=floating_base)
    if floating_base:
        float_root(robot, root, name)
        root = "world"
    floats = take_floats(robot, root)
    links = {link.get("name", ""): link for link in robot.findall("link")}
    for link_name, link in links.items():
        take_shapes(link, folder if link_name in shapes else None)
    inertials = take_inertials(links, name)
    mimics = take_mimics(robot, name)
    for material in robot.findall("material"):
        robot.remove(material)
    extension = robot.find("mujoco")
    if extension is None:
        extension = ET.SubElement(robot, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ET.SubElement(extension, "compiler")
    compiler.attrib.pop("meshdir", None)
    for attribute in _TAMPERS:
        compiler.attrib.pop(attribute, None)
    compiler.set("fusestatic", "false")
    compiler.set("inertiafromgeom", "false")
    compiler.set("strippath", "false")
    compiler.set("discardvisual", "false")
    return Urdf(ET.tostring(robot, encoding="unicode"), inertials, mimics, floats, left_out)


def _left_out(robot: ET.Element, root: str, *, floating_base: bool) -> tuple[str, ...]:
    """Entries of `Model.dropped`: limits in the wrong order, collision shapes, a fixed root with a
    mass."""
    out = []
    inverted = [
        joint.get("name", "")
        for joint in robot.findall("joint[limit]")
        for ends in [[_float(limit.get(key, "0")) for key in ("lower", "upper")]
                     for limit in joint.findall("limit")]
        if joint.get("type") in ("revolute", "prismatic") and ends[0] > ends[1]
    ]  # fmt: skip
    if inverted:
        out.append(f"{INVERTED} ({listed(inverted, _SHOWN)})")
    colliding = [x.get("name", "") for x in robot.findall("link[collision]")]
    if colliding:
        out.append(f"collision shapes of links ({listed(colliding, _SHOWN)})")
    floats = any(
        joint.get("type") == "floating" and end is not None and end.get("link") == root
        for joint in robot.findall("joint")
        for end in (joint.find("parent"),)
    )
    mass = robot.find(f"link[@name='{root}']/inertial/mass") if "'" not in root else None
    moves = floating_base or floats or root == "world"
    if mass is not None and not moves and mass.get("value", "0").strip() not in ("0", "0.0"):
        out.append(f"{FIXED}, whose mass does not count ({root})")
    return tuple(out)


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:  # which MuJoCo's parser rejects
        return math.nan


def _check_kinds(robot: ET.Element, name: str) -> None:
    for joint in robot.findall("joint"):
        if joint.get("type") not in _KINDS:
            raise ModelError(
                f"{name}: joint {joint.get('name')!r} has the invalid joint type "
                f"{joint.get('type')!r}, expected one of {', '.join(_KINDS)}; correct its type"
            )


def _root(robot: ET.Element, links: set, name: str) -> str:
    """The one link that is nobody's child."""
    parents: dict[str, str] = {}
    for joint in robot.findall("joint"):
        ends: dict[str, str] = {}
        for end in ("parent", "child"):
            element = joint.find(end)
            ends[end] = element.get("link", "") if element is not None else ""
            if ends[end] not in links:
                raise ModelError(
                    f"{name}: joint {joint.get('name')!r} has {end} {ends[end]!r}, "
                    f"expected one of the links {', '.join(sorted(links))}"
                )
        if ends["child"] in parents:
            raise ModelError(
                f"{name}: link {ends['child']!r} is the child of two joints; a URDF is a tree, "
                f"so close loops with constraints instead"
            )
        parents[ends["child"]] = ends["parent"]
    roots = sorted(links - set(parents))
    if len(roots) != 1:
        what = f"{len(roots)} roots ({', '.join(roots)})" if roots else "a cycle and no root"
        raise ModelError(f"{name}: the joints leave {what}, expected one root link")
    children: dict[str, list[str]] = {}
    for child, parent in parents.items():
        children.setdefault(parent, []).append(child)
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
