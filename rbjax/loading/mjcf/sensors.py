"""Sensors of a compiled MuJoCo model as `model.sensors`.

A frame sensor of a `body` measures at the body's inertial frame, one of an `xbody` at the frame of
the body, as in MuJoCo.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from rbjax import sensors
from rbjax.loading.mjcf.fields import Off, inertial_frame, is_off, is_on, reason_left_out
from rbjax.model import Frame
from rbjax.sensors import NamedSensor, Volume
from rbjax.sensors.contacts import DATA as CONTACT_DATA
from rbjax.sensors.contacts import REDUCTIONS
from rbjax.sensors.geometry.rangefinder import DATA
from rbjax.sensors.geometry.rays import INTERSECTIONS

_OBJECT = SimpleNamespace(
    **{x.name[6:]: int(x) for x in map(mujoco.mjtObj, range(int(mujoco.mjtObj.mjNOBJECT)))}
)


class NotRead(Exception):
    """Raised for a sensor that is not read; the message is the reason, for `model.dropped`."""


def read_sensors(m: mujoco.MjModel) -> tuple[tuple[NamedSensor, ...], dict[str, list[int]]]:
    """Read the sensors of a file, in its order, and list by reason the sensors that are not read,
    or not read as the file means them."""
    found: list[NamedSensor] = []
    left_out: dict[str, list[int]] = {}
    for i in range(m.nsensor):
        try:
            sensor = _sensor(m, i)
        except NotRead as reason:
            left_out.setdefault(str(reason), []).append(i)
            continue
        name = mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_SENSOR, i) or f"sensor{i}"
        cutoff, noise = float(m.sensor_cutoff[i]), float(m.sensor_noise[i])
        found.append(NamedSensor(name, sensor, cutoff, noise))
        for change in _changes(m, i):
            left_out.setdefault(change, []).append(i)
    return tuple(found), left_out


def _changes(m: mujoco.MjModel, i: int) -> list[str]:
    """List the features of sensor i of the file that the sensor of the model does not have."""
    out = []
    if not is_on(m, Off.mjDSBL_SENSOR):
        out.append("the flag that switches sensors off")
    if m.sensor_delay[i] or m.sensor_interval[i].any():
        out.append("delays and intervals of sensors")
    kinds = {mujoco.mjtGeom(int(t)).name[7:].lower() for t in m.geom_type[m.geom_rgba[:, 3] != 0]}
    if (
        m.sensor_type[i] == int(mujoco.mjtSensor.mjSENS_RANGEFINDER)
        and kinds - INTERSECTIONS.keys()
    ):
        unseen = ", ".join(sorted(kinds - INTERSECTIONS.keys()))
        out.append(f"geoms that rangefinders do not see: {unseen}")
    return out


def _sensor(m: mujoco.MjModel, i: int) -> Any:
    kind = mujoco.mjtSensor(int(m.sensor_type[i])).name[7:].lower()
    if kind not in _READERS:
        raise NotRead(f"sensors of the kind {kind}")
    make, read = _READERS[kind]
    return make(*read(m, i))


def _name(m: mujoco.MjModel, kind: int, i: int) -> Any:
    """Return the name of an object, or its index if it has no name."""
    shift = 1 if kind in (_OBJECT.BODY, _OBJECT.XBODY) else 0
    named = _OBJECT.BODY if shift else kind
    return mujoco.mj_id2name(m, mujoco.mjtObj(named), i) or i - shift


def _frame_of(m: mujoco.MjModel, kind: int, i: int) -> Frame:
    if kind == _OBJECT.CAMERA:
        if m.cam_mode[i] != int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED):
            raise NotRead("sensors of cameras that track")
        body = _name(m, _OBJECT.XBODY, int(m.cam_bodyid[i]))
        return Frame(body, tuple(m.cam_pos[i].tolist()), orientation=tuple(m.cam_quat[i].tolist()))
    name = _name(m, kind, i)
    if kind == _OBJECT.SITE:
        return Frame(site=name)
    if kind == _OBJECT.GEOM:
        return Frame(geom=name)
    if kind == _OBJECT.BODY and i:
        _, turn = inertial_frame(m, i)
        still = (turn == [1.0, 0.0, 0.0, 0.0]).all()
        return Frame(center=name, orientation=None if still else tuple(turn.tolist()))
    return Frame(body=name)


def _frame(m: mujoco.MjModel, i: int) -> tuple[Frame]:
    return (_frame_of(m, int(m.sensor_objtype[i]), int(m.sensor_objid[i])),)


def _relative(m: mujoco.MjModel, i: int) -> tuple[Frame, Frame | None]:
    other = int(m.sensor_refid[i])
    base = None if other < 0 else _frame_of(m, int(m.sensor_reftype[i]), other)
    return (*_frame(m, i), base)


def _magnetometer(m: mujoco.MjModel, i: int) -> tuple:
    return (*_frame(m, i), tuple(m.opt.magnetic.tolist()))


def _volume_of(m: mujoco.MjModel, site: int) -> Volume:
    kind = mujoco.mjtGeom(int(m.site_type[site])).name[7:].lower()
    return Volume(kind, tuple(m.site_size[site].tolist()))


def _touch(m: mujoco.MjModel, i: int) -> tuple:
    return (*_frame(m, i), _volume_of(m, int(m.sensor_objid[i])))


def _inside_site(m: mujoco.MjModel, i: int) -> tuple:
    site = int(m.sensor_refid[i])
    return _frame_of(m, _OBJECT.SITE, site), _volume_of(m, site), *_frame(m, i)


def _projection(m: mujoco.MjModel, i: int) -> tuple:
    """Return the camera, the site, and the focal lengths and the resolution in pixels."""
    camera = int(m.sensor_refid[i])
    width, height = m.cam_resolution[camera].tolist()
    size = m.cam_sensorsize[camera]
    if size.all():  # the single precision of MuJoCo's product
        focal = m.cam_intrinsic[camera, :2] / size * np.array([width, height], np.float32)
    else:
        focal = np.full(2, 0.5 * height / np.tan(np.radians(m.cam_fovy[camera]) / 2))
    lengths = tuple(focal.tolist())
    return _frame_of(m, _OBJECT.CAMERA, camera), *_frame(m, i), lengths, (width, height)


def _rangefinder(m: mujoco.MjModel, i: int) -> tuple:
    if m.sensor_objtype[i] != _OBJECT.SITE:
        raise NotRead("rangefinders of cameras")
    spec = int(m.sensor_intprm[i, 0])
    return (*_frame(m, i), tuple(part for k, part in enumerate(DATA) if spec >> k & 1) or ("dist",))


def _object(m: mujoco.MjModel, i: int) -> tuple:
    """Return the joint or the body of a sensor."""
    kind, which = int(m.sensor_objtype[i]), int(m.sensor_objid[i])
    return (_name(m, kind, which),)


def _joint_limit(m: mujoco.MjModel, i: int) -> tuple:
    return (*_object(m, i), float(m.jnt_margin[m.sensor_objid[i]]))


def _control(m: mujoco.MjModel, actuator: int) -> int:
    """Return the index of an actuator's first control. Raise `NotRead` if the actuator is not
    supported."""
    why = "disabled actuators" if is_off(m, actuator) else reason_left_out(m, actuator)
    if why:
        raise NotRead(f"sensors of actuators: {why}")
    if m.actuator_gaintype[actuator] == int(mujoco.mjtGain.mjGAIN_SO3):
        raise NotRead("sensors of orientation servos")
    if not m.actuator_ctrlnum[actuator]:
        raise NotRead("sensors of actuators without controls")
    return int(m.actuator_ctrladr[actuator])


def _actuator(m: mujoco.MjModel, i: int) -> tuple[int]:
    return (_control(m, int(m.sensor_objid[i])),)


def _tendon(m: mujoco.MjModel, i: int) -> tuple:
    return (_name(m, _OBJECT.TENDON, int(m.sensor_objid[i])),)


def _tendon_actuators(m: mujoco.MjModel, i: int) -> tuple:
    at_tendon = m.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
    for k in np.flatnonzero(at_tendon & (m.actuator_trnid[:, 0] == m.sensor_objid[i])).tolist():
        if reason_left_out(m, k):
            raise NotRead(f"sensors of actuators: {reason_left_out(m, k)}")
    return _tendon(m, i)


def _contact(m: mujoco.MjModel, i: int) -> tuple:
    spec, reduce, num = m.sensor_intprm[i, :3].tolist()
    parts: list[str | tuple[str, Any] | None] = []
    volume = sensors.Volume("sphere", (0.005,))
    for kind, which in (
        (m.sensor_objtype[i], m.sensor_objid[i]), (m.sensor_reftype[i], m.sensor_refid[i])
    ):  # fmt: skip
        kind, which = int(kind), int(which)
        if kind == _OBJECT.UNKNOWN or which < 0:
            parts.append(None)
            continue
        if kind == _OBJECT.SITE:
            volume = _volume_of(m, which)
        named = _name(m, kind, which)
        word = _PARTS[kind]
        parts.append(f"{word}:{named}" if isinstance(named, str) else (word, named))
    data = tuple(part for k, part in enumerate(CONTACT_DATA) if spec >> k & 1)
    return *parts, data, REDUCTIONS[reduce], num, volume


#: object of a contact sensor -> kind of part
_PARTS = {
    _OBJECT.GEOM: "geom", _OBJECT.BODY: "body", _OBJECT.XBODY: "subtree", _OBJECT.SITE: "site"
}  # fmt: skip


def _nothing(m: mujoco.MjModel, i: int) -> tuple[()]:
    return ()


Reader = Callable[[mujoco.MjModel, int], tuple]
#: kind of MuJoCo -> class of the sensor, and reader of its arguments
_READERS: dict[str, tuple[Callable, Reader]] = {
    "touch": (sensors.Touch, _touch),
    "accelerometer": (sensors.Accelerometer, _frame),
    "velocimeter": (sensors.Velocimeter, _frame),
    "gyro": (sensors.Gyro, _frame),
    "force": (sensors.ForceSensor, _frame),
    "torque": (sensors.TorqueSensor, _frame),
    "magnetometer": (sensors.Magnetometer, _magnetometer),
    "camprojection": (sensors.CameraProjection, _projection),
    "rangefinder": (sensors.Rangefinder, _rangefinder),
    "jointpos": (sensors.JointPosition, _object),
    "jointvel": (sensors.JointVelocity, _object),
    "tendonpos": (sensors.TendonPosition, _tendon),
    "tendonvel": (sensors.TendonVelocity, _tendon),
    "actuatorpos": (sensors.ActuatorPosition, _actuator),
    "actuatorvel": (sensors.ActuatorVelocity, _actuator),
    "actuatorfrc": (sensors.ActuatorForce, _actuator),
    "jointactfrc": (sensors.JointActuatorForce, _object),
    "tendonactfrc": (sensors.TendonActuatorForce, _tendon_actuators),
    "ballquat": (sensors.BallQuaternion, _object),
    "ballangvel": (sensors.BallAngularVelocity, _object),
    "jointlimitpos": (sensors.JointLimitPosition, _joint_limit),
    "jointlimitvel": (sensors.JointLimitVelocity, _joint_limit),
    "jointlimitfrc": (sensors.JointLimitForce, _joint_limit),
    "tendonlimitpos": (sensors.TendonLimitPosition, _tendon),
    "tendonlimitvel": (sensors.TendonLimitVelocity, _tendon),
    "tendonlimitfrc": (sensors.TendonLimitForce, _tendon),
    "contact": (sensors.ContactSensor, _contact),
    "framepos": (sensors.Position, _relative),
    "framequat": (sensors.Attitude, _relative),
    "framexaxis": (sensors.FrameXAxis, _relative),
    "frameyaxis": (sensors.FrameYAxis, _relative),
    "framezaxis": (sensors.FrameZAxis, _relative),
    "framelinvel": (sensors.LinearVelocity, _relative),
    "frameangvel": (sensors.AngularVelocity, _relative),
    "framelinacc": (sensors.LinearAcceleration, _frame),
    "frameangacc": (sensors.AngularAcceleration, _frame),
    "subtreecom": (sensors.SubtreeCenter, _object),
    "subtreelinvel": (sensors.SubtreeVelocity, _object),
    "subtreeangmom": (sensors.SubtreeAngularMomentum, _object),
    "insidesite": (sensors.InsideSite, _inside_site),
    "e_potential": (sensors.PotentialEnergy, _nothing),
    "e_kinetic": (sensors.KineticEnergy, _nothing),
    "clock": (sensors.Clock, _nothing),
}

#: class of a sensor -> kind of MuJoCo
CLASSES: dict[Any, str] = {make: kind for kind, (make, _) in _READERS.items()}
