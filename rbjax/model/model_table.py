"""The display of a model: counts of its parts, and a table of its joints."""

from __future__ import annotations

from typing import Any

from rbjax.display import Display, plural, shape, short_dtype


def model_display(model: Any) -> Display:
    """Return the display of a `Model`: its sizes, its other parts, and its joints.

    It reads static fields, shapes and dtypes only, so that any model has it: a batch, a model of
    tracers, and a pytree of other leaves, such as the axes of `vmap`.
    """
    top, mass = model.topology, model.bodies.mass
    batch = shape(mass)[:-1]
    dtype = f", {short_dtype(mass.dtype)}" if hasattr(mass, "dtype") else ""
    sizes = f"nq {top.nq}, nv {top.nv}, nu {len(top.actuator_names)}"
    parts = f"{plural(top.nb, 'body')}, {plural(len(top.joint_names), 'joint')}"
    title = f"Model{f' [batch {batch}]' if batch else ''}: {parts}, {sizes}{dtype}"
    names = (*top.body_names, "world")  # the parent WORLD is -1
    rows = []
    for k, joint in enumerate(top.joints):
        q, v, body = top.joint_q[k], top.joint_v[k], top.joint_bodies[k]
        rows.append((
            top.joint_names[k], top.joint_kinds[k], names[body], names[top.body_parents[body]],
            _span(q, joint.nq), _span(v, joint.nv),
        ))  # fmt: skip
    return Display(title, rows, ("joint", "kind", "body", "parent", "q", "v"), _notes(model))


def _span(start: int, count: int) -> str:
    return str(start) if count == 1 else f"{start}:{start + count}"


def _notes(model: Any) -> list[str]:
    top, counts = model.topology, []
    others = {
        "actuator": top.actuator_names, "tendon": model.tendon_names, "site": top.site_names,
        "keyframe": top.keyframe_names, "sensor": model.sensors,
        "geom": () if model.geoms is None else model.geoms.names,
    }  # fmt: skip
    counts = [plural(len(x), name) for name, x in others.items() if len(x)]
    contact = "" if model.contact is None else f", contact {model.contact!r}"
    notes = [", ".join([*counts, f"timestep {model.timestep:g} s"]) + contact]
    for name in ("forces", "constraints"):
        kinds = [type(x).__name__ for x in getattr(model, name)]
        several = [f"{kinds.count(k)} {k}" for k in dict.fromkeys(kinds)]
        notes += [f"{name}: {', '.join(several)}"] if several else []
    if model.dropped:
        notes.append(f"dropped from the file: {', '.join(model.dropped)}")
    return notes
