"""Elasticity of cables, MuJoCo's plugin `mujoco.elasticity.cable`, in files and in models.

MuJoCo 4 has neither the plugin nor `<composite type="cable">`, and its reader rejects both. The
file is therefore changed before MuJoCo reads it: the plugin is taken out, the bodies of each
instance are stored in a text of the section <custom>, and composites are expanded by
`rbjax.loading.mjcf.composite`. The compiled model then gives sections and distances:

    <custom><text name="rbjax cable NAME" data='{"bodies": [...], "twist": G, "bend": E, ...}'/>

`write_mjcf` writes such a text with the joints and all numbers of an element.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from rbjax.errors import ModelError
from rbjax.forces.joints.cable import Cable, circle, rectangle
from rbjax.loading.mjcf.composite import add_segments
from rbjax.loading.mjcf.fields import Off, is_on, leaf, message_of

PLUGIN = "mujoco.elasticity.cable"
#: prefix of the names of the texts
TEXT = "rbjax cable "
_PLACE = "rbjax cable place "  # name of the empty body that becomes the first segment
_NUMBERS = ("twist", "bend", "section", "length", "rest")  # leaves of `Cable`
_KEYS = ("twist", "bend", "flat", "vmax")


def read_with_cables(text: str, path: Path | None, where: str) -> mujoco.MjSpec | None:
    """Read an MJCF file that has cables. Return None if it has none, or is not well-formed."""
    if "<include" not in text and "composite" not in text and PLUGIN not in text:
        return None
    try:
        root = ET.fromstring(text)
        folder = Path() if path is None else path.parent
        root = _merged(root, folder, folder)
    except (ET.ParseError, OSError, UnicodeDecodeError):
        return None  # MuJoCo's message says where
    composites = [x for x in root.iter("composite") if x.get("type") == "cable"]
    if not composites and not any(x.get("plugin") == PLUGIN for x in root.iter("plugin")):
        return None
    cables = _take_plugins(root, where)
    for n, composite in enumerate(composites):
        _replace(root, composite, ET.Element("body", name=f"{_PLACE}{n}"))
    try:
        spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    except ValueError as error:
        message = f"{where}: MuJoCo cannot parse it without its cables: {message_of(error)}"
        raise ModelError(message) from error
    spec.modelfiledir = str(folder)
    for n, composite in enumerate(composites):
        names = add_segments(spec, spec.body(f"{_PLACE}{n}"), composite, where)
        own = composite.find("plugin")
        if own is None:
            continue
        key = own.get("instance") or f"composite{composite.get('prefix', '')}"
        values = cables.setdefault(key, _config(own, where))
        values["bodies"] += names
    for key, values in cables.items():
        if values["bodies"]:
            spec.add_text(name=f"{TEXT}{key}", data=json.dumps(values))
    return spec


def _merged(root: ET.Element, main: Path, folder: Path, above: tuple = ()) -> ET.Element:
    """Return a copy of an element with the files that it includes."""
    out = ET.Element(root.tag, root.attrib)
    out.text, out.tail = root.text, root.tail
    for child in root:
        if child.tag != "include":
            out.append(_merged(child, main, folder, above))
            continue
        name = child.get("file", "")
        places = [f for f in (main / name, folder / name) if f.is_file()]
        if not places or places[0] in above:
            raise OSError(name)  # MuJoCo may find it, or says what is wrong
        place = places[0]
        inner = ET.fromstring(place.read_text(encoding="utf-8"))
        out.extend(_merged(inner, main, place.parent, (*above, place)))
    return out


def _take_plugins(root: ET.Element, where: str) -> dict[str, dict[str, Any]]:
    """Take the plugin out of a file. Return the values and the bodies of each instance."""
    cables: dict[str, dict[str, Any]] = {}
    for extension in root.findall("extension"):
        for plugin in [x for x in extension if x.get("plugin") == PLUGIN]:
            for one in plugin.findall("instance"):
                cables[one.get("name", "")] = _config(one, where)
            extension.remove(plugin)
        if not len(extension):
            root.remove(extension)
    for body in list(root.iter("body")):
        for plugin in body.findall("plugin"):
            key = plugin.get("instance")
            if plugin.get("plugin") == PLUGIN and key is None:
                key = f"body{len(cables)}"  # an instance of one body has no force
                cables[key] = _config(plugin, where)
            if key is None or key not in cables:
                continue
            if body.get("name") is None:
                body.set("name", f"cable {key} {len(cables[key]['bodies'])}")
            cables[key]["bodies"].append(body.get("name"))
            body.remove(plugin)
    return cables


def _config(plugin: ET.Element, where: str) -> dict[str, Any]:
    """Read the parameters of an instance of the plugin."""
    given = {x.get("key", ""): x.get("value", "").strip() for x in plugin.findall("config")}
    unknown = [key for key in given if key not in _KEYS]
    if unknown:
        raise ModelError(f"{where}: {PLUGIN} has no {unknown[0]!r}, expected one of {list(_KEYS)}")
    out: dict[str, Any] = {"flat": given.get("flat") == "true", "bodies": []}
    for key in ("twist", "bend"):
        try:
            out[key] = float(given.get(key) or 0.0)
        except ValueError:
            raise ModelError(
                f"{where}: {PLUGIN} has {key}={given[key]!r}, expected a number in Pa"
            ) from None
    return out


def _replace(root: ET.Element, old: ET.Element, new: ET.Element) -> None:
    for parent in root.iter():
        for n, child in enumerate(parent):
            if child is old:
                new.tail = child.tail
                parent[n] = new
                return


def cable_elements(m: mujoco.MjModel) -> list[Cable]:
    """Read the cables of a compiled model.

    They have no force if springs and dampers are both disabled, as in MuJoCo.
    """
    out: list[Cable] = []
    if not (is_on(m, Off.mjDSBL_SPRING) or is_on(m, Off.mjDSBL_DAMPER)):
        return out
    for i in range(m.ntext):
        name = mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_TEXT, i)
        prefix, marked, _ = name.partition(TEXT)  # an attached robot has a prefix
        if marked and m.text_size[i]:
            start = m.text_adr[i]
            data = m.text_data[start : start + m.text_size[i] - 1]
            values = json.loads(data if isinstance(data, (str, bytes)) else bytes(data))
            for key in ("bodies", "joints"):
                values[key] = [prefix + x for x in values.get(key, ())]
            cable = _written if values["joints"] else _compiled
            found = cable(m, name.replace(TEXT, ""), values)
            out += [found] if found.joints else []
    return out


def switch_off_cables(m: mujoco.MjModel) -> tuple[str, ...]:
    """Change a compiled model so that `cable_elements` finds nothing, because MuJoCo 4 has no
    elasticity of cables. Return the sentences about what is switched off."""
    names = [mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_TEXT, i) for i in range(m.ntext)]
    found = [i for i, name in enumerate(names) if TEXT in name]
    m.text_size[found] = 0
    return ("elasticity of cables, which MuJoCo 4 does not have",) if found else ()


def _written(m: mujoco.MjModel, name: str, values: dict[str, Any]) -> Cable:
    """Make the element from numbers that `write_cables` wrote."""
    joints = [mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_JOINT, x) for x in values["joints"]]
    if -1 in joints:
        lost = values["joints"][joints.index(-1)]
        raise ModelError(
            f"cable {name!r}: the file has no joint {lost!r}, which its text in <custom> names; "
            "remove the text, or give a joint this name"
        )
    numbers = {key: leaf(np.array(values[key])) for key in _NUMBERS}
    return Cable(**numbers, joints=tuple(joints), law=values["law"])


def _compiled(m: mujoco.MjModel, name: str, values: dict[str, Any]) -> Cable:
    """Make the element of one instance from the compiled bodies."""
    given = values["bodies"]
    bodies = [mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, x) for x in given]
    parents = zip(bodies[1:], bodies, strict=False)
    if -1 in bodies or any(m.body_parentid[b] != parent for b, parent in parents):
        raise ModelError(
            f"cable {name!r}: the bodies {given} are not a chain, expected each to be the child of "
            "the body before; give each chain an instance of the plugin, without fusestatic and "
            "<replicate>"
        )
    segments = bodies[1:]
    others = [m.body(b).name for b in segments if not _on_a_ball(m, b)]
    if others:
        raise ModelError(
            f"cable {name!r}: the bodies {others} of {PLUGIN} have other joints than one ball, "
            "expected a ball joint in each body after the first; for hinges use joint stiffness"
        )
    length = np.linalg.norm(m.body_pos[segments], axis=-1)
    if not length.all():
        at = m.body(segments[int(np.argmin(length))]).name
        raise ModelError(
            f"cable {name!r}: the body {at!r} is at the place of its parent, expected a distance "
            "above zero; it is the length of the segment"
        )
    turned = np.zeros((len(segments), 3))
    for row, b in zip(turned, segments, strict=True):
        if not values.get("flat"):
            mujoco.mju_quat2Vel(row, m.body_quat[b], 1.0)
    section = np.array([_section(m, b, name) for b in segments]).reshape(-1, 3)
    return Cable(
        twist=leaf(values["twist"]),
        bend=leaf(values["bend"]),
        section=leaf(section),
        length=leaf(length),
        rest=leaf(turned),
        joints=tuple(int(m.body_jntadr[b]) for b in segments),
        law="mujoco",
    )


def _on_a_ball(m: mujoco.MjModel, body: int) -> bool:
    ball = int(mujoco.mjtJoint.mjJNT_BALL)
    return m.body_jntnum[body] == 1 and m.jnt_type[m.body_jntadr[body]] == ball


def _section(m: mujoco.MjModel, body: int, name: str) -> list[float]:
    """Compute J, I_y, I_z of the first geom of a body."""
    kinds, geom = mujoco.mjtGeom, int(m.body_geomadr[body])
    kind = int(m.geom_type[geom]) if geom >= 0 else -1
    if kind in (int(kinds.mjGEOM_CAPSULE), int(kinds.mjGEOM_CYLINDER)):
        return circle(float(m.geom_size[geom, 0]))
    if kind == int(kinds.mjGEOM_BOX):
        return rectangle(*map(float, m.geom_size[geom, 1:]))
    raise ModelError(
        f"cable {name!r}: the first geom of the body {m.body(body).name!r} gives no section, "
        "expected a capsule, a cylinder or a box"
    )


def write_cables(root: ET.Element, cables: list[Cable], joints: Callable[[int], str]) -> None:
    """Write cables into the section <custom>, for `load`. Joints of the cables are indices, and
    `joints` returns their names in the file."""
    custom = ET.SubElement(root, "custom") if cables else root
    for n, cable in enumerate(cables):
        values = {key: np.asarray(getattr(cable, key), float).tolist() for key in _NUMBERS}
        values |= {"joints": [joints(int(j)) for j in cable.joints], "law": cable.law}
        ET.SubElement(custom, "text", name=f"{TEXT}{n}", data=json.dumps(values))
