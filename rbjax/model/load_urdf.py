"""URDF made ready for MuJoCo's compiler.

MuJoCo reads URDF with habits of its own: it fuses links joined by fixed joints and forgets their
names, gives the root's mass to the world, takes masses from collision shapes where a link has no
<inertial>, and stops at meshes that it cannot find. Here shapes are removed (the dynamics does not
need them), names are kept, and `floating_base` gives the root a joint.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

from rbjax.errors import ModelError


def is_urdf(text: str, name: str) -> bool:
    """Whether the XML's root element is <robot>."""
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise ModelError(
            f"{name}: not well-formed XML: {error}; expected MJCF (<mujoco>) or URDF (<robot>)"
        ) from error
    if root.tag not in ("mujoco", "mujocoinclude", "robot"):
        raise ModelError(
            f"{name}: root element <{root.tag}>, expected <mujoco> (MJCF) or <robot> (URDF)"
        )
    return root.tag == "robot"


def prepare_urdf(text: str, name: str, *, floating_base: bool) -> str:
    """The URDF with shapes removed, fixed links kept, and a floating root if asked for."""
    robot = ET.fromstring(text)
    for kind in ("link", "joint"):
        names = [element.get("name", "") for element in robot.findall(kind)]
        twice = sorted({repr(n) for n in names if names.count(n) > 1})
        if twice:
            raise ModelError(
                f"{name}: more than one {kind} is named {', '.join(twice)}; give each its own name"
            )
    links = {link.get("name", ""): link for link in robot.findall("link")}
    root = _root(robot, set(links), name)
    for link in links.values():
        for shape in (*link.findall("visual"), *link.findall("collision")):
            link.remove(shape)
        _drop_empty_inertial(link)
    for material in robot.findall("material"):
        robot.remove(material)
    extension = robot.find("mujoco")
    if extension is None:
        extension = ET.SubElement(robot, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ET.SubElement(extension, "compiler")
    compiler.attrib.pop("meshdir", None)
    compiler.set("fusestatic", "false")
    compiler.set("inertiafromgeom", "false")
    if floating_base:
        world = "world" if "world" not in links else "rbjax_world"
        robot.insert(0, ET.Element("link", name=world))
        joint = ET.SubElement(robot, "joint", name="floating_base", type="floating")
        ET.SubElement(joint, "parent", link=world)
        ET.SubElement(joint, "child", link=root)
    return ET.tostring(robot, encoding="unicode")


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
    reached, front = {roots[0]}, [roots[0]]
    while front:
        front = [c for c, p in parents.items() if p in front]
        reached.update(front)
    if reached != links:
        raise ModelError(
            f"{name}: links {', '.join(sorted(links - reached))} form a cycle apart from the root "
            f"{roots[0]!r}; a URDF is a tree"
        )
    return roots[0]


def _drop_empty_inertial(link: ET.Element) -> None:
    """An <inertial> of zeros means none; MuJoCo refuses it otherwise."""
    inertial = link.find("inertial")
    if inertial is None:
        return
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    values = [] if mass is None else [mass.get("value", "0")]
    values += [] if inertia is None else [inertia.get(k, "0") for k in ("ixx", "iyy", "izz")]
    if not any(float(x) for x in values):
        link.remove(inertial)
