"""Geoms, contact pairs and parameters of constraints as MJCF, and their differences after reading.

Geoms of meshes and height fields are not written: a model has only the boxes about them.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from rbjax.contact.geometry.narrow_phase import PAIRS
from rbjax.forces import JointFriction
from rbjax.loading.mjcf.contact_pairs import contact_pairs, kinds_of
from rbjax.loading.mjcf.fields import names_of
from rbjax.loading.write.draft import Draft, text, unique
from rbjax.model import WORLD, Model
from rbjax.model.geoms import LEAVES, NUMBERS, PARAMETERS, RGBA
from rbjax.model.solver_parameters import SOLIMP, SOLREF

#: kind of a geom -> the entries of its size in a file
SIZES = {"plane": 3, "sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
#: attribute of a geom -> default
_ATTRIBUTES = {**LEAVES, **NUMBERS, "rgba": RGBA}
PAIR_LEAVES = {
    "friction": (1.0, 1.0, 0.005, 0.0001, 0.0001),
    "solreffriction": (0.0, 0.0),
    **PARAMETERS,
}
#: attribute of a joint -> the leaf of `model.solver` per joint, and its default
JOINT_LEAVES = {
    "solreflimit": ("limit_solref", SOLREF), "solimplimit": ("limit_solimp", SOLIMP),
    "margin": ("limit_margin", 0.0),
}  # fmt: skip
#: the same, per dof
DOF_LEAVES = {
    "frictionloss": ("frictionloss", 0.0), "solreffriction": ("friction_solref", SOLREF),
    "solimpfriction": ("friction_solimp", SOLIMP),
}  # fmt: skip


def write_geoms(draft: Draft) -> None:
    """Write the geoms that have a size of their own, into their bodies."""
    geoms: Any = draft.model.geoms
    if geoms is None:
        return
    for i, (name, kind) in enumerate(zip(unique(geoms.names), geoms.types, strict=True)):
        if kind not in SIZES:
            continue
        given = {key: getattr(geoms, key)[i] for key in _ATTRIBUTES}
        attributes = _unusual(given, _ATTRIBUTES)
        used = np.flatnonzero(geoms.size[i]).max(initial=0) + 1  # a file may give more than needed
        size = text(geoms.size[i, : max(used, SIZES[kind])])
        pose = {"pos": text(geoms.position[i]), "quat": text(geoms.orientation[i])}
        draft.geoms[i] = draft.add(
            geoms.bodies[i], "geom", name=name, type=kind, size=size, **pose, **attributes
        )
    meshes = {i for pair in geoms.pairs for i in pair if i not in draft.geoms}
    if meshes:
        draft.note("geoms of meshes and height fields, left out", [geoms.names[i] for i in meshes])


#: integrator of a file -> integrator of `rb.rollout`
_INTEGRATORS = {"RK4": "rk4"} | {name: name for name in ("implicit", "implicitfast", "discrete")}


def write_solver(draft: Draft) -> None:
    """Write the parameters of limits, friction loss and cones."""
    solver: Any = draft.model.solver
    if solver is None:
        return
    if solver.cone != "pyramidal":
        draft.option.set("cone", solver.cone)
    if solver.impratio != 1:
        draft.option.set("impratio", text(solver.impratio))
    names = {name: option for option, name in _INTEGRATORS.items()}
    if solver.integrator in names:
        draft.option.set("integrator", names[solver.integrator])
    elif solver.integrator == "semi_implicit_euler":
        _flag(draft, "eulerdamp")
    if not solver.refsafe:
        _flag(draft, "refsafe")
    if solver.frictionloss.any() and not solver.rubbing:
        _flag(draft, "frictionloss")
    top, uneven = draft.model.topology, []
    for j, (element, start) in enumerate(zip(draft.joints, top.joint_v, strict=True)):
        dofs = slice(start, start + top.joints[j].nv)
        rows = {key: getattr(solver, name)[dofs] for key, (name, _) in DOF_LEAVES.items()}
        uneven += [draft.joint(j) for x in rows.values() if (x != x[0]).any()][:1]
        given = {key: getattr(solver, name)[j] for key, (name, _) in JOINT_LEAVES.items()}
        given |= {key: x[0] for key, x in rows.items()}
        usual = {key: value for key, (_, value) in (JOINT_LEAVES | DOF_LEAVES).items()}
        element.attrib.update(_unusual(given, usual))
    if uneven:
        draft.note("the friction loss of the first axis, where axes of a joint differ", uneven)


def write_pairs(draft: Draft, compiled: mujoco.MjModel) -> None:
    """Write the explicit pairs, and exclude bodies whose pairs the model does not have.

    compiled: the file without its pairs.
    """
    model: Any = draft.model
    geoms = model.geoms
    if geoms is None:
        return
    known = {i: x.get("name", "") for i, x in draft.geoms.items()}
    found = pairs_by_name(compiled, closed=model.contact is not None)
    explicit = geoms.pairs[: len(geoms.pair_condim)]
    section = ET.Element("contact")
    for k, pair in enumerate(explicit):
        if not set(pair) <= set(known):
            continue
        given = {key: getattr(geoms, f"pair_{key}")[k] for key in PAIR_LEAVES}
        attributes = _unusual(given | {"condim": geoms.pair_condim[k]}, PAIR_LEAVES | {"condim": 3})
        one, other = (known[i] for i in pair)
        ET.SubElement(section, "pair", {"geom1": one, "geom2": other} | attributes)
    wanted = [[known[i] for i in pair] for pair in geoms.pairs if set(pair) <= set(known)]
    kept = {frozenset(pair) for pair in wanted}
    if found and not kept:
        _flag(draft, "contact")
        found = set()
    elif kept - found - {frozenset(known[i] for i in x) for x in explicit if set(x) <= set(known)}:
        _flag(draft, "filterparent")
        copied = mujoco.MjModel.from_xml_string(ET.tostring(draft.root, encoding="unicode"))
        found = pairs_by_name(copied, closed=model.contact is not None)
    bodies = {known[i]: geoms.bodies[i] for i in known}
    held = {frozenset(bodies[name] for name in pair) for pair in kept}
    excluded = [*geoms.excluded, *([bodies[name] for name in pair] for pair in found - kept)]
    for pair in dict.fromkeys(map(frozenset, excluded)):
        if pair not in held:
            names = [_body(draft, b) for b in (*pair, *pair)][:2]
            ET.SubElement(section, "exclude", body1=names[0], body2=names[1])
    if len(section):
        draft.root.append(section)


def pairs_by_name(m: mujoco.MjModel, *, closed: bool) -> set[frozenset[str]]:
    """Return the pairs of a compiled model, or those with a closed form, by the names of geoms."""
    kinds, names = kinds_of(m), names_of(m, mujoco.mjtObj.mjOBJ_GEOM, m.ngeom)
    pairs = (x for x in contact_pairs(m) if not closed or tuple(kinds[i] for i in x) in PAIRS)
    return {frozenset(names[i] for i in pair) for pair in pairs}


def contact_arrays(model: Model, geoms: Iterable[int]) -> Iterator[tuple[str, Any, Any]]:
    """Iterate over the arrays that a file contains, with the name of each row."""
    own: Any = model.geoms
    at = np.array([*geoms], int)
    if own is not None:
        names = [own.names[i] for i in at]
        for key in ("size", "position", *LEAVES):
            yield f"geoms.{key}", getattr(own, key)[at], names
        turns = own.orientation[at]
        turns = turns / np.linalg.norm(turns, axis=-1, keepdims=True)
        yield "geoms.orientation", turns[:, :, None] * turns[:, None, :], names
        for key in (*NUMBERS, "rgba"):
            yield f"geoms.{key}", np.array([getattr(own, key)[i] for i in at], float), names
    solver, top = model.solver, model.topology
    if solver is not None:
        for name, _ in JOINT_LEAVES.values():
            yield f"solver.{name}", getattr(solver, name), top.joint_names
        dofs = [top.joint_names[x.joint] for x in top.dofs]
        for name, _ in DOF_LEAVES.values():
            if name == "frictionloss" and rubs(model):
                continue  # the file has the friction of the elements
            yield f"solver.{name}", getattr(solver, name), dofs
        yield "solver.impratio", solver.impratio[None], ("impratio",)


def contact_differences(model: Model, again: Model, geoms: dict[int, int]) -> Iterator[str]:
    """Describe differences of pairs and of static parameters. geoms: index -> index read back."""
    for name in ("cone", "integrator", "refsafe", "limited", *["rubbing"] * (not rubs(model))):
        values = [getattr(m.solver, name, None) for m in (model, again)]
        if model.solver is not None and values[0] != values[1]:
            yield f"solver.{name}: {values[1]} in place of {values[0]}"
    if model.geoms is None or again.geoms is None:
        return
    ours: Any = model.geoms
    pairs = [tuple(sorted(geoms[i] for i in x)) for x in ours.pairs if set(x) <= set(geoms)]
    read = [tuple(sorted(pair)) for pair in again.geoms.pairs]
    if sorted(pairs) != sorted(read):
        missing, added = len(set(pairs) - set(read)), len(set(read) - set(pairs))
        yield f"contact pairs: {missing} missing, {added} added"
    own = [i for i, x in enumerate(ours.pairs[: len(ours.pair_condim)]) if set(x) <= set(geoms)]
    for key in PAIR_LEAVES:
        a, b = getattr(ours, f"pair_{key}")[own], getattr(again.geoms, f"pair_{key}")
        if np.shape(a) != np.shape(b) or not np.allclose(a, b, rtol=1e-6, atol=0):
            yield f"geoms.pair_{key}"


def rubs(model: Model) -> bool:
    """Return whether a model has friction of joints as a force element."""
    return any(isinstance(x, JointFriction) for x in model.forces)


def _unusual(given: dict[str, Any], usual: dict[str, Any]) -> dict[str, str]:
    """Return as text the attributes of `given` whose values differ from the defaults `usual`."""
    differ = {key: x for key, x in given.items() if text(x) != text(np.asarray(usual[key]))}
    return {key: text(x) for key, x in differ.items()}


def _flag(draft: Draft, name: str) -> None:
    """Disable a feature of MuJoCo."""
    found = draft.option.find("flag")
    flags = ET.SubElement(draft.option, "flag") if found is None else found
    flags.set(name, "disable")


def _body(draft: Draft, body: int) -> str:
    return "world" if body == WORLD else draft.bodies[body].get("name", "")
