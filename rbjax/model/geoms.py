"""The geometry of a robot: shapes fixed to its bodies."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

from rbjax.arguments import shown
from rbjax.errors import InputError, listed
from rbjax.model.hulls import Hull
from rbjax.model.record import Record, check_least
from rbjax.model.solver_parameters import SOLIMP, SOLREF
from rbjax.model.topology import WORLD

#: kind of a geom -> the number of entries of its size that must be positive
SIZES = {"sphere": 1, "capsule": 1, "cylinder": 2, "ellipsoid": 3, "box": 3}
#: defaults of parameters that geoms and explicit pairs share
PARAMETERS: Mapping[str, Any] = {"solref": SOLREF, "solimp": SOLIMP, "margin": 0.0, "gap": 0.0}
#: leaf with a row for each geom -> MuJoCo's default
LEAVES: Mapping[str, Any] = {"friction": (1.0, 0.005, 0.0001), "solmix": 1.0, **PARAMETERS}
#: static field with a number for each geom -> MuJoCo's default
NUMBERS: Mapping[str, Any] = {
    "contype": 1, "conaffinity": 1, "condim": 3, "priority": 0, "group": 0
}  # fmt: skip
#: MuJoCo's default colour
RGBA = (0.5, 0.5, 0.5, 1.0)
#: static fields with an entry for each geom
OF_EACH_GEOM = ("names", "types", "bodies", *NUMBERS, "rgba")


class Geoms(Record):
    """Shapes fixed to bodies, with the parameters of MuJoCo's geoms.

    `rb.contact.detect` computes their contacts. No contact force acts on them.

    Fields:
        size: (ng, 3) m. Radius of a sphere; radius and half length of a capsule or cylinder;
            semi-axes of an ellipsoid; half sides of a box; half sides of a plane, 0 if it is
            infinite; half sides of the bounding box of a mesh; half sides along x and y of a height
            field.
        position: (ng, 3) m, in the frame of the body.
        orientation: (ng, 4) quaternion, in the frame of the body.
        friction: (ng, 3) sliding, torsional (m) and rolling (m).
        solref: (ng, 2) reference of the contact, as in MuJoCo.
        solimp: (ng, 5) impedance of the contact, as in MuJoCo.
        margin: (ng,) m. A contact acts below the sum of the margins of both geoms.
        gap: (ng,) m. A contact exists below the sum of the margins and gaps of both geoms.
        solmix: (ng,) weight of the solref and solimp of this geom in those of a contact.
        pair_friction: (n, 5) sliding (2), torsional (m) and rolling (2, m) of explicit pairs.
        pair_solref, pair_solreffriction: (n, 2) references, normal and tangential; zero for the
            tangents means that they have the reference of the normal.
        pair_solimp: (n, 5) impedance.
        pair_margin, pair_gap: (n,) m, in place of the sums.
        heights: (rows, columns) m, of each height field. Rows are along y, columns along x.
        names, types: of each geom; a type is a name of MuJoCo, such as "box"; static.
        bodies: the body of each geom, -1 for the world; static.
        contype, conaffinity: bit masks of the pairs that may collide; static.
        condim, priority, group: as in MuJoCo; static.
        rgba: colour and opacity; static.
        pairs: the pairs of geoms that may touch by the rules of the file; static. The first n are
            explicit: they have parameters of their own.
        pair_condim: (n) condim of the explicit pairs; static.
        excluded: the pairs of bodies of `<exclude>`, whose geoms do not touch, the lesser index
            first; `rb.contact.with_geom` reads it; static.
        hulls: the convex hull of each mesh that may touch a plane, else None; static.
        fields: the index in `heights` of each height field, -1 of other geoms; static.
    """

    size: jax.Array
    position: jax.Array
    orientation: jax.Array
    friction: jax.Array
    solref: jax.Array
    solimp: jax.Array
    margin: jax.Array
    gap: jax.Array
    solmix: jax.Array
    pair_friction: jax.Array
    pair_solref: jax.Array
    pair_solreffriction: jax.Array
    pair_solimp: jax.Array
    pair_margin: jax.Array
    pair_gap: jax.Array
    heights: tuple[jax.Array, ...]
    names: tuple[str, ...] = eqx.field(static=True)
    types: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[int, ...] = eqx.field(static=True)
    contype: tuple[int, ...] = eqx.field(static=True)
    conaffinity: tuple[int, ...] = eqx.field(static=True)
    condim: tuple[int, ...] = eqx.field(static=True)
    priority: tuple[int, ...] = eqx.field(static=True)
    group: tuple[int, ...] = eqx.field(static=True)
    rgba: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())
    pair_condim: tuple[int, ...] = eqx.field(static=True, default=())
    excluded: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())
    hulls: tuple[Hull | None, ...] = eqx.field(static=True, default=())
    fields: tuple[int, ...] = eqx.field(static=True, default=())

    def replace(self, **changes: Any) -> Geoms:
        """Return a copy with the given fields changed. Arrays must keep their shapes.

        Raises:
            InputError: a number is not finite, a geom that may touch has no size, a friction is
                negative, a condim is not 1, 3, 4 or 6, or a pair is not two geoms.

        A `solref` of mixed signs is a warning. It counts as MuJoCo's default (0.02, 1).
        """
        new = super().replace(**changes)
        _check_names_and_pairs(new, changes)
        touching = sorted({i for pair in new.pairs for i in pair})
        for field in changes.keys() & {"friction", "pair_friction"}:
            check_least(f"Geoms.replace({field}=...)", getattr(new, field))
        filters = changes.keys() & {"contype", "conaffinity", "excluded"}
        if filters and "pairs" not in changes:
            raise InputError(
                f"Geoms.replace({min(filters)}=...): the pairs that may touch stay as they are, "
                "so that it would have no effect; replace pairs=, too"
            )
        sized = changes.keys() & {"size", "types", "pairs"}
        if sized and not isinstance(new.size, jax.core.Tracer):
            _check_sizes(new, touching)
        for field in ("solref", "pair_solref", "pair_solreffriction"):
            given = getattr(new, field)
            if field in changes and not isinstance(given, jax.core.Tracer):
                _warn_of_mixed_signs(new, field, np.asarray(given), touching)
        return new


def _check_names_and_pairs(geoms: Geoms, changes: Mapping[str, Any]) -> None:
    """Raise InputError if a changed static field does not fit the number of geoms, or has a wrong
    condim or pair."""
    n, pairs = len(geoms.size), len(geoms.pairs)
    for field in changes.keys() & {*OF_EACH_GEOM, "pair_condim"}:
        given = getattr(geoms, field)
        due = len(geoms.pair_friction) if field == "pair_condim" else n
        if not isinstance(given, tuple) or len(given) != due:
            raise InputError(
                f"Geoms.replace({field}=...): got {shown(given)}, expected a tuple of {due} entries"
            )
        if field == "bodies" and not all(type(b) is int and b >= WORLD for b in given):
            raise InputError(
                f"Geoms.replace(bodies=...): got {shown(given)}, expected indices of bodies as "
                f"integers of Python, and {WORLD} for the world"
            )
        if field in ("condim", "pair_condim") and not set(given) <= {1, 3, 4, 6}:
            raise InputError(
                f"Geoms.replace({field}=...): got {given}, expected 1, 3, 4 or 6 of each"
            )
    if "pairs" in changes:
        for pair in geoms.pairs:
            known = isinstance(pair, tuple) and len(pair) == 2 and set(pair) <= set(range(n))
            if not known or pair[0] == pair[1]:
                raise InputError(
                    f"Geoms.replace(pairs=...): got {shown(pair)}, expected the indices (0 to "
                    f"{n - 1}) of two different geoms"
                )
        if pairs < len(geoms.pair_condim):
            raise InputError(
                f"Geoms.replace(pairs=...): got {pairs} pairs, expected the "
                f"{len(geoms.pair_condim)} explicit ones of the file first; replace their fields, "
                "pair_condim, pair_friction and others, too"
            )


def check_bodies(geoms: Geoms | None, count: int) -> None:
    """Raise InputError if a geom is on a body that a model with `count` bodies does not have."""
    largest = max(geoms.bodies, default=WORLD) if geoms is not None else WORLD
    if largest >= count:
        raise InputError(
            f"Model.replace(geoms=...): got a geom on body {largest}, expected the {WORLD} of the "
            f"world, or the index of one of {count} bodies"
        )


def _check_sizes(geoms: Geoms, touching: list[int]) -> None:
    """Raise InputError if a geom that may touch has no size."""
    sizes = np.asarray(geoms.size)
    for i in touching:
        own = sizes[i, : SIZES.get(geoms.types[i], 0)]
        if not (own > 0).all():
            raise InputError(
                f"Geoms.replace(size=...): the size of the {geoms.types[i]} {geoms.names[i]!r} is "
                f"{own.tolist()}, expected numbers above zero; leave a geom out of contact by "
                "replace(pairs=...) without its pairs, or by model.replace(contact=None)"
            )


def _warn_of_mixed_signs(geoms: Geoms, field: str, given: np.ndarray, touching: list[int]) -> None:
    """Warn of rows with one positive number."""
    mixed = np.flatnonzero((given[:, 0] > 0) != (given[:, 1] > 0)).tolist()
    if field == "solref":
        names = [geoms.names[i] for i in mixed if i in touching]
    else:
        names = [" and ".join(geoms.names[i] for i in geoms.pairs[k]) for k in mixed]
    if names:
        warnings.warn(
            f"Geoms.replace({field}=...): mixed signs of {listed(names)}; they count as "
            "(0.02, 1). Give (time constant, damping ratio), both above zero, or (-stiffness, "
            "-damping), neither above zero",
            stacklevel=3,
        )
