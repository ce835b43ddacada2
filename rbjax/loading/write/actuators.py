"""Actuators as MJCF's <general>: what `load` and `force_actuators` read, the other way round."""

from __future__ import annotations

import dataclasses
import re
import xml.etree.ElementTree as ET
from typing import Any

import mujoco
import numpy as np

from rbjax.forces import Element
from rbjax.forces.actuators.activation import Activation, Filter, Integrator, Recruitment
from rbjax.forces.actuators.actuator import Active, Actuator, Affine, ForceLaw, GainBias, Passive
from rbjax.forces.actuators.affine import from_columns, is_affine
from rbjax.forces.actuators.dc_motor import DCMotor
from rbjax.forces.actuators.muscle import Muscle
from rbjax.forces.actuators.orientation_servo import OrientationServo
from rbjax.forces.actuators.pid import PID
from rbjax.forces.actuators.transmissions import (
    JointAxis,
    JointSum,
    SitePath,
    SitePose,
    SiteWrench,
    SliderCrank,
    Transmission,
)
from rbjax.loading.write.draft import Draft, text

_OFF = 30  # the group of controls that drive nothing, which the file switches off
_RANGES = {"pos": "ctrlrange", "vel": "velrange", "ff": "ffrange"}


def write_actuators(draft: Draft) -> list[Element]:
    """Write them in the order of their controls; return the elements as they will be read."""
    model, elements = draft.model, []
    at: dict[float, Element | None] = dict.fromkeys(range(model.nu))
    at |= {one.controls[0]: _shortest(one) for one in from_columns(model)}
    last = -0.5
    for element in model.forces:
        if type(element) in (Actuator, OrientationServo):
            # one without controls comes behind the one before it
            last = element.controls[0] if element.controls else np.nextafter(last, np.inf)
            for control in element.controls:
                at.pop(control, None)
            at[last] = element
    for row, element in sorted(at.items(), key=lambda item: item[0]):
        if element is None:
            _write_nothing(draft, model.actuator_names[int(row)])
        else:
            elements.append(_write_element(draft, element))
    return [x for x in elements if not is_affine(x)]


def _shortest(row: Actuator) -> Actuator:
    """A row of `model.actuators` without a bias of zeros, and with a constant gain if it has no
    bias. With a bias its gain is affine: MuJoCo takes a constant one for a servo on an angle."""
    law: Any = row.law
    bias = law.bias if law.bias.coefficients.any() else None
    constant = bias is None and not law.gain.coefficients[1:].any()
    gain = Affine(law.gain.coefficients[:1]) if constant else law.gain
    return dataclasses.replace(row, law=GainBias(gain, bias, None))


def _write_nothing(draft: Draft, name: str) -> None:
    """A control that drives nothing still has its place among the controls."""
    if not draft.joints:
        draft.note("controls that drive nothing, left out for want of a joint", [name])
        return
    draft.option.set("actuatorgroupdisable", str(_OFF))
    ET.SubElement(
        draft.actuator, "general", name=name, joint=draft.joint(0), gear="0", group=str(_OFF)
    )


def _short(x: Any) -> str:
    """Numbers without the zeros at their end."""
    return text(np.trim_zeros(x, "b") if np.any(x) else 0.0)


def _range(name: str, limits: Any) -> dict[str, str]:
    return {name: text(limits)} if np.isfinite(limits).any() else {}


def _name(draft: Draft, controls: tuple[int, ...]) -> dict[str, str]:
    """The name of an actuator: of several controls, what stands before their numbers."""
    names = [draft.model.actuator_names[c] for c in controls]
    if not names:
        return {}
    return {"name": names[0] if len(names) == 1 else re.sub(r"\[0\]$", "", names[0])}


def _write_element(draft: Draft, element: Any) -> Element:
    entry = ET.SubElement(draft.actuator, "general", _name(draft, element.controls))
    if isinstance(element, OrientationServo):
        return _write_servo(draft, entry, element)
    entry.attrib |= _transmission(draft, element.transmission)
    entry.attrib |= _range("forcerange", element.forcerange)
    inputs: tuple[str, ...] = ("pos",)
    law: ForceLaw = element.law
    if isinstance(law, PID):
        inputs = law.controller.inputs
        entry.attrib |= _pid(law)
    elif isinstance(law, DCMotor):
        inputs = (*(law.controller.inputs if law.controller else ()), *["voltage"] * law.voltage)
        entry.attrib |= _dc_motor(law, inputs)
    elif isinstance(law, GainBias):
        law = _plain(law)
        entry.attrib |= _gain_bias(law)
    else:
        draft.actuator.remove(entry)
        name = entry.get("name", "without a name")
        draft.note(f"no MJCF form, left out: actuators with the law {type(law).__name__}", [name])
        for control in element.controls:
            _write_nothing(draft, draft.model.actuator_names[control])
        return element
    for which, limits in zip(inputs, element.ctrlrange, strict=True):
        entry.attrib |= _range(_RANGES.get(which, "ctrlrange"), limits)
    return dataclasses.replace(element, law=law)


def _transmission(draft: Draft, x: Transmission) -> dict[str, str]:
    if isinstance(x, JointAxis):
        word = "jointinparent" if x.in_parent else "joint"
        return {word: draft.joint(x.joint), "gear": _short(x.gear)}
    if isinstance(x, SiteWrench):
        return {"site": draft.sites[x.site], "gear": _short(x.gear)}
    if isinstance(x, SitePose):
        ends = {"site": draft.sites[x.site], "refsite": draft.sites[x.reference]}
        return ends | {"gear": _short(x.gear)}
    if isinstance(x, SliderCrank):
        ends = {"cranksite": draft.sites[x.crank], "slidersite": draft.sites[x.slider]}
        return ends | {"cranklength": text(x.rod), "gear": _short(x.gear)}
    if not isinstance(x, (JointSum, SitePath)):
        raise TypeError(f"no MJCF form of the transmission {type(x).__name__}")
    name = f"tendon{len(draft.tendon)}"
    if isinstance(x, JointSum):
        tendon = ET.SubElement(draft.tendon, "fixed", name=name)
        for joint, c in zip(x.joints, x.coefficients, strict=True):
            ET.SubElement(tendon, "joint", joint=draft.joint(joint), coef=text(c))
    else:
        _write_path(draft, ET.SubElement(draft.tendon, "spatial", name=name), x)
    return {"tendon": name, "gear": _short(x.gear)}


def _write_path(draft: Draft, tendon: ET.Element, path: SitePath) -> None:
    """Sites one after the other; a pulley where a segment does not go on from the last one."""
    last, divisor = -1, 1.0
    for (a, b), own in zip(path.segments, path.divisors, strict=True):
        if own != divisor or (last >= 0 and last != a):
            ET.SubElement(tendon, "pulley", divisor=text(own))
            last, divisor = -1, own
        if last < 0:
            ET.SubElement(tendon, "site", site=draft.sites[a])
        ET.SubElement(tendon, "site", site=draft.sites[b])
        last = b


def _activation(activation: Activation | None, early: bool) -> dict[str, str]:
    if activation is None:
        return {}
    out = _range("actrange", activation.limits)
    if early:
        out["actearly"] = "true"
    if isinstance(activation, Integrator):
        return out | {"dyntype": "integrator"}
    if isinstance(activation, Recruitment):
        width = activation.width if activation.smooth else 0.0
        given = [*activation.time_constants, width]
        return out | {"dyntype": "muscle", "dynprm": text(given)}
    assert isinstance(activation, Filter)
    kind = "filterexact" if activation.exact else "filter"
    return out | {"dyntype": kind, "dynprm": text(activation.time_constant)}


def _plain(law: GainBias) -> GainBias:
    """The law with the peak force of muscles as a number: what MuJoCo computes it from is not
    in the file."""

    def plain(muscle: Muscle) -> Muscle:
        if not muscle.scaled:
            return muscle
        p: Any = np.array(muscle.parameters)
        p[2] = p[3] / max(float(muscle.acceleration), mujoco.mjMINVAL)
        return dataclasses.replace(muscle, parameters=p, scaled=False)

    gain, bias = law.gain, law.bias
    if isinstance(gain, Active):
        gain = Active(plain(gain.muscle))
    if isinstance(bias, Passive):
        bias = Passive(plain(bias.muscle))
    return dataclasses.replace(law, gain=gain, bias=bias)


def _gain_bias(law: GainBias) -> dict[str, str]:
    out = _activation(law.activation, law.early)
    muscles = [x.muscle for x in (law.gain, law.bias) if isinstance(x, (Active, Passive))]
    if muscles:
        out["lengthrange"] = text(muscles[0].lengthrange)
    if isinstance(law.gain, Affine):
        constant = len(law.gain.coefficients) == 1
        out |= {} if constant else {"gaintype": "affine"}
        if not (constant and law.gain.coefficients[0] == 1):
            out["gainprm"] = _short(law.gain.coefficients)
    else:
        out |= {"gaintype": "muscle", "gainprm": text(law.gain.muscle.parameters)}
    if isinstance(law.bias, Affine):
        out |= {"biastype": "affine", "biasprm": text(law.bias.coefficients)}
    elif law.bias is not None:
        out |= {"biastype": "muscle", "biasprm": text(law.bias.muscle.parameters)}
    return out


def _zero_if_infinite(x: Any) -> Any:
    """A limit as MJCF has it: zero where there is none."""
    return np.where(np.isfinite(x), x, np.zeros_like(x))


def _pid(law: PID) -> dict[str, str]:
    own = law.controller
    kp, ki, kv = own.gains
    out = _range("actrange", law.limits)
    out |= {"gaintype": "pid", "gainprm": text(ki), "biastype": "affine"}
    out |= {"biasprm": text([law.offset, -kp, -kv]), "input": " ".join(own.inputs)}
    if not own.size:
        return out | {"dynprm": "0"}
    windup, slew = map(_zero_if_infinite, (own.windup, own.slew))
    out |= {"dyntype": "pid", "dynprm": text([windup, slew]), "actdim": str(own.size)}
    return out | ({"actearly": "true"} if law.early else {})


def _dc_motor(law: DCMotor, inputs: tuple[str, ...]) -> dict[str, str]:
    w, own = law.windings, law.controller
    kp, ki, kd = (0, 0, 0) if own is None else own.gains
    drive, current_rate = map(_zero_if_infinite, (w.drive, w.current_rate))
    slew, windup = (0, 0) if own is None else map(_zero_if_infinite, (own.slew, own.windup))
    RT, C, Ta, alpha, T0 = (0,) * 5 if law.heat is None else law.heat.numbers
    s0, s1, FC, FS, vS = (0,) * 5 if law.bristles is None else law.bristles.numbers
    te = w.time_constant if w.inductive else 0
    out = {"dyntype": "dcmotor", "gaintype": "dcmotor", "biastype": "dcmotor"}
    out |= {"input": " ".join(inputs) or "none", "actlimited": "false", "actearly": "true"}
    out |= {"gainprm": text([w.resistance, w.constant, alpha, T0, kp, ki, kd, drive])}
    out |= {"dynprm": text([te, current_rate, RT, C, Ta, s0, s1, slew, windup])}
    out |= {"biasprm": text([*law.cogging, FC, FS, vS])}
    return out | ({"actdim": str(law.size)} if law.size else {})


def _write_servo(draft: Draft, entry: ET.Element, servo: OrientationServo) -> OrientationServo:
    kp, constant, kv = servo.gains
    if servo.joint >= 0:
        entry.set("joint", draft.joint(servo.joint))
    else:
        entry.set("site", draft.sites[servo.site])
        entry.set("refsite", draft.sites[servo.reference])
    entry.attrib |= {"gaintype": "so3", "biastype": "so3", "gainprm": text(kp)}
    entry.attrib |= {"biasprm": text([constant, -kp, -kv])}
    entry.attrib |= {"input": "quat"} if len(servo.controls) == 4 else {}
    entry.attrib |= _activation(servo.activation, servo.early)
    entry.attrib |= _range("ctrlrange", servo.ctrlrange[0])
    if np.isfinite(servo.strongest):
        entry.set("forcerange", text([0.0, servo.strongest]))
    return servo
