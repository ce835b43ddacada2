"""The leaves from which the link constants follow, and the entries that `Model.fix_zeros` fixes."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

from rbjax.model.cells import declared, literals
from rbjax.model.record import Record

#: the leaves of bodies and joints from which, with gravity, the link constants follow
_CONSTANTS = (
    "mass", "com", "inertia", "position", "orientation",
    "placement", "axis", "reference", "armature", "params",
)  # fmt: skip


def constant_leaves(model: Any) -> dict[str, Any]:
    """The leaves from which the link constants follow."""
    leaves = _fields(model.bodies) | _fields(model.joints)
    return {name: leaves[name] for name in _CONSTANTS} | {"gravity": model.gravity}


def with_fixed_entries(changes: dict[str, Any], zeros: dict[str, tuple]) -> dict[str, Any]:
    """The changed leaves, whose fixed entries have their fixed values."""

    def record(r: Record) -> Record:
        given = {n: x for n, x in _fields(r).items() if n in zeros}
        return dataclasses.replace(r, **{n: declared(x, zeros[n]) for n, x in given.items()})

    out: dict[str, Any] = {n: record(changes[n]) for n in ("bodies", "joints") if n in changes}
    if "gravity" in changes:
        out["gravity"] = declared(changes["gravity"], zeros["gravity"])
    return out


def _fields(record: Record) -> dict[str, jax.Array]:
    return {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}


def known_entries(model: Any) -> tuple[tuple[str, tuple[float | None, ...]], ...]:
    """For each leaf, its entries that are zero (or one, of axes and attitudes), else None."""
    leaves = constant_leaves(model)
    return tuple(
        (
            name,
            (None,) * x.size  # of what is traced nothing is known
            if isinstance(x, jax.core.Tracer)
            else literals(x, units=name in ("axis", "orientation")),
        )
        for name, x in leaves.items()
    )
