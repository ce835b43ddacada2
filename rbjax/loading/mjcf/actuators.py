"""Actuators of a compiled MuJoCo model as force elements, and as <general> elements of a file."""

from __future__ import annotations

import dataclasses
import re
import xml.etree.ElementTree as ET
from typing import Any

import jax
import mujoco
import numpy as np

from rbjax.forces import Element
from rbjax.forces.actuators.actuator import Actuator, Affine, GainBias, from_columns, is_affine
from rbjax.forces.actuators.orientation_servo import OrientationServo
from rbjax.forces.actuators.transmissions import (
    JointAxis,
    SitePose,
    SiteWrench,
    SliderCrank,
    TendonLength,
    Transmission,
)
from rbjax.loading.checks import check_finite
from rbjax.loading.mjcf import actuator_laws as laws
from rbjax.loading.mjcf.fields import Gain, Off, Trn, is_off, is_on, leaf, reason_left_out
from rbjax.loading.write.draft import Draft, text

_GROUP_OFF = 30  # group of controls without an actuator, disabled in the written file
_RANGES = {"pos": "ctrlrange", "vel": "velrange", "ff": "ffrange"}


def actuator_elements(m: mujoco.MjModel) -> tuple[Element, ...]:
    """Read the enabled and supported actuators, in the file's order."""
    found = tuple(_element(m, i) for i in _modelled(m))
    for element in found:
        check_finite(element)
    return found


def key_states(m: mujoco.MjModel) -> np.ndarray:
    """Read the actuator states (nk, n) of the file's keyframes."""
    index = [
        int(m.actuator_actadr[i]) + k for i in _modelled(m) for k in range(m.actuator_actnum[i])
    ]
    return m.key_act[:, index]


def _modelled(m: mujoco.MjModel) -> list[int]:
    return [i for i in range(m.nactuator) if not (is_off(m, i) or reason_left_out(m, i))]


def _element(m: mujoco.MjModel, i: int) -> Element:
    first, count = int(m.actuator_ctrladr[i]), int(m.actuator_ctrlnum[i])
    controls, rows = tuple(range(first, first + count)), slice(first, first + count)
    limited = m.actuator_ctrllimited[rows].astype(bool)[:, None] & is_on(m, Off.mjDSBL_CLAMPCTRL)
    ctrlrange = leaf(np.where(limited, m.actuator_ctrlrange[rows], [-np.inf, np.inf]))
    if m.actuator_gaintype[i] == Gain.SO3:
        return _orientation_servo(m, i, controls, ctrlrange)
    own = m.actuator_forcerange[i] if m.actuator_forcelimited[i] else [-np.inf, np.inf]
    return Actuator(_transmission(m, i), laws.read_law(m, i), ctrlrange, leaf(own), controls)


def _transmission(m: mujoco.MjModel, i: int) -> Transmission:
    kind, (target, other) = m.actuator_trntype[i], map(int, m.actuator_trnid[i])
    gear = leaf(m.actuator_gear[m.actuator_outadr[i]])
    if kind in (Trn.JOINT, Trn.JOINTINPARENT):
        return JointAxis(gear, target, bool(kind == Trn.JOINTINPARENT))
    if kind == Trn.SITE:
        return SiteWrench(gear, target) if other < 0 else SitePose(gear, target, other)
    if kind == Trn.SLIDERCRANK:
        return SliderCrank(gear, leaf(m.actuator_cranklength[i]), target, other)
    return TendonLength(gear, target)


def _orientation_servo(
    m: mujoco.MjModel, i: int, controls: tuple[int, ...], ctrlrange: jax.Array
) -> OrientationServo:
    target, base = map(int, m.actuator_trnid[i])
    strongest = m.actuator_forcerange[i, 1] if m.actuator_forcelimited[i] else np.inf
    given = laws.parameters(m, i, laws.SERVO)
    where = {"joint": target} if base < 0 else {"site": target, "reference": base}
    return OrientationServo(
        leaf([given.kp, given.constant, given.kv]),
        ctrlrange,
        leaf(strongest),
        laws.read_activation(m, i),
        controls,
        early=bool(m.actuator_actearly[i]),
        **where,
    )


def write_actuators(draft: Draft) -> list[Element]:
    """Write the actuators in the order of their controls; return the elements as `load` will read
    them."""
    model, elements = draft.model, []
    at: dict[float, Element | None] = dict.fromkeys(range(model.nu))
    at |= {one.controls[0]: _shortest(one) for one in from_columns(model)}
    last = -0.5
    for element in model.forces:
        if type(element) in (Actuator, OrientationServo):
            # an actuator without controls follows the one before it
            last = element.controls[0] if element.controls else np.nextafter(last, np.inf)
            for control in element.controls:
                at.pop(control, None)
            at[last] = element
    for row, element in sorted(at.items(), key=lambda item: item[0]):
        if element is None:
            _write_unused(draft, model.actuator_names[int(row)])
        else:
            elements.append(_write_element(draft, element))
    return [x for x in elements if not is_affine(x)]


def _shortest(row: Actuator) -> Actuator:
    """Simplify a row of `model.actuators` for MJCF.

    A zero bias is omitted, and the gain is then constant. With a bias the gain stays affine,
    because MuJoCo treats a constant gain with a bias as a servo on an angle.
    """
    law: Any = row.law
    bias = law.bias if law.bias.coefficients.any() else None
    constant = bias is None and not law.gain.coefficients[1:].any()
    gain = Affine(law.gain.coefficients[:1]) if constant else law.gain
    return dataclasses.replace(row, law=GainBias(gain, bias, None))


def _write_unused(draft: Draft, name: str) -> None:
    """Write a disabled actuator for an unused control, so that the indices of controls are kept."""
    if not draft.joints:
        draft.note("unused controls, left out because the model has no joint", [name])
        return
    draft.option.set("actuatorgroupdisable", str(_GROUP_OFF))
    ET.SubElement(
        draft.actuator, "general", name=name, joint=draft.joint(0), gear="0", group=str(_GROUP_OFF)
    )


def _name(draft: Draft, controls: tuple[int, ...]) -> dict[str, str]:
    """Return the name attribute: of several controls, their common name without the index."""
    names = [draft.model.actuator_names[c] for c in controls]
    if not names:
        return {}
    return {"name": names[0] if len(names) == 1 else re.sub(r"\[0\]$", "", names[0])}


def _write_element(draft: Draft, element: Any) -> Element:
    entry = ET.SubElement(draft.actuator, "general", _name(draft, element.controls))
    if isinstance(element, OrientationServo):
        return _write_servo(draft, entry, element)
    written = laws.write_law(element.law)
    if written is None:
        draft.actuator.remove(entry)
        kind, name = type(element.law).__name__, entry.get("name", "without a name")
        draft.note(f"no MJCF form, left out: actuators with the law {kind}", [name])
        for control in element.controls:
            _write_unused(draft, draft.model.actuator_names[control])
        return element
    found, inputs, law = written
    entry.attrib |= _write_transmission(draft, element.transmission)
    entry.attrib |= laws.limits_text("forcerange", element.forcerange) | found
    for which, limits in zip(inputs, element.ctrlrange, strict=True):
        entry.attrib |= laws.limits_text(_RANGES.get(which, "ctrlrange"), limits)
    return dataclasses.replace(element, law=law)


def _write_transmission(draft: Draft, x: Transmission) -> dict[str, str]:
    if isinstance(x, JointAxis):
        ends = {"jointinparent" if x.in_parent else "joint": draft.joint(x.joint)}
    elif isinstance(x, SiteWrench):
        ends = {"site": draft.sites[x.site]}
    elif isinstance(x, SitePose):
        ends = {"site": draft.sites[x.site], "refsite": draft.sites[x.reference]}
    elif isinstance(x, SliderCrank):
        ends = {"cranksite": draft.sites[x.crank], "slidersite": draft.sites[x.slider]}
        ends["cranklength"] = text(x.rod)
    elif isinstance(x, TendonLength):
        ends = {"tendon": draft.tendons[x.tendon]}
    else:
        raise TypeError(f"no MJCF form of the transmission {type(x).__name__}")
    return ends | {"gear": laws.shortened(x.gear)}


def _write_servo(draft: Draft, entry: ET.Element, servo: OrientationServo) -> OrientationServo:
    kp, constant, kv = servo.gains
    if servo.joint >= 0:
        entry.set("joint", draft.joint(servo.joint))
    else:
        entry.set("site", draft.sites[servo.site])
        entry.set("refsite", draft.sites[servo.reference])
    entry.attrib |= {"gaintype": "so3", "biastype": "so3"}
    entry.attrib |= laws.attributes(laws.SERVO, kp=kp, constant=constant, kv=kv)
    entry.attrib |= {"input": "quat"} if len(servo.controls) == 4 else {}
    entry.attrib |= laws.write_activation(servo.activation, servo.early)
    entry.attrib |= laws.limits_text("ctrlrange", servo.ctrlrange[0])
    if np.isfinite(servo.strongest):
        entry.set("forcerange", text([0.0, servo.strongest]))
    return servo
