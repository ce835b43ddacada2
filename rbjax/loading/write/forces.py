"""Force elements other than actuators as MJCF, the inverse of `rbjax.loading.mjcf.forces`."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET
from typing import Any

import numpy as np

from rbjax.forces import (
    Cable,
    Element,
    EllipsoidFluid,
    GravityCompensation,
    InertiaBoxFluid,
    JointFriction,
    JointLimits,
    JointPolynomials,
    PointSpring,
)
from rbjax.forces.actuators.actuator import Actuator
from rbjax.forces.actuators.orientation_servo import OrientationServo
from rbjax.loading.mjcf.cables import write_cables
from rbjax.loading.write.draft import Draft, text, unique
from rbjax.model import Model

Array = np.ndarray
_TERMS = 2  # number of MJCF's polynomial coefficients beyond the linear one


def write_forces(draft: Draft) -> list[Element]:
    """Write the elements; return them as `load` will read them, in that order."""
    kinds = (JointPolynomials, JointLimits, JointFriction, GravityCompensation, PointSpring,
             InertiaBoxFluid, EllipsoidFluid, Cable)  # fmt: skip
    # only the class itself is written, as a subclass may have other forces
    sorted_out: dict[type, list] = {kind: [] for kind in kinds}
    for element in draft.model.forces:
        if type(element) in sorted_out:
            sorted_out[type(element)].append(element)
        elif type(element) not in (Actuator, OrientationServo):
            _leave_out(draft, element)
    polynomials, limits, friction, lifted, springs, boxes, ellipsoids, cables = sorted_out.values()
    written = _write_polynomials(draft, polynomials)
    _write_limits(draft, limits)
    _write_friction(draft, friction)
    written += _write_lifted(draft, lifted)
    for spring in springs:
        _write_spring(draft, spring)
    written += _write_fluids(draft, boxes, ellipsoids)
    joint = draft.model.joint
    cables = [dataclasses.replace(x, joints=tuple(map(joint, x.joints))) for x in cables]
    write_cables(draft.root, cables, draft.joint)
    return written + cables


def box_axes(model: Model) -> dict[int, Array]:
    """Compute the attitude of each body's inertia box, as `load` reads it from the file."""
    boxes = [x for x in model.forces if type(x) is InertiaBoxFluid]
    return {b: q for x in boxes for b, q in zip(x.bodies, x.orientation, strict=True)}


def _leave_out(draft: Draft, element: Element) -> None:
    draft.note(f"no MJCF form, left out: force element {type(element).__name__}")


def _dofs(model: Model, joint: int) -> range:
    start = model.topology.joint_v[joint]
    return range(start, start + model.topology.joints[joint].nv)


def _write_polynomials(draft: Draft, elements: list[JointPolynomials]) -> list[Element]:
    """Write polynomial springs and dampers after the linear terms of stiffness and damping."""
    model, top = draft.model, draft.model.topology
    stiffness, damping = np.zeros((len(top.joint_kinds), _TERMS)), np.zeros((model.nv, _TERMS))
    for element in elements:
        joints = list(map(model.joint, element.joints))
        dofs = [i for j in joints for i in _dofs(model, j)]
        starts = np.cumsum([0, *(len(_dofs(model, j)) for j in joints)])[:-1]
        even = element.damping[np.repeat(starts, np.diff([*starts, len(dofs)]))] == element.damping
        if element.stiffness[:, _TERMS:].any() or element.damping[:, _TERMS:].any():
            draft.note(f"JointPolynomials of more than {_TERMS + 1} terms, left out", _names(
                draft, joints))  # fmt: skip
        elif not even.all():
            draft.note("JointPolynomials with one damper an axis, left out", _names(draft, joints))
        else:
            np.add.at(stiffness[:, : element.stiffness.shape[1]], joints, element.stiffness)
            np.add.at(damping[:, : element.damping.shape[1]], dofs, element.damping)
    some = [j for j in range(len(top.joint_kinds))
            if stiffness[j].any() or damping[_dofs(model, j)].any()]  # fmt: skip
    for j in some:
        first = _dofs(model, j)[0]
        own = model.joints
        draft.joints[j].set("stiffness", text([own.stiffness[j], *stiffness[j]]))
        draft.joints[j].set("damping", text([own.damping[first], *damping[first]]))
    if not some:
        return []
    dofs = [i for j in some for i in _dofs(model, j)]
    return [JointPolynomials(stiffness[some], damping[dofs], tuple(some))]  # type: ignore[arg-type]


def _names(draft: Draft, joints: list[int]) -> list[str]:
    return [draft.joint(j) for j in joints]


def _write_limits(draft: Draft, elements: list[JointLimits]) -> None:
    joints = [j for x in elements for j in map(draft.model.joint, x.joints)]
    if joints:
        draft.note(
            "compliant stops, as joint ranges with MuJoCo's softness (load with limits=True)",
            _names(draft, joints),
        )


def _write_friction(draft: Draft, elements: list[JointFriction]) -> None:
    for element in elements:
        joints, at = list(map(draft.model.joint, element.joints)), 0
        for j in joints:
            n = len(_dofs(draft.model, j))
            loss = element.coulomb[at : at + n]
            at += n
            draft.joints[j].set("frictionloss", text(loss[0]))
        draft.note(
            "friction as MuJoCo's friction loss, without break-away and viscous parts (load with "
            "friction=True)",
            _names(draft, joints),
        )


def _write_lifted(draft: Draft, elements: list[GravityCompensation]) -> list[Element]:
    """Write gravity compensation on all joints, or split into passive and actuated joints."""
    model = draft.model
    everywhere = [x for x in elements if x.joints is None and not x.actuated]
    others = [x for x in elements if not (x.joints is None and not x.actuated)]
    driven = _driven_joints(model, others) if others and not everywhere else None
    if others and driven is None:
        for element in others:
            _leave_out(draft, element)
        others = []
    for j in driven or ():
        draft.joints[j].set("actuatorgravcomp", "true")
    fraction = np.zeros(model.nb)
    for element in everywhere or others[:1]:
        np.add.at(fraction, list(map(model.body, element.bodies)), element.fraction)
    some = np.flatnonzero(fraction)
    for b in some:
        draft.bodies[b].set("gravcomp", text(fraction[b]))
    if not len(some):
        return []
    lifted = GravityCompensation(fraction[some], tuple(some.tolist()))  # type: ignore[arg-type]
    if not others:
        return [lifted]
    passive = [j for j in range(len(model.joint_names)) if j not in (driven or ())]
    found: list[Element] = []
    if passive:
        found.append(dataclasses.replace(lifted, joints=tuple(passive)))
    return [*found, dataclasses.replace(lifted, joints=tuple(driven or ()), actuated=True)]


def _driven_joints(model: Model, elements: list[GravityCompensation]) -> list[int] | None:
    """Return the joints whose compensation the actuators apply. Return None unless the actuated and
    the passive joints are all joints, with equal bodies and fractions, as MJCF requires."""
    everything = range(len(model.joint_names))
    shares = {x.actuated: list(map(model.joint, x.joints or everything)) for x in elements}
    joints = [j for share in shares.values() for j in share]
    lifted = [(list(map(model.body, x.bodies)), x.fraction.tolist()) for x in elements]
    same = all(x == lifted[0] for x in lifted)
    whole = len(shares) == len(elements) and sorted(joints) == list(everything)
    return sorted(shares[True]) if same and whole and True in shares and model.nu else None


def _write_spring(draft: Draft, spring: PointSpring) -> None:
    """Write a spring as a spatial tendon between two sites."""
    ends = [draft.site(place) for place in (spring.a, spring.b)]
    k, d = (_padded(draft, x) for x in (spring.stiffness, spring.damping))
    tendon = ET.SubElement(
        draft.tendon, "spatial", name=unique(["spring"], draft.tendons)[0], stiffness=text(k),
        damping=text(d), springlength=text(spring.slack),
    )  # fmt: skip
    draft.tendons.append(tendon.get("name", ""))
    for name in ends:
        ET.SubElement(tendon, "site", site=name)
    draft.springs.append(dataclasses.replace(spring, stiffness=k, damping=d))


def _padded(draft: Draft, x: Any) -> Any:
    """Convert the coefficients of a polynomial to the number that MJCF has, with zeros for missing
    ones."""
    if x[1 + _TERMS :].any():
        draft.note(f"PointSpring of more than {_TERMS + 1} terms, the first of which are written")
    return np.concatenate([x, np.zeros(1 + _TERMS)])[: 1 + _TERMS]


def _write_fluids(draft: Draft, boxes: list, ellipsoids: list) -> list[Element]:
    """Write the fluid as options, and each ellipsoid as a geom without mass."""
    written: list[Element] = [*boxes[:1], *ellipsoids[:1]]
    for element in (*boxes[1:], *ellipsoids[1:]):
        draft.note(f"a second {type(element).__name__}, left out, for MJCF has one medium")
    for element in written[:1]:
        for key in ("density", "viscosity", "wind"):
            draft.option.set(key, text(getattr(element, key)))
    for element in ellipsoids[:1]:
        columns = (element.blunt_drag, element.slender_drag, element.angular_drag,
                   element.kutta_lift, element.magnus_lift)  # fmt: skip
        for n, b in enumerate(element.bodies):
            fluid = {"fluidshape": "ellipsoid", "fluidcoef": text([x[n] for x in columns])}
            own = _geom_of(draft, element, n)
            if own is not None:
                own.attrib.update(fluid)
                continue
            draft.add(
                b, "geom", type="ellipsoid", size=text(element.semi_axes[n]),
                pos=text(element.position[n]), quat=text(element.orientation[n]), mass="0",
                contype="0", conaffinity="0", **fluid,
            )  # fmt: skip
    return written


def _geom_of(draft: Draft, element: EllipsoidFluid, n: int) -> ET.Element | None:
    """Return the geom that is the n-th ellipsoid of a fluid, if it is written."""
    geoms: Any = draft.model.geoms
    for i, own in draft.geoms.items():
        a, b, c = geoms.size[i]
        axes = {"sphere": (a, a, a), "capsule": (a, a, a + b), "cylinder": (a, a, b)}
        same = (
            (geoms.position[i], element.position[n]),
            (geoms.orientation[i], element.orientation[n]),
            (axes.get(geoms.types[i], (a, b, c)), element.semi_axes[n]),
        )
        if geoms.bodies[i] == element.bodies[n] and all(np.array_equal(x, y) for x, y in same):
            return own
    return None
