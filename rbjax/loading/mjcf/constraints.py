"""MuJoCo equalities as constraints, and constraints as equalities of a file.

    connect                   Spherical
    weld                      Weld; Spherical if torquescale is zero
    joint                     JointPolynomial
    tendon                    TendonPolynomial
These constraints are rigid. MuJoCo's equalities are soft, with `solref` and `solimp`. With
`compliant` the constraints are soft too and give MuJoCo's accelerations (`Soft`; `QuaternionWeld`
for a weld). torquescale then weights rotation against translation.
"""

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
    TendonPolynomial,
    Weld,
)
from rbjax.errors import ModelError
from rbjax.loading.mjcf.fields import Off, is_on, leaf, safe_solref
from rbjax.loading.write.draft import Draft, place_in_body, text
from rbjax.model import WORLD, Model
from rbjax.model.solver_parameters import SOLIMP, SOLREF

_KIND = mujoco.mjtEq
_COUPLINGS = {int(_KIND.mjEQ_JOINT): JointPolynomial, int(_KIND.mjEQ_TENDON): TendonPolynomial}
_LOADED = {int(_KIND.mjEQ_CONNECT), int(_KIND.mjEQ_WELD), *_COUPLINGS}
_TAGS: dict[type, str] = {Spherical: "connect", Weld: "weld"}
_TERMS = 5  # number of coefficients of MuJoCo's polynomials


def constraints_of(m: mujoco.MjModel, *, compliant: bool = False) -> tuple[Constraint, ...]:
    """Read the active equalities of supported types, in the file's order."""
    found = []
    for i in (i for i in loaded_equalities(m) if _ends_move(m, i)):
        _refuse_nan(m, i)
        found.append(_soft(m, i) if compliant else _constraint(m, i))
    return tuple(found)


def loaded_equalities(m: mujoco.MjModel) -> list[int]:
    """Return the indices of the active equalities of supported types."""
    active = np.flatnonzero(m.eq_active0).tolist() if equalities_are_on(m) else []
    return [i for i in active if is_loaded(m, i)]


def equalities_are_on(m: mujoco.MjModel) -> bool:
    """Check that the file does not disable all equalities."""
    return is_on(m, Off.mjDSBL_CONSTRAINT, Off.mjDSBL_EQUALITY)


def is_loaded(m: mujoco.MjModel, i: int) -> bool:
    """Check whether equality i is of a supported type."""
    return int(m.eq_type[i]) in _LOADED


def _refuse_nan(m: mujoco.MjModel, i: int) -> None:
    numbers = m.eq_data[i]
    bad = numbers[~np.isfinite(numbers)]
    if bad.size:
        name = mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_EQUALITY, i) or i
        raise ModelError(
            f"equality {name!r} has the value {bad[0]}, which is not finite; correct that value "
            "in the file"
        )


def _constraint(m: mujoco.MjModel, i: int) -> Constraint:
    kind, data = int(m.eq_type[i]), m.eq_data[i]
    first, second = int(m.eq_obj1id[i]), int(m.eq_obj2id[i])
    if kind in _COUPLINGS:
        return _COUPLINGS[kind](first, None if second < 0 else second, leaf(data[:_TERMS]))
    is_weld = kind == int(_KIND.mjEQ_WELD)
    if _has_sites(m, i):
        a, b = (Place.on(site=s) for s in (first, second))
    elif is_weld:  # the anchor is in the second body; 3:10 is the second body's pose in the first
        a = _on_body(first, data[3:6], data[6:10] / np.linalg.norm(data[6:10]))
        b = _on_body(second, data[:3])
    else:
        a, b = _on_body(first, data[:3]), _on_body(second, data[3:6])
    return (Weld if is_weld and data[10] != 0 else Spherical)(a, b)


def _soft(m: mujoco.MjModel, i: int) -> Soft:
    """Read an equality with its softness. The time constant is at least two time steps, unless the
    file disables this limit."""
    one = _constraint(m, i)
    if isinstance(one, Weld):
        one = QuaternionWeld(one.a, one.b, leaf(m.eq_data[i, 10]))
    solref, solimp = map(leaf, (safe_solref(m, m.eq_solref[i]), m.eq_solimp[i]))
    return Soft(one, solref, solimp, bias=type(one) not in _COUPLINGS.values())


def soft_mimic(m: mujoco.MjModel, one: JointPolynomial) -> Soft:
    """Make a mimic soft, with the default parameters of MuJoCo's equalities."""
    return Soft(one, leaf(safe_solref(m, np.array(SOLREF))), leaf(SOLIMP), bias=False)


def _on_body(body: int, point: np.ndarray, quat: Any = (1.0, 0.0, 0.0, 0.0)) -> Place:
    return Place(leaf(point), leaf(quat), body - 1 if body else None)


def _has_sites(m: mujoco.MjModel, i: int) -> bool:
    return int(m.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_SITE)


def _end_bodies(m: mujoco.MjModel, i: int) -> np.ndarray:
    ends = np.array([m.eq_obj1id[i], m.eq_obj2id[i]])
    return m.site_bodyid[ends] if _has_sites(m, i) else ends


def _ends_move(m: mujoco.MjModel, i: int) -> bool:
    """Check whether a joint lies between the two bodies; if not, MuJoCo has no constraint rows."""
    if int(m.eq_type[i]) in _COUPLINGS:
        return True
    first, second = m.body_weldid[_end_bodies(m, i)]
    return bool(first != second)


def write_constraints(draft: Draft) -> list[Constraint]:
    """Write the constraints; return them as `load` will read them, in that order."""
    written: list[Constraint] = []
    for given in draft.model.constraints:
        one = _rigid(given)
        kind, coupling = type(one), _polynomial(draft.model, one)
        if isinstance(one, Pair) and kind in _TAGS and _places_move(draft.model, one):
            ends = {"site1": draft.site(one.a), "site2": draft.site(one.b)}
            element = ET.SubElement(draft.equality, _TAGS[kind], ends)
            written.append(one)
        elif coupling is not None:
            joints = {"joint1": coupling.joint, "joint2": coupling.driver}
            given_ends = ((k, draft.model.joint(x)) for k, x in joints.items() if x is not None)
            element = ET.SubElement(draft.equality, "joint", polycoef=text(coupling.coefficients))
            element.attrib |= {k: draft.joint(j) for k, j in given_ends}
            written.append(coupling)
        elif type(one) is TendonPolynomial and not one.coefficients[_TERMS:].any():
            names = {"tendon1": one.tendon, "tendon2": one.driver}
            element = ET.SubElement(draft.equality, "tendon", polycoef=text(one.coefficients))
            pairs = ((k, draft.model.tendon(x)) for k, x in names.items() if x is not None)
            element.attrib |= {k: draft.tendons[i] for k, i in pairs}
            padded: Any = np.concatenate([one.coefficients, np.zeros(_TERMS)])[:_TERMS]
            written.append(TendonPolynomial(one.tendon, one.driver, padded))
        else:
            draft.note(f"no MJCF form, left out: constraint {kind.__name__}")
            continue
        _write_softness(element, given)
    return written


def _rigid(one: Constraint) -> Constraint:
    """Return a constraint without its softness."""
    one = one.of if isinstance(one, Soft) else one
    return Weld(one.a, one.b) if isinstance(one, QuaternionWeld) else one


def _write_softness(element: ET.Element, given: Constraint) -> None:
    """Write solref and solimp; MuJoCo computes the weights."""
    if isinstance(given, Soft):
        element.set("solref", text(given.solref))
        element.set("solimp", text(given.solimp))
        if isinstance(given.of, QuaternionWeld):
            element.set("torquescale", text(np.atleast_1d(given.of.scale)))


def _places_move(model: Model, pair: Pair) -> bool:
    """Check whether a joint lies between the two ends; if not, MuJoCo has no constraint rows."""
    carriers = (WORLD, *model.topology.carriers)
    a, b = (place_in_body(model, place)[0] for place in (pair.a, pair.b))
    return carriers[a + 1] != carriers[b + 1]


def _polynomial(model: Model, one: Constraint) -> JointPolynomial | None:
    """Convert a coupling of two joints to a polynomial of MJCF; None if that is impossible."""
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
