"""Write a `Model` as an MJCF file.

The file is read back as `load` would read it, and compared with the model. Differences are listed
in a comment at the top of the file and in a warning.
"""

from __future__ import annotations

import itertools
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError, ModelError, UnsupportedFeature, listed
from rbjax.loading.loader import from_compiled
from rbjax.loading.mjcf.actuators import write_actuators
from rbjax.loading.mjcf.constraints import write_constraints
from rbjax.loading.mjcf.fields import ALIGNED, matrix_of, quaternion_of
from rbjax.loading.mjcf.tendons import write_tendons
from rbjax.loading.write.contacts import write_geoms, write_pairs, write_solver
from rbjax.loading.write.differences import differences
from rbjax.loading.write.draft import Draft, free_bodies, text, unique, unusual
from rbjax.loading.write.forces import box_axes, write_forces
from rbjax.loading.write.sensors import sensors_differ, write_sensors
from rbjax.model import WORLD, Model

_KINDS = {"free", "ball", "slide", "hinge"}
_DEEPEST = 490  # largest depth of nested bodies; MuJoCo's reader accepts about 500 nested elements
_LEAST = 2e-15  # kg or kg m^2; MuJoCo rejects a moving mass below 1e-15
_ROUNDING = 1e-6  # relative excess of a moment over the sum of the other two that is corrected
_DIAGONAL = 1e-15  # products of inertia below this part of the moments are rounding


def write_mjcf(model: Model, path: str | Path | None = None, *, strict: bool = False) -> str:
    """Write a model as the text of an MJCF file from which `load` reads the same model.

    The file contains masses, centers of mass, inertias, frames, joints with springs, dampers,
    armature and ranges, actuators with their states, sites, tendons, geoms except meshes and height
    fields, the pairs that may touch, parameters of contacts, limits and friction loss, keyframes,
    sensors, gravity, timestep, and the force elements and constraints that MJCF has.

    Args:
        model: the robot, not a batch and not traced.
        path: output file, or None.
        strict: raise instead of warn about parts that the file cannot express.

    Returns:
        The text. A comment at its top lists the parts that differ from the model or are left out.

    Raises:
        ModelError: values that MuJoCo rejects in a file, such as impossible inertials.
        InputError: a batch of models, or a traced model.
        UnsupportedFeature: with `strict=True`, the list of parts that the file cannot express.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> heavy = model.replace(bodies=model.bodies.replace(mass=2 * model.bodies.mass))
        >>> again = rb.load(rb.write_mjcf(heavy))
        >>> (again.bodies.mass / model.bodies.mass).tolist()
        [2.0]
    """
    draft = make_draft(model)
    out = serialize(draft)
    if draft.notes:
        message = f"write_mjcf: not in the file as in the model: {'; '.join(draft.notes)}"
        if strict:
            raise UnsupportedFeature(f"{message}. Write with strict=False to go without.")
        warnings.warn(message, stacklevel=2)
    if path is not None:
        Path(path).write_text(out, encoding="utf-8")
    return out


def make_draft(model: Model) -> Draft:
    """Build the file of a model as XML elements, with notes on the parts that it lacks.

    Raises:
        ModelError, InputError: see `write_mjcf`.
    """
    model = _known(model)
    draft = Draft.of(model)
    draft.option.set("timestep", text(model.timestep))
    draft.option.set("gravity", text(model.gravity))
    _write_bodies(draft)
    _write_joints(draft)
    write_solver(draft)
    write_geoms(draft)
    _write_sites(draft)
    write_tendons(draft)
    written = [*write_forces(draft), *write_actuators(draft)]
    constraints = write_constraints(draft)
    if draft.geoms:
        write_pairs(draft, compile_mjcf(serialize(draft)))
    seen = write_sensors(draft)
    _write_keyframes(draft)
    compiled = compile_mjcf(serialize(draft))
    again = jax.tree.map(np.asarray, from_compiled(compiled, contacts=model.contact is not None))
    for what, names in differences(draft, again, written, constraints):
        draft.note(what, names)
    if changed := sensors_differ(draft, again, seen):
        draft.note("sensors that are read back as others", changed)
    return draft


def _known(model: Model) -> Model:
    """Return the model with NumPy leaves, or raise if it is traced, a batch, or not finite."""
    one = "write one model of the batch, jax.tree.map(lambda x: x[0], models)"
    check_model("write_mjcf", model, fix=one)
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(model)):
        raise InputError(
            "write_mjcf: got a traced model, expected concrete values; call it outside of jit, "
            "vmap and grad"
        )
    kinds = zip(model.joint_names, model.topology.joint_kinds, strict=True)
    others = [f"{name} ({kind})" for name, kind in kinds if kind not in _KINDS]
    if others:
        raise UnsupportedFeature(
            f"write_mjcf: MJCF has no such joints: {', '.join(others)}; expected {sorted(_KINDS)}; "
            "put one of these in their place, model.with_joint(name, kind)"
        )
    model = jax.tree.map(np.asarray, model.replace(constants=None))
    endless = ("forcerange", "range", "ctrlrange")  # infinite values mean no limit
    for at, leaf in jax.tree_util.tree_leaves_with_path(model.replace(forces=())):
        name = jax.tree_util.keystr(at).lstrip(".")
        bad = np.isnan(leaf) if name.endswith(endless) else ~np.isfinite(leaf)
        if bad.any():
            raise ModelError(
                f"write_mjcf: {name} has {leaf[bad][0]} at {np.argwhere(bad)[0].tolist()}, "
                f"expected finite numbers; correct it with model.replace"
            )
    return model


def _write_bodies(draft: Draft) -> None:
    """Write the tree of bodies with their frames and inertials."""
    top, own = draft.model.topology, draft.model.bodies
    depth: list[int] = []
    free, inertials = free_bodies(draft.model), _inertials(draft)
    for b, (name, parent) in enumerate(zip(unique(top.body_names), top.body_parents, strict=True)):
        depth.append(1 if parent == WORLD else depth[parent] + 1)
        if depth[b] > _DEEPEST:
            raise ModelError(
                f"write_mjcf: body {name!r} is the {depth[b]}th of a chain, expected at most "
                f"{_DEEPEST}, for MuJoCo reads no deeper files; weld or split the chain"
            )
        position: Any = own.position[b]
        orientation: Any = own.orientation[b]
        if b in free:
            start = top.joint_q[top.joint_bodies.index(b)]
            position, orientation = np.split(draft.model.joints.reference[start : start + 7], [3])
        frame = unusual(name=name, pos=text(position), quat=text(orientation))
        element = ET.SubElement(draft.body(parent), "body", frame)
        mass, moments, axes = inertials[b]
        numbers = unusual(quat=text(axes), mass=text(mass), diaginertia=text(moments))
        ET.SubElement(element, "inertial", {"pos": text(own.com[b])} | numbers)
        draft.bodies.append(element)


def _inertials(draft: Draft) -> list[tuple[Any, np.ndarray, np.ndarray]]:
    """Return mass, principal moments and principal axes (quaternion) of each body."""
    model, out, wrong, raised = draft.model, [], [], []
    bare, boxes = _bare(model), box_axes(model)
    for b, name in enumerate(model.body_names):
        mass: Any = model.bodies.mass[b]
        moments, axes = _principal(model.bodies.inertia[b], boxes.get(b))
        largest = np.abs(moments).max()
        order = np.argsort(moments)
        low, middle, high = moments[order]
        excess = high - low - middle
        if mass < 0 or low < -_ROUNDING * largest or excess > _ROUNDING * largest:
            wrong.append(name)
        moments = np.maximum(moments, 0.0)
        if excess > 0:  # rounding: add it to the two smaller moments
            moments[order[:2]] += excess / 2
            while moments[order[0]] + moments[order[1]] < high:
                moments[order[1]] = np.nextafter(moments[order[1]], np.inf)
        if b in bare and (mass < _LEAST or moments.min() < _LEAST):
            raised.append(name)
            mass, moments = max(mass, _LEAST), np.maximum(moments, _LEAST)
        out.append((mass, moments, axes))
    if wrong:
        raise ModelError(
            f"write_mjcf: inertials that no rigid body has, in the bodies {listed(wrong)}; "
            f"MuJoCo refuses them, and expects a mass of at least zero and moments none of which "
            f"exceeds the sum of the other two; correct them, rb.spatial.consistency says what is "
            f"wrong"
        )
    if raised:
        draft.note(f"masses or moments raised to {_LEAST:g}, which is MuJoCo's least", raised)
    return out


def _bare(model: Model) -> set[int]:
    """Return the bodies with joints whose welded bodies have no mass and inertia of their own."""
    top, own = model.topology, model.bodies
    smallest = np.linalg.eigvalsh(np.asarray(own.inertia, np.float64)).min(-1, initial=np.inf)
    solid = np.flatnonzero((np.asarray(own.mass) >= _LEAST) & (smallest >= _LEAST))
    held = {top.carriers[b] for b in solid if top.carriers[b] != b}
    return set(top.joint_bodies) - held


def _principal(inertia: Any, asked: Any) -> tuple[np.ndarray, np.ndarray]:
    """Compute principal moments and axes: the requested axes if they are principal, otherwise the
    principal axes with the smallest rotation."""
    exact = np.array([[float(text(x)) for x in row] for row in inertia])  # as written in decimals
    for quat in (ALIGNED if asked is None else asked, ALIGNED):
        turn = matrix_of(quat)
        seen = turn.T @ exact @ turn
        moments = np.diag(seen).copy()
        if np.abs(seen - np.diag(moments)).max() <= _DIAGONAL * np.abs(moments).max():
            return moments, np.asarray(quat)
    moments, vectors = np.linalg.eigh((exact + exact.T) / 2)
    order = max(itertools.permutations(range(3)), key=lambda p: np.abs(vectors[:, p]).trace())
    moments, vectors = moments[[*order]], vectors[:, order]
    vectors = vectors * np.where(np.diag(vectors) < 0, -1.0, 1.0)
    vectors[:, 0] *= np.sign(np.linalg.det(vectors))
    return moments, quaternion_of(vectors)


def _write_joints(draft: Draft) -> None:
    """Write the joints into their bodies, in order."""
    top, own = draft.model.topology, draft.model.joints
    uneven = []
    names = unique(top.joint_names)
    for j, (name, kind, body) in enumerate(
        zip(names, top.joint_kinds, top.joint_bodies, strict=True)
    ):
        q, start = top.joint_q[j], top.joint_v[j]
        v = slice(start, start + top.joints[j].nv)
        given = {"armature": own.armature[v], "damping": own.damping[v]}
        uneven += [f"{key} of {name}" for key, x in given.items() if np.ptp(x)]
        given = {key: x[0] for key, x in given.items()} | {"stiffness": own.stiffness[j]}
        attributes = {"name": name, "type": kind}
        if kind != "free":
            attributes["pos"] = text(own.placement[j])
        if kind in ("hinge", "slide"):
            attributes["axis"] = text(own.axis[j])
            if own.reference[q]:
                attributes["ref"] = text(own.reference[q])
            if own.springref[q]:
                attributes["springref"] = text(own.springref[q])
        attributes |= {key: text(x) for key, x in given.items() if x}
        for key, limits in (("range", own.range[j]), ("actuatorfrcrange", own.forcerange[j])):
            if np.isfinite(limits).any():
                attributes[key] = text(limits)
        draft.joints.append(draft.add(body, "joint", **attributes))
    if uneven:
        draft.note("the value of the first axis, where the axes of a joint differ", uneven)


def _write_sites(draft: Draft) -> None:
    top, own = draft.model.topology, draft.model.sites
    draft.sites += unique(top.site_names)
    for name, body, p, quat in zip(
        draft.sites, top.site_bodies, own.position, own.orientation, strict=True
    ):
        draft.add(body, "site", name=name, pos=text(p), quat=text(quat))


def _write_keyframes(draft: Draft) -> None:
    names, keys = draft.model.keyframe_names, draft.model.keyframes
    if not names:
        return
    section = ET.SubElement(draft.root, "keyframe")
    for k, name in enumerate(unique(names)):
        given = {"qpos": keys.q[k], "qvel": keys.v[k], "ctrl": keys.ctrl[k]}
        if keys.x is not None:
            given["act"] = keys.x[k]
        some = {key: text(x) for key, x in given.items() if len(x)}
        ET.SubElement(section, "key", {"name": name} | some)


def serialize(draft: Draft) -> str:
    """Convert the file to text, with its notes at the top."""
    root = ET.Element(draft.root.tag, draft.root.attrib)
    for note in draft.notes:
        root.append(ET.Comment(f" not as in the model: {note} ".replace("--", "- -")))
    # ranges are written even if the model has no force for them
    for left_out in (x for x in draft.model.dropped if not x.startswith("joint limits")):
        said = f" left out when the model was loaded: {left_out} "
        root.append(ET.Comment(said.replace("--", "- -")))
    root.extend(x for x in draft.root if len(x) or x.attrib)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def compile_mjcf(mjcf: str) -> mujoco.MjModel:
    """Compile the text of a file from `write_mjcf`."""
    try:
        return mujoco.MjModel.from_xml_string(mjcf)
    except ValueError as error:
        message = " ".join(str(error).split())
        raise ModelError(
            f"write_mjcf: MuJoCo rejects the file of this model: {message}; correct the value "
            "named there with model.replace"
        ) from error
