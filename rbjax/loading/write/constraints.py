"""Constraints as MJCF's equalities: what `constraints` reads, the other way round."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any

import mujoco
import numpy as np

from rbjax.constraints import (
    Constraint,
    Gear,
    JointPolynomial,
    Pair,
    Place,
    QuaternionWeld,
    Rack,
    Soft,
    Spherical,
    Weld,
)
from rbjax.loading.write.draft import Draft, text, unique
from rbjax.model import WORLD, Model

_TAGS: dict[type, str] = {Spherical: "connect", Weld: "weld"}
_TERMS = 5  # of MJCF's polynomials
_STILL = np.array([1.0, 0.0, 0.0, 0.0])


def write_constraints(draft: Draft) -> list[Constraint]:
    """Write the constraints; return them as they will be read, in that order."""
    written: list[Constraint] = []
    for given in draft.model.constraints:
        one = _rigid(given)
        kind, coupling = type(one), _polynomial(draft.model, one)
        if isinstance(one, Pair) and kind in _TAGS and _moves(draft.model, one):
            ends = {"site1": _site(draft, one.a), "site2": _site(draft, one.b)}
            element = ET.SubElement(draft.equality, _TAGS[kind], ends)
            written.append(one)
        elif coupling is not None:
            element = _write_polynomial(draft, coupling)
            written.append(coupling)
        else:
            draft.note(f"no MJCF form, left out: constraint {kind.__name__}")
            continue
        _write_softness(element, given)
    return written


def _rigid(one: Constraint) -> Constraint:
    """A constraint as it is read without its softness."""
    one = one.of if isinstance(one, Soft) else one
    return Weld(one.a, one.b) if isinstance(one, QuaternionWeld) else one


def _write_softness(element: ET.Element, given: Constraint) -> None:
    """solref and solimp; the weights are those that MuJoCo finds."""
    if isinstance(given, Soft):
        element.set("solref", text(given.solref))
        element.set("solimp", text(given.solimp))
        if isinstance(given.of, QuaternionWeld):
            element.set("torquescale", text(np.atleast_1d(given.of.scale)))


def in_body(model: Model, place: Place) -> tuple[int, np.ndarray, np.ndarray]:
    """The body of a place, and its position and quaternion there."""
    p, quat = (np.asarray(x, np.float64) for x in (place.position, place.orientation))
    if place.site is None:
        return (WORLD if place.body in (None, WORLD) else model.body(place.body)), p, quat
    site = model.site(place.site)
    at, turn = (
        np.asarray(x[site], np.float64) for x in (model.sites.position, model.sites.orientation)
    )
    point, product = np.empty(3), np.empty(4)
    mujoco.mju_rotVecQuat(point, p, turn / np.linalg.norm(turn))
    mujoco.mju_mulQuat(product, turn, quat)
    return model.topology.site_bodies[site], at + point, product


def _moves(model: Model, pair: Pair) -> bool:
    """Whether a joint lies between the two ends: without one MuJoCo has no rows."""
    carriers = (WORLD, *model.topology.carriers)
    a, b = (in_body(model, place)[0] for place in (pair.a, pair.b))
    return carriers[a + 1] != carriers[b + 1]


def _polynomial(model: Model, one: Constraint) -> JointPolynomial | None:
    """A coupling of two joints as a polynomial of as many terms as MJCF has, if it is one."""
    given: Any = one
    if type(one) is JointPolynomial:
        terms = given.coefficients
    elif type(one) in (Gear, Rack):
        terms = np.array([0.0, given.ratio if type(one) is Gear else given.radius])
    else:
        return None
    itself = given.driver is not None and model.joint(given.joint) == model.joint(given.driver)
    padded: Any = np.concatenate([terms, np.zeros(_TERMS)])[:_TERMS]
    fits = not itself and not terms[_TERMS:].any()
    return JointPolynomial(given.joint, given.driver, padded) if fits else None


def _write_polynomial(draft: Draft, coupling: JointPolynomial) -> ET.Element:
    ends = {"joint1": coupling.joint, "joint2": coupling.driver}
    names = {key: draft.joint(draft.model.joint(x)) for key, x in ends.items() if x is not None}
    polycoef = text(coupling.coefficients)
    return ET.SubElement(draft.equality, "joint", names, polycoef=polycoef)


def _site(draft: Draft, place: Place) -> str:
    """The name of the site at a place, made if there is none."""
    if place.site is not None and not np.any(place.position) and _is_still(place.orientation):
        return draft.sites[draft.model.site(place.site)]
    body, p, quat = in_body(draft.model, place)
    name = unique(["place"], draft.sites)[0]
    draft.sites.append(name)
    draft.add(body, "site", name=name, pos=text(p), quat=text(quat))
    return name


def _is_still(quat: Any) -> bool:
    return bool((np.asarray(quat) == _STILL).all())
