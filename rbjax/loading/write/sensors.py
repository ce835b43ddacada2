"""Sensors of a model as elements of an MJCF file.

A frame that is a site or a body is written as such. At any other frame, such as a center of mass,
the file gets a site.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from typing import Any

import numpy as np

from rbjax import sensors
from rbjax.forces import Place
from rbjax.loading.mjcf.fields import quaternion_of
from rbjax.loading.mjcf.sensors import CLASSES
from rbjax.loading.write.draft import Draft, text, unique
from rbjax.model import WORLD, Frame
from rbjax.model.leaves import frame_transform
from rbjax.sensors.actuators import ActuatorSensor, TendonSensor
from rbjax.sensors.bodies import SubtreeSensor
from rbjax.sensors.contacts import part_of
from rbjax.sensors.fixed import FrameSensor, named_frame
from rbjax.sensors.joints import JointLimitSensor, OneJointSensor

#: kind of MuJoCo -> element of the file, if they differ
_TAGS = {"jointactfrc": "jointactuatorfrc", "tendonactfrc": "tendonactuatorfrc"}


def write_sensors(draft: Draft) -> list[sensors.NamedSensor]:
    """Write the sensors in order. Return the sensors that the file contains."""
    section = ET.SubElement(draft.root, "sensor")
    written = []
    names = unique([sensor.name for sensor in draft.model.sensors])
    for name, sensor in zip(names, draft.model.sensors, strict=True):
        kind = CLASSES.get(type(sensor.sensor))
        attributes = None if kind is None else _attributes(draft, sensor.sensor)
        if kind is None or attributes is None:
            draft.note("sensors that are left out", [sensor.name])
            continue
        for key in ("cutoff", "noise"):
            if getattr(sensor, key):
                attributes[key] = text(getattr(sensor, key))
        ET.SubElement(section, _TAGS.get(kind, kind), {"name": name} | attributes)
        written.append(sensor.replace(name=name))
    return written


def _attributes(draft: Draft, sensor: Any) -> dict[str, str] | None:
    """Return the attributes of a sensor, or None if the file cannot have it."""
    for kind, write in _WRITERS:
        if isinstance(sensor, kind):
            return write(draft, sensor)
    return {}


def _frame(draft: Draft, frame: Any, prefix: str = "obj") -> dict[str, str]:
    named = named_frame(draft.model, frame)
    if named.point is None and named.orientation is None and named.body is not None:
        return {f"{prefix}type": "xbody", f"{prefix}name": _body(draft, named.body)}
    return {f"{prefix}type": "site", f"{prefix}name": _site(draft, named)}


def _body(draft: Draft, body: Any) -> str:
    fixed = body == WORLD or (body == "world" and body not in draft.model.body_names)
    return "world" if fixed else draft.bodies[draft.model.body(body)].get("name", "")


def _site(draft: Draft, frame: Any) -> str:
    """Return the name of the site at a frame; add the site if there is none."""
    model, named = draft.model, named_frame(draft.model, frame)
    if named.site is not None and named.point is None and named.orientation is None:
        return draft.sites[model.site(named.site)]
    body, placed = frame_transform(model, named, np.float64)
    quat: Any = quaternion_of([float(x) for x in placed.R])
    position: Any = np.array([float(x) for x in placed.p])
    return draft.site(Place(position, quat, None if body == WORLD else body))


def _at_site(draft: Draft, sensor: Any) -> dict[str, str]:
    return {"site": _site(draft, sensor.frame)}


def _magnetometer(draft: Draft, sensor: Any) -> dict[str, str] | None:
    field = text(np.array(sensor.field))
    if draft.option.get("magnetic", field) != field:  # a file has one field
        return None
    draft.option.set("magnetic", field)
    return _at_site(draft, sensor)


def _volume(draft: Draft, sensor: Any) -> dict[str, str] | None:
    site = _site_of_volume(draft, sensor.frame, sensor.volume)
    inside = isinstance(sensor, sensors.InsideSite)
    return site and site | (_frame(draft, sensor.other) if inside else {})


def _site_of_volume(draft: Draft, frame: Any, volume: sensors.Volume) -> dict[str, str] | None:
    """Give the site of a frame the shape of a volume. Return the attribute that names the site, or
    None if the site already has another shape."""
    name = _site(draft, frame)
    shape = {"type": volume.kind, "size": text(np.array(volume.size))}
    element = next(x for x in draft.world.iter("site") if x.get("name") == name)
    if any(element.get(key, x) != x for key, x in shape.items()):
        return None
    element.attrib |= shape
    return {"site": name}


def _contact(draft: Draft, sensor: Any) -> dict[str, str] | None:
    out = {"data": " ".join(sensor.data), "reduce": sensor.reduce, "num": str(sensor.num)}
    for number, given in (("1", sensor.first), ("2", sensor.second)):
        kind, index = part_of(draft.model, given)
        if kind == "site":
            site = _site_of_volume(draft, Frame(site=index), sensor.volume)
            if site is None:
                return None
            out |= site
        elif kind == "geom":
            if index not in draft.geoms:
                return None
            out["geom" + number] = draft.geoms[index].get("name", "")
        elif kind:
            out[kind + number] = _body(draft, index)
    return out


def _rangefinder(draft: Draft, sensor: Any) -> dict[str, str]:
    geoms = draft.model.geoms
    if geoms is None or len(draft.geoms) < len(geoms.names):
        draft.note("geoms that rangefinders see, which are not in the file")
    return _at_site(draft, sensor) | {"data": " ".join(sensor.data)}


def _camera(draft: Draft, sensor: Any) -> dict[str, str]:
    """Add a camera with the angle of view of the sensor, or its focal lengths in pixels.

    MuJoCo keeps focal lengths in single precision, but the angle of view in double precision.
    """
    body, placed = frame_transform(draft.model, named_frame(draft.model, sensor.frame), np.float64)
    quat = quaternion_of([float(x) for x in placed.R])
    name = unique(["camera"], [x.get("name", "") for x in draft.world.iter("camera")])[0]
    size, (fx, fy) = text(np.array(sensor.resolution)), sensor.focal
    if fx == fy:
        fovy = 2 * np.degrees(np.arctan(0.5 * sensor.resolution[1] / fy))
        lens = {"fovy": text(np.array([fovy]))}
    else:
        lens = {"sensorsize": size, "focal": text(np.array(sensor.focal))}
    draft.add(
        body, "camera", name=name, pos=text(np.array([float(x) for x in placed.p])),
        quat=text(quat), resolution=size, **lens,
    )  # fmt: skip
    return {"site": _site(draft, sensor.seen), "camera": name}


def _relative(draft: Draft, sensor: Any) -> dict[str, str]:
    base = getattr(sensor, "reference", None)
    found = _frame(draft, sensor.frame)
    return found if base is None else found | _frame(draft, base, "ref")


def _joint(draft: Draft, sensor: Any) -> dict[str, str]:
    joint = draft.model.joint(sensor.joint)
    if isinstance(sensor, JointLimitSensor) and sensor.margin:
        draft.joints[joint].set("margin", text(sensor.margin))
    return {"joint": draft.joint(joint)}


def _actuator(draft: Draft, sensor: Any) -> dict[str, str] | None:
    name = draft.model.actuator_names[draft.model.actuator(sensor.actuator)]
    name = re.sub(r"\[\d+\]$", "", name)
    return {"actuator": name} if any(x.get("name") == name for x in draft.actuator) else None


def _subtree(draft: Draft, sensor: Any) -> dict[str, str]:
    return {"body": _body(draft, sensor.body)}


def _tendon(draft: Draft, sensor: Any) -> dict[str, str]:
    return {"tendon": draft.tendons[draft.model.tendon(sensor.tendon)]}


Writer = Callable[[Draft, Any], dict[str, str] | None]
#: base class -> writer of the attributes; the first that fits
_WRITERS: list[tuple[Any, Writer]] = [
    (sensors.Magnetometer, _magnetometer),
    (sensors.Rangefinder, _rangefinder),
    (sensors.CameraProjection, _camera),
    ((sensors.Touch, sensors.InsideSite), _volume),
    ((sensors.Gyro, sensors.Velocimeter, sensors.Accelerometer), _at_site),
    ((sensors.ForceSensor, sensors.TorqueSensor), _at_site),
    (sensors.ContactSensor, _contact),
    (FrameSensor, _relative),
    (OneJointSensor, _joint),
    (ActuatorSensor, _actuator),
    (SubtreeSensor, _subtree),
    (TendonSensor, _tendon),
]


def sensors_differ(draft: Draft, again: Any, written: list[sensors.NamedSensor]) -> list[str]:
    """Return the names of sensors that are read back as others."""
    pairs = dict(zip([x.name for x in again.sensors], again.sensors, strict=True))
    out = []
    for sensor in written:
        read = pairs.get(sensor.name)
        if (
            read is None
            or (read.cutoff, read.noise) != (sensor.cutoff, sensor.noise)
            or _facts(draft.model, sensor.sensor) != _facts(again, read.sensor)
        ):
            out.append(sensor.name)
    return out


def _facts(model: Any, sensor: Any) -> list:
    """Return the type and the fields of a sensor, for comparison. Frames are given as a body and a
    rounded pose."""
    out: list = [type(sensor)]
    for name in ("frame", "reference", "other", "seen"):
        given = getattr(sensor, name, None)
        if given is not None:
            body, placed = frame_transform(model, named_frame(model, given), np.float64)
            out.append((body, *(round(float(x), 9) + 0.0 for x in (*placed.R, *placed.p))))
    for name in ("field", "data", "volume", "resolution"):
        out.append(getattr(sensor, name, None))
    out.append(np.round(getattr(sensor, "focal", 0.0), 3).tolist())  # MuJoCo keeps single precision
    if isinstance(sensor, JointLimitSensor):
        out.append(sensor.margin)
    if isinstance(sensor, TendonSensor):
        out.append(model.tendon(sensor.tendon))
    if hasattr(sensor, "joint"):
        out.append(model.joint(sensor.joint))
    if hasattr(sensor, "actuator"):
        out.append(model.actuator(sensor.actuator))
    return out
