"""Addition of a geom to a body of a model, with its pairs."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, floating_array, instance, integer, real_array
from rbjax.contact.geometry.candidates import PairKind
from rbjax.contact.geometry.pair_filter import Collider, in_order, may_touch
from rbjax.errors import InputError
from rbjax.model import WORLD, Model
from rbjax.model.geoms import LEAVES, NUMBERS, OF_EACH_GEOM, RGBA, SIZES, Geoms
from rbjax.model.record import array_like

_STATIC = {**NUMBERS, "rgba": RGBA}
#: fields that `Geoms.replace` checks
_CHECKED = ("friction", "size", "condim", "solref")
_KINDS = (*SIZES, "plane")


def with_geom(
    model: Model, name: str, body: str, kind: str, size: Any, *, position: Any = (0.0, 0.0, 0.0),
    orientation: Any = (1.0, 0.0, 0.0, 0.0), **attributes: Any,
) -> Model:  # fmt: skip
    """Return a copy of a model with one more geom, fixed to a body or to a frame of a beam.

    Use it for bodies that are not in a file, such as the tip and the frames of `Model.with_beam`.
    The mass of the body does not change. The geom comes last in `model.geoms`.

    The new pairs are those of MuJoCo's rules: matching masks, not on one rigid body, not on a body
    and its parent unless the parent is fixed, not on two bodies of an `<exclude>` of the file. The
    frames of one beam do not touch each other. For other pairs use
    `model.geoms.replace(pairs=...)`. If `model.contact` is None, it becomes "mujoco", and all pairs
    of `model.geoms` act.

    Args:
        model: the robot.
        name: name of the geom.
        body: name of the body, or "world".
        kind: "sphere", "capsule", "ellipsoid", "cylinder", "box", or, on fixed bodies, "plane".
        size: one to three numbers in m, as in `model.geoms.size`.
        position: (3,) m, in the frame of the body. The frames of a beam have x along the beam.
        orientation: (4,) unit quaternion.
        attributes: friction (3,), solref (2,), solimp (5,), margin, gap, solmix, contype,
            conaffinity, condim, priority, group and rgba of `model.geoms`; MuJoCo's defaults
            without them.

    Raises:
        UnknownName: no such body, kind or attribute. InputError: a name that is taken, a wrong
            shape, a size that is not positive, a plane on a body that moves. Pairs without a narrow
            phase are left out, with a warning.

    Source: MuJoCo, *Computation*, "Collision detection".

    Example:
        >>> import rbjax as rb
        >>> floor = '<mujoco><worldbody><geom type="plane" size="0 0 1"/></worldbody></mujoco>'
        >>> rod = rb.flexible.beam(1.0, [0, 5.0, 5.0, 0, 0, 0], {"k_y": 2}, mass=0.5)
        >>> model = rb.load(floor).with_beam("rod", rod, position=(0, 0, 0.2), frames={"mid": 0.5})
        >>> model = rb.contact.with_geom(model, "pad", "mid", "sphere", 0.02, condim=1)
        >>> model.contact, model.geoms.pairs
        ('mujoco', ((0, 1),))
    """
    where = "contact.with_geom"
    instance(where, "model", model, Model, "a Model of rb.load")
    top, dtype = model.topology, model.gravity.dtype
    geoms = _none(dtype) if model.geoms is None else model.geoms
    if not isinstance(name, str) or not name or name in geoms.names:
        raise InputError(
            f"{where}: name is {name!r}, expected a new name of a geom; the model has "
            f"{list(geoms.names)}"
        )
    on_world = body == "world" and "world" not in top.body_names
    at = WORLD if on_world else model.body(body)
    choice("kind of geom", kind, _KINDS)
    if kind == "plane" and _moving(top, at) != WORLD:
        raise InputError(f"{where}: the plane {name!r} is on {body!r}, expected a fixed body")
    for key in attributes:
        choice("attribute of a geom", key, (*LEAVES, *_STATIC))
    rows = {key: attributes.get(key, x) for key, x in LEAVES.items()}
    rows |= {"size": _sizes(where, kind, size), "position": position, "orientation": orientation}
    fields = {key: attributes.get(key, x) for key, x in _STATIC.items()}
    fields |= {"names": name, "types": kind, "bodies": at}
    new = _with_row(where, geoms, rows, fields)
    pairs = _supported(new, (*geoms.pairs, *_new_pairs(model, new)), len(geoms.pair_condim))
    return dataclasses.replace(
        model,
        geoms=new.replace(pairs=pairs, **{key: getattr(new, key) for key in _CHECKED}),
        execution=model.execution.replace(zeros=None, constants=None, weights=None),
        contact="mujoco" if model.contact is None and pairs else model.contact,
    )


def _none(dtype: Any) -> Geoms:
    """Return the geoms of a model without geoms."""
    shapes: dict[str, tuple[int, ...]] = {
        "position": (3,), "orientation": (4,), "size": (3,), "pair_friction": (5,),
        "pair_solref": (2,), "pair_solreffriction": (2,), "pair_solimp": (5,), "pair_margin": (),
        "pair_gap": (),
    }  # fmt: skip
    shapes |= {key: np.shape(x) for key, x in LEAVES.items()}
    fields: dict[str, Any] = {k: jnp.zeros((0, *shape), dtype) for k, shape in shapes.items()}
    return Geoms(**fields | dict.fromkeys(OF_EACH_GEOM, ()), heights=())


def _with_row(where: str, geoms: Geoms, rows: dict[str, Any], fields: dict[str, Any]) -> Geoms:
    """Append a row to the leaves and an entry to the static fields of geoms."""
    leaves: dict[str, Any] = {}
    for key, given in rows.items():
        x = getattr(geoms, key)
        row = array_like(f"{where}({key}=...)", given, x.shape[1:], x.dtype, infinite=False)
        leaves[key] = jnp.concatenate([x, row[None]])
    turn = leaves["orientation"][-1]
    if not isinstance(turn, jax.core.Tracer) and not np.asarray(turn).any():
        raise InputError(f"{where}: orientation is zero, expected a unit quaternion (w, x, y, z)")
    fields = {key: integer(where, key, x) if key in NUMBERS else x for key, x in fields.items()}
    fields["rgba"] = tuple(real_array(where, "rgba", fields["rgba"], "(4,)", ndim=1).tolist())
    static: dict[str, Any] = {key: (*getattr(geoms, key), fields[key]) for key in OF_EACH_GEOM}
    count = len(geoms.names)
    static["hulls"] = (*geoms.hulls, *[None] * (1 + count - len(geoms.hulls)))
    static["fields"] = (*geoms.fields, *[-1] * (1 + count - len(geoms.fields)))
    return dataclasses.replace(geoms, **leaves, **static)


def _sizes(where: str, kind: str, size: Any) -> Any:
    """Return the size (3,) of a geom from its first one to three numbers."""
    least = 2 if kind == "capsule" else max(SIZES.get(kind, 1), 1)
    given = floating_array(
        where, "size", size if np.ndim(size) else [size],
        lambda shape: len(shape) == 1 and least <= shape[0] <= 3,
        f"({least},) to (3,) for a {kind}, in m" if least < 3 else f"(3,) for a {kind}, in m",
    )  # fmt: skip
    return jnp.concatenate([given, jnp.zeros(3 - given.size, given.dtype)])


def _moving(top: Any, body: int) -> int:
    """Return the joint that moves a body, or WORLD. The frames of one beam have one joint."""
    link = WORLD if body == WORLD else top.body_links[body]
    return WORLD if link == WORLD else top.links[link].joint


def _new_pairs(model: Model, geoms: Geoms) -> list[tuple[int, int]]:
    """Return the pairs of the last geom with others, the geom of the earlier kind first."""
    top, last = model.topology, len(geoms.names) - 1

    def collider(g: int) -> Collider:
        body = geoms.bodies[g]
        joint = _moving(top, body)
        above = WORLD if joint == WORLD else _moving(top, top.body_parents[top.joint_bodies[joint]])
        return Collider(
            geoms.types[g], geoms.contype[g], geoms.conaffinity[g], body, joint,
            None if above == WORLD else above, joint == WORLD,
        )  # fmt: skip

    new = collider(last)
    others = [g for g in range(last) if may_touch(collider(g), new, geoms.excluded)]
    return [in_order(geoms.types, g, last) for g in others]


def _supported(
    geoms: Geoms, pairs: tuple[tuple[int, int], ...], explicit: int
) -> tuple[tuple[int, int], ...]:
    """Return the pairs that have a narrow phase. Warn of new pairs that have none."""
    kept = tuple(
        pair for k, pair in enumerate(pairs) if k < explicit or PairKind.of(geoms, pair).supported
    )
    last = len(geoms.names) - 1
    missing = [geoms.names[a if b == last else b] for a, b in {*pairs} - {*kept} if last in (a, b)]
    if missing:
        warnings.warn(
            f"contact.with_geom: {geoms.types[last]} {geoms.names[last]!r} has no narrow phase "
            f"with {sorted(missing)}; rb.contact.pairs() lists the pairs of kinds that have one",
            stacklevel=3,
        )
    return kept
