"""Where a written file differs from its model, found by reading the file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from rbjax.constraints import Constraint, JointPolynomial, Pair
from rbjax.forces import Element, PointSpring
from rbjax.forces.actuators.actuator import Actuator
from rbjax.forces.actuators.orientation_servo import OrientationServo
from rbjax.loading.write.constraints import in_body
from rbjax.loading.write.draft import Draft, free_bodies
from rbjax.model import Model

Array = np.ndarray
_CLOSE = {8: 1e-11, 4: 1e-6}  # relative, by the bytes of a number
_TINY = 1e-14  # absolute
_ALIKE = ("position", "orientation")  # leaves of bodies and sites

Difference = tuple[str, list[str]]


def differences(
    draft: Draft, again: Model, written: list[Element], constraints: list[Constraint]
) -> Iterator[Difference]:
    """What is not the same in the model that was read back, and where, in words."""
    model, top, other = draft.model, draft.model.topology, again.topology
    pairs = {"bodies": (top.body_names, other.body_names),
             "joints": (top.joint_names, other.joint_names),
             "actuators": (top.actuator_names, other.actuator_names),
             "keyframes": (top.keyframe_names, other.keyframe_names)}  # fmt: skip
    for what, (names, read) in pairs.items():
        if len(names) != len(read):
            yield f"{len(read)} {what} in place of {len(names)}", []
            return
        other_names = [f"{a} as {b}" for a, b in zip(names, read, strict=True) if a != b]
        if other_names:
            yield f"names of {what}", other_names
    yield from _of_bodies(model, again)
    yield from _of_joints(model, again)
    yield from _of_sites(draft, again)
    for name in ("gear", "gain", "bias", "ctrlrange", "forcerange"):
        a, b = getattr(model.actuators, name), getattr(again.actuators, name)
        yield from _rows(f"actuators.{name}", a, b, top.actuator_names)
    for name in ("q", "v", "ctrl"):
        a, b = getattr(model.keyframes, name), getattr(again.keyframes, name)
        yield from _rows(f"keyframes.{name}", a, b, top.keyframe_names)
    yield from _rows("gravity", model.gravity[None], again.gravity[None], ("gravity",))
    yield from _of_elements(model, again, written)
    yield from _of_constraints(model, again, constraints)


def _of_bodies(model: Model, again: Model) -> Iterator[Difference]:
    free = free_bodies(model)
    for name in ("mass", "com", "inertia", *_ALIKE):
        a, b = (_as_turns(name, getattr(x.bodies, name)) for x in (model, again))
        # a free joint's body starts where `joints.reference` says
        keep = [i for i in range(model.nb) if not (i in free and name in _ALIKE)]
        names = [model.body_names[i] for i in keep]
        yield from _rows(f"bodies.{name}", a[keep], b[keep], names)


def _of_joints(model: Model, again: Model) -> Iterator[Difference]:
    top, names = model.topology, model.joint_names
    sizes = [(joint.nq, joint.nv) for joint in top.joints]
    in_q = [name for name, (n, _) in zip(names, sizes, strict=True) for _ in range(n)]
    in_v = [name for name, (_, n) in zip(names, sizes, strict=True) for _ in range(n)]
    turning = [j for j, kind in enumerate(top.joint_kinds) if kind in ("hinge", "slide")]
    placed = [j for j, kind in enumerate(top.joint_kinds) if kind != "free"]
    own, read = model.joints, again.joints
    for name in ("armature", "damping"):
        yield from _rows(f"joints.{name}", getattr(own, name), getattr(read, name), in_v)
    for name in ("reference", "springref"):
        yield from _rows(f"joints.{name}", getattr(own, name), getattr(read, name), in_q)
    for name in ("stiffness", "forcerange", "range"):
        yield from _rows(f"joints.{name}", getattr(own, name), getattr(read, name), names)
    for name, some in (("placement", placed), ("axis", turning)):
        a, b = (getattr(x, name)[some] for x in (own, read))
        if name == "axis":  # of any length
            a, b = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (a, b))
        yield from _rows(f"joints.{name}", a, b, [names[j] for j in some])


def _of_sites(draft: Draft, again: Model) -> Iterator[Difference]:
    """By name: the file may have more of them, where springs take hold."""
    names = draft.sites[: len(draft.model.site_names)]
    at = np.array([again.site(name) for name in names], int)
    for name in _ALIKE:
        a, b = (_as_turns(name, getattr(x.sites, name)) for x in (draft.model, again))
        yield from _rows(f"sites.{name}", a, b[at], names)


def _as_turns(name: str, x: Any) -> Array:
    """Quaternions as what they turn, whatever their length and sign."""
    if name != "orientation":
        return np.asarray(x)
    x = np.asarray(x) / np.linalg.norm(x, axis=-1, keepdims=True)
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
            yield f"numbers of {type(element).__name__}", _controlled(model, element)
    states = [x for x in model.forces if x.size]
    if [x.size for x in states] != [x.size for x in again.forces if x.size] or [
        getattr(x, "controls", ()) for x in states
    ] != [getattr(x, "controls", ()) for x in again.forces if x.size]:
        yield "the order of the force elements' states x", []


def _of_constraints(model: Model, again: Model, written: list[Constraint]) -> Iterator[Difference]:
    if [type(x) for x in again.constraints] != [type(x) for x in written]:
        kinds = [type(x).__name__ for x in again.constraints]
        yield "constraints, which are read back as others", kinds or ["none"]
        return
    for one, read in zip(written, again.constraints, strict=True):
        a, b = (_coupled(m, x) for m, x in ((model, one), (again, read)))
        if not all(map(_same, a, b)):
            yield f"numbers of {type(one).__name__}", []


def _coupled(model: Model, one: Constraint) -> list:
    """What a constraint couples, by index, and its numbers."""
    if isinstance(one, Pair):
        ends = [in_body(model, place) for place in (one.a, one.b)]
        return [x for body, p, quat in ends for x in (body, p, _as_turns(_ALIKE[1], quat[None]))]
    if isinstance(one, JointPolynomial):
        driver = -1 if one.driver is None else model.joint(one.driver)
        return [model.joint(one.joint), driver, one.coefficients]
    raise TypeError(f"{type(one).__name__} is not written")


def _comparable(element: Element) -> Any:
    """What of an element has numbers, and indices that are those of the model: a file may have more
    sites than its model."""
    if isinstance(element, Actuator):
        law, gear = element.law, element.transmission
        return jax.tree.leaves(gear), _unmeasured(law), element.ctrlrange, element.forcerange
    if isinstance(element, OrientationServo):
        leaves = (element.gains, element.ctrlrange, element.strongest, element.activation)
        return leaves, element.size
    if isinstance(element, PointSpring):
        return element.stiffness, element.damping, element.slack
    return element


def _unmeasured(law: Any) -> Any:
    """The law without what only scaled muscles use, which MuJoCo measures again."""
    curves: list[Any] = [getattr(law, name, None) for name in ("gain", "bias")]
    muscles = [x.muscle for x in curves if hasattr(x, "muscle")]
    if not muscles:
        return law
    return [(x.parameters, x.lengthrange) for x in muscles], law.activation, law.early


def _controlled(model: Model, element: Element) -> list[str]:
    return [model.actuator_names[c] for c in getattr(element, "controls", ())]


def _rows(what: str, a: Any, b: Any, names: Any) -> Iterator[Difference]:
    wrong = np.flatnonzero(~_close(np.asarray(a), np.asarray(b)))
    if len(wrong):
        yield what, list(dict.fromkeys(names[i] for i in wrong))


def _same(a: Any, b: Any) -> bool:
    return bool(_close(np.asarray(a)[None], np.asarray(b)[None]).all())


def _close(a: Array, b: Array) -> Array:
    """Whether each row is the same, but for rounding of its largest number."""
    if a.shape != b.shape:
        return np.zeros(len(a), bool)
    close = _CLOSE.get(np.asarray(a).dtype.itemsize, 1e-2)
    row = int(np.prod(a.shape[1:]))
    a, b = (np.asarray(x, np.float64).reshape(len(a), row) for x in (a, b))
    size = np.where(np.isfinite(a), np.abs(a), 0.0).max(-1, initial=0.0)
    off = np.where(a == b, 0.0, np.abs(np.where(a == b, 0.0, a) - np.where(a == b, 0.0, b)))
    return off.max(-1, initial=0.0) <= close * size + _TINY
