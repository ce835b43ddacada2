"""Tendons of a compiled MuJoCo model, and tendons as elements of a file."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from rbjax.loading.mjcf.fields import Off, Trn, Wrap, is_on, names_of
from rbjax.loading.write.draft import Draft, text, unique
from rbjax.model.tendons import Tendons, Waypoint

_KINDS = {Wrap.JOINT: "joint", Wrap.SITE: "site", Wrap.PULLEY: "pulley"}
_TERMS = 3  # number of coefficients of MuJoCo's polynomials
#: field -> attribute of the file, and its value if the file does not set it
_SOFTNESS = {
    "limit_solref": ("solreflimit", [0.02, 1.0]),
    "limit_solimp": ("solimplimit", [0.9, 0.95, 0.001, 0.5, 2.0]),
    "friction_solref": ("solreffriction", [0.02, 1.0]),
    "friction_solimp": ("solimpfriction", [0.9, 0.95, 0.001, 0.5, 2.0]),
}


def tendons_of(m: mujoco.MjModel, array: Callable) -> Tendons | None:
    """Read the tendons, in the file's order; None if there are none.

    array: function that makes a leaf of a model.
    """
    if not m.ntendon:
        return None
    rows = np.isin(m.wrap_type, (Wrap.JOINT, Wrap.PULLEY))
    limited, rubbing = limited_tendons(m), rubbing_tendons(m)
    damping = _polynomial(m.tendon_damping, m.tendon_dampingpoly) + _at_tendons(
        m, _polynomial(m.actuator_damping, m.actuator_dampingpoly)
    )
    stiffness = _polynomial(m.tendon_stiffness, m.tendon_stiffnesspoly)

    def limits(on: Any, given: np.ndarray) -> Any:
        return array(np.where(np.asarray(on, bool)[:, None], given, [-np.inf, np.inf]))

    return Tendons(
        coefficients=array(m.wrap_prm[rows]),
        stiffness=array(_without_zeros(stiffness * is_on(m, Off.mjDSBL_SPRING))),
        damping=array(_without_zeros(damping * is_on(m, Off.mjDSBL_DAMPER))),
        springlength=array(m.tendon_lengthspring),
        range=limits(limited, m.tendon_range),
        forcerange=limits(m.tendon_actfrclimited, m.tendon_actfrcrange),
        frictionloss=array(m.tendon_frictionloss),
        armature=array(tendon_armature(m)),
        limit_margin=array(m.tendon_margin),
        limit_solref=array(m.tendon_solref_lim),
        limit_solimp=array(m.tendon_solimp_lim),
        friction_solref=array(m.tendon_solref_fri),
        friction_solimp=array(m.tendon_solimp_fri),
        length0=array(m.tendon_length0),
        names=names_of(m, mujoco.mjtObj.mjOBJ_TENDON, m.ntendon),
        paths=tuple(_path(m, i) for i in range(m.ntendon)),
        limited=tuple(np.flatnonzero(limited).tolist()),
        rubbing=tuple(np.flatnonzero(rubbing).tolist()),
        inertial=tuple(np.flatnonzero(tendon_armature(m)).tolist()),
    )


def limited_tendons(m: mujoco.MjModel) -> np.ndarray:
    """Return the mask (nt,) of tendons with limits that the file does not disable."""
    on = is_on(m, Off.mjDSBL_CONSTRAINT, Off.mjDSBL_LIMIT)
    return m.tendon_limited.astype(bool) & on


def rubbing_tendons(m: mujoco.MjModel) -> np.ndarray:
    """Return the mask (nt,) of tendons with friction loss that the file does not disable."""
    on = is_on(m, Off.mjDSBL_CONSTRAINT, Off.mjDSBL_FRICTIONLOSS)
    return (m.tendon_frictionloss > 0) & on


def tendon_armature(m: mujoco.MjModel) -> np.ndarray:
    """Compute the armature (nt,) of the tendons and of the actuators at them."""
    return m.tendon_armature + _at_tendons(m, m.actuator_armature[:, None])[:, 0]


def _path(m: mujoco.MjModel, tendon: int) -> tuple[Waypoint, ...]:
    at = int(m.tendon_adr[tendon])
    rows = slice(at, at + int(m.tendon_num[tendon]))
    found = []
    for kind, thing, given in zip(
        m.wrap_type[rows].tolist(), m.wrap_objid[rows].tolist(), m.wrap_prm[rows], strict=True
    ):
        if kind in _KINDS:
            found.append(Waypoint(_KINDS[kind], -1 if kind == Wrap.PULLEY else thing))
        else:
            found.append(Waypoint("geom", thing, round(given)))
    return tuple(found)


def _polynomial(linear: np.ndarray, higher: np.ndarray) -> np.ndarray:
    return np.concatenate([linear[:, None], higher], -1)


def _without_zeros(x: np.ndarray) -> np.ndarray:
    """Return the columns up to the last one that has a number other than zero, at least one."""
    return x[:, : 1 + max(np.flatnonzero(x.any(0)), default=0)]


def _at_tendons(m: mujoco.MjModel, given: np.ndarray) -> np.ndarray:
    """Sum properties (nu, n) of the actuators at each tendon (nt, n), times the gear squared."""
    out = np.zeros((m.ntendon, given.shape[1]))
    for i in np.flatnonzero(m.actuator_trntype == Trn.TENDON):
        out[m.actuator_trnid[i, 0]] += given[i] * m.actuator_gear[m.actuator_outadr[i], 0] ** 2
    return out


def write_tendons(draft: Draft) -> None:
    """Write the tendons. Sites and geoms are written already."""
    own: Any = draft.model.tendons
    if own is None:
        return
    draft.tendons += unique(own.names)
    first = 0
    for i, (name, path) in enumerate(zip(draft.tendons, own.paths, strict=True)):
        fixed = bool(path) and path[0].kind == "joint"
        tendon = ET.SubElement(draft.tendon, "fixed" if fixed else "spatial", name=name)
        tendon.attrib |= _attributes(draft, own, i)
        for one in path:
            first += _write_waypoint(draft, tendon, one, own.coefficients[first:])


def _attributes(draft: Draft, own: Any, i: int) -> dict[str, str]:
    """Return the attributes of a tendon other than its name."""
    out = {"springlength": text(own.springlength[i])}
    for key in ("stiffness", "damping"):
        given = getattr(own, key)[i]
        if given[_TERMS:].any():
            draft.note(f"{key} of more than {_TERMS} terms, left out", [draft.tendons[i]])
        elif given.any():
            out[key] = text(given)
    for key, attribute in (("range", "range"), ("forcerange", "actuatorfrcrange")):
        given = getattr(own, key)[i]
        if np.isfinite(given).any() and (key == "forcerange" or i in own.limited):
            out[attribute] = text(given)
    for key in ("frictionloss", "armature", "limit_margin"):
        if getattr(own, key)[i]:
            out[key.removeprefix("limit_")] = text(getattr(own, key)[i])
    for key, (attribute, usual) in _SOFTNESS.items():
        given = getattr(own, key)[i]
        if not np.array_equal(given, np.asarray(usual, given.dtype)):
            out[attribute] = text(given)
    return out


def _write_waypoint(draft: Draft, tendon: ET.Element, one: Waypoint, left: Any) -> int:
    """Write one element of the path of a tendon. Return the number of coefficients that it has.

    left: the coefficients of the path from this element on.
    """
    if one.kind == "pulley":
        ET.SubElement(tendon, "pulley", divisor=text(left[0]))
        return 1
    if one.kind == "joint":
        ET.SubElement(tendon, "joint", joint=draft.joint(one.index), coef=text(left[0]))
        return 1
    if one.kind == "site":
        ET.SubElement(tendon, "site", site=draft.sites[one.index])
        return 0
    side = {"sidesite": draft.sites[one.side]} if one.side >= 0 else {}
    ET.SubElement(tendon, "geom", {"geom": draft.geoms[one.index].get("name", "")} | side)
    return 0
