"""Differences between a model and the file that was written from it, by reading the file."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from rbjax.constraints import Constraint, JointPolynomial, Pair, TendonPolynomial
from rbjax.forces import Element
from rbjax.forces.actuators.actuator import Actuator
from rbjax.forces.actuators.orientation_servo import OrientationServo
from rbjax.loading.write.contacts import contact_arrays, contact_differences
from rbjax.loading.write.draft import Draft, free_bodies, place_in_body
from rbjax.model import Model

Array = np.ndarray
_CLOSE = {8: 1e-11, 4: 1e-6}  # relative tolerance, by the bytes of a number
_TINY = 1e-14  # absolute tolerance
_SPRING = ("stiffness", "damping", "slack")  # fields of PointSpring

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
    yield from _of_tendons(draft, again)
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


def _of_tendons(draft: Draft, again: Model) -> Iterator[Difference]:
    model, springs = draft.model, draft.springs
    own: Any = model.tendons
    read: Any = again.tendons
    n, names = len(model.tendon_names), draft.tendons
    if len(again.tendon_names) != n + len(springs):
        yield f"{len(again.tendon_names)} tendons in place of {n + len(springs)}", []
        return
    if n and list(again.tendon_names[:n]) != list(model.tendon_names):
        yield "names of tendons", names[:n]
    for k, spring in enumerate(springs, n):
        for one, at in zip(_SPRING, ("stiffness", "damping", "springlength"), strict=True):
            if not _same(_padded(getattr(spring, one)), _padded(getattr(read, at)[k])):
                yield f"{one} of PointSpring", [names[k]]
    for f in dataclasses.fields(own) if n else ():
        ours, theirs = getattr(own, f.name), getattr(read, f.name)
        if f.name in ("limited", "rubbing") and ours != tuple(i for i in theirs if i < n):
            yield f"tendons.{f.name}", names[:n]
        elif f.name == "paths" and not all(
            _same_path(draft, again, *pair) for pair in zip(ours, theirs[:n], strict=True)
        ):
            yield "paths of tendons", names[:n]
        elif f.name == "coefficients" and not _same(ours, theirs[: len(ours)]):
            yield "tendons.coefficients", names[:n]
        elif eqx.is_array_like(ours) and f.name != "coefficients":
            rows = zip(names, map(_padded, ours), map(_padded, theirs[:n]), strict=False)
            wrong = [name for name, a, b in rows if not _same(a, b)]
            if wrong:
                yield f"tendons.{f.name}", wrong


def _padded(row: Any) -> Array:
    """Append zeros to the coefficients of a polynomial."""
    row = np.atleast_1d(row)
    return np.concatenate([row, np.zeros(max(0, 5 - len(row)), row.dtype)])


def _same_path(draft: Draft, again: Model, ours: Sequence[Any], theirs: Sequence[Any]) -> bool:
    """Check whether two paths have the same joints, sites and geoms."""
    if [x.kind for x in ours] != [x.kind for x in theirs]:
        return False
    return all(_same_waypoint(draft, again, a, b) for a, b in zip(ours, theirs, strict=True))


def _same_waypoint(draft: Draft, again: Model, a: Any, b: Any) -> bool:
    """Check whether two elements of paths have the same joint, site, or geom by its numbers."""

    def site(index: int, sites: Sequence[str]) -> str | None:
        return sites[index] if index >= 0 else None

    if a.kind == "site":
        return site(a.index, draft.sites) == site(b.index, again.site_names)
    if a.kind != "geom":
        return a.index == b.index
    ours: Any = draft.model.geoms
    theirs: Any = again.geoms
    same_side = site(a.side, draft.sites) == site(b.side, again.site_names)
    (i, j), names = (a.index, b.index), ("position", "orientation")
    placed = all(_same(getattr(ours, n)[i], getattr(theirs, n)[j]) for n in names)
    kinds = ours.types[i] == theirs.types[j] and ours.bodies[i] == theirs.bodies[j]
    return same_side and placed and kinds and _same(ours.size[i, :1], theirs.size[j, :1])


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
    if isinstance(one, TendonPolynomial):
        driver = -1 if one.driver is None else model.tendon(one.driver)
        return [model.tendon(one.tendon), driver, one.coefficients]
    raise TypeError(f"{type(one).__name__} is not written")


def _comparable(element: Element) -> Any:
    """Return the parameters of an element without the indices of sites, which may differ."""
    if isinstance(element, Actuator):
        law, gear = element.law, element.transmission
        return jax.tree.leaves(gear), _comparable_law(law), element.ctrlrange, element.forcerange
    if isinstance(element, OrientationServo):
        leaves = (element.gains, element.ctrlrange, element.strongest, element.activation)
        return leaves, element.size
    return element


def _comparable_law(law: Any) -> Any:
    """Return the force law without `acc0` of muscles, which MuJoCo computes when it compiles."""
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
