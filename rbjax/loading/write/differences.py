"""Differences between a model and the file that was written from it, by reading the file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from rbjax.constraints import Constraint, JointPolynomial, Pair
from rbjax.forces import Element, PointSpring
from rbjax.forces.actuators.actuator import Actuator
from rbjax.forces.actuators.orientation_servo import OrientationServo
from rbjax.loading.write.contacts import contact_arrays, contact_differences
from rbjax.loading.write.draft import Draft, free_bodies, place_in_body
from rbjax.model import Model

Array = np.ndarray
_CLOSE = {8: 1e-11, 4: 1e-6}  # relative tolerance, by the bytes of a number
_TINY = 1e-14  # absolute tolerance

Difference = tuple[str, list[str]]


def differences(
    draft: Draft, again: Model, written: list[Element], constraints: list[Constraint]
) -> Iterator[Difference]:
    """Describe the differences of the model that was read back, each with the names of its
    rows."""
    model, top, other = draft.model, draft.model.topology, again.topology
    for what in ("body_names", "joint_names", "actuator_names", "keyframe_names"):
        names, read = getattr(top, what), getattr(other, what)
        kind = what.removesuffix("_names").replace("body", "bodie") + "s"
        if len(names) != len(read):
            yield f"{len(read)} {kind} in place of {len(names)}", []
            return
        renamed = [f"{a} as {b}" for a, b in zip(names, read, strict=True) if a != b]
        if renamed:
            yield f"names of {kind}", renamed
    sites = draft.sites[: len(model.site_names)]
    # the file may have additional sites, at the ends of springs
    at = np.array([again.site(name) for name in sites], int)
    pairs = zip(_arrays(model, np.arange(len(sites))), _arrays(again, at), strict=True)
    for (what, a, names), (_, b, _) in pairs:
        wrong = np.flatnonzero(~_close(np.asarray(a), np.asarray(b)))
        if len(wrong):
            named = sites if what.startswith("sites") else names
            yield what, list(dict.fromkeys(named[int(i)] for i in wrong))
    yield from _of_elements(model, again, written)
    yield from _of_constraints(model, again, constraints)
    geoms = {i: again.geom(x.get("name", "")) for i, x in draft.geoms.items()}
    theirs = {what: x for what, x, _ in contact_arrays(again, geoms.values())}
    for what, a, names in contact_arrays(model, geoms):
        wrong = np.flatnonzero(~_close(np.asarray(a), np.asarray(theirs[what])))
        if len(wrong):
            yield what, list(dict.fromkeys(names[int(i)] for i in wrong))
    yield from ((what, []) for what in contact_differences(model, again, geoms))


def _arrays(model: Model, sites: Array) -> Iterator[tuple[str, Any, Sequence[str]]]:
    """Iterate over the arrays of a model that a file contains, with the name of each row."""
    top, bodies, joints = model.topology, model.bodies, model.joints
    names, kinds = top.joint_names, top.joint_kinds
    in_q, in_v = (
        [name for name, joint in zip(names, top.joints, strict=True) for _ in range(size(joint))]
        for size in (lambda joint: joint.nq, lambda joint: joint.nv)
    )
    for name in ("mass", "com", "inertia"):
        yield f"bodies.{name}", getattr(bodies, name), top.body_names
    # a file has the frame of the body of a free joint at `joints.reference`
    kept = [i for i in range(model.nb) if i not in free_bodies(model)]
    held = [top.body_names[i] for i in kept]
    yield "bodies.position", bodies.position[kept], held
    yield "bodies.orientation", _turns(bodies.orientation[kept]), held
    rows: dict[str, Sequence[str]] = dict.fromkeys(("armature", "damping"), in_v)
    rows |= dict.fromkeys(("reference", "springref"), in_q)
    rows |= dict.fromkeys(("stiffness", "forcerange", "range"), names)
    for name, labels in rows.items():
        yield f"joints.{name}", getattr(joints, name), labels
    placed = [j for j, kind in enumerate(kinds) if kind != "free"]
    yield "joints.placement", joints.placement[placed], [names[j] for j in placed]
    axial = [j for j, kind in enumerate(kinds) if kind in ("hinge", "slide")]
    axes = joints.axis[axial]
    axes = axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    yield "joints.axis", axes, [names[j] for j in axial]
    yield "sites.position", model.sites.position[sites], ()
    yield "sites.orientation", _turns(model.sites.orientation[sites]), ()
    for name in ("gear", "gain", "bias", "ctrlrange", "forcerange"):
        yield f"actuators.{name}", getattr(model.actuators, name), top.actuator_names
    for name in ("q", "v", "ctrl"):
        yield f"keyframes.{name}", getattr(model.keyframes, name), top.keyframe_names
    yield "gravity", model.gravity[None], ("gravity",)


def _turns(quaternions: Any) -> Array:
    """Convert quaternions (n, 4) to rotation matrices, independent of their length and sign."""
    x = np.asarray(quaternions)
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return x[:, :, None] * x[:, None, :]


def _of_elements(model: Model, again: Model, written: list[Element]) -> Iterator[Difference]:
    if [type(x) for x in again.forces] != [type(x) for x in written]:
        kinds = [type(x).__name__ for x in again.forces]
        yield "force elements, which are read back as others", kinds or ["none"]
        return
    for element, read in zip(written, again.forces, strict=True):
        a, b = _comparable(element), _comparable(read)
        form: Any = jax.tree.structure(a)
        same = form == jax.tree.structure(b)
        if not (same and all(map(_same, jax.tree.leaves(a), jax.tree.leaves(b)))):
            controls = getattr(element, "controls", ())
            names = [model.actuator_names[c] for c in controls]
            yield f"numbers of {type(element).__name__}", names
    ours, theirs = (
        [(x.size, getattr(x, "controls", ())) for x in m.forces if x.size] for m in (model, again)
    )
    if ours != theirs:
        yield "the order of the force elements' states x", []


def _of_constraints(model: Model, again: Model, written: list[Constraint]) -> Iterator[Difference]:
    if [type(x) for x in again.constraints] != [type(x) for x in written]:
        kinds = [type(x).__name__ for x in again.constraints]
        yield "constraints, which are read back as others", kinds or ["none"]
        return
    for one, read in zip(written, again.constraints, strict=True):
        if not all(map(_same, _ends(model, one), _ends(again, read))):
            yield f"numbers of {type(one).__name__}", []


def _ends(model: Model, one: Constraint) -> list:
    """Return the bodies or joints of a constraint, by index, and its parameters."""
    if isinstance(one, Pair):
        ends = [place_in_body(model, place) for place in (one.a, one.b)]
        return [x for body, p, quat in ends for x in (body, p, _turns(quat[None]))]
    if isinstance(one, JointPolynomial):
        driver = -1 if one.driver is None else model.joint(one.driver)
        return [model.joint(one.joint), driver, one.coefficients]
    raise TypeError(f"{type(one).__name__} is not written")


def _comparable(element: Element) -> Any:
    """Return the parameters of an element without the indices of sites, which may differ."""
    if isinstance(element, Actuator):
        law, gear = element.law, element.transmission
        return jax.tree.leaves(gear), _comparable_law(law), element.ctrlrange, element.forcerange
    if isinstance(element, OrientationServo):
        leaves = (element.gains, element.ctrlrange, element.strongest, element.activation)
        return leaves, element.size
    if isinstance(element, PointSpring):
        return element.stiffness, element.damping, element.slack
    return element


def _comparable_law(law: Any) -> Any:
    """Return the law without the acceleration of its muscles, which MuJoCo computes again."""
    curves: list[Any] = [getattr(law, name, None) for name in ("gain", "bias")]
    muscles = [x.muscle for x in curves if hasattr(x, "muscle")]
    if not muscles:
        return law
    return [(x.parameters, x.lengthrange) for x in muscles], law.activation, law.early


def _same(a: Any, b: Any) -> bool:
    return bool(_close(np.asarray(a)[None], np.asarray(b)[None]).all())


def _close(a: Array, b: Array) -> Array:
    """Check whether each row agrees within the rounding of its largest number."""
    if a.shape != b.shape:
        return np.zeros(len(a), bool)
    close = _CLOSE.get(np.asarray(a).dtype.itemsize, 1e-2)
    row = int(np.prod(a.shape[1:]))
    a, b = (np.asarray(x, np.float64).reshape(len(a), row) for x in (a, b))
    size = np.where(np.isfinite(a), np.abs(a), 0.0).max(-1, initial=0.0)
    off = np.where(a == b, 0.0, np.abs(np.where(a == b, 0.0, a) - np.where(a == b, 0.0, b)))
    return off.max(-1, initial=0.0) <= close * size + _TINY
