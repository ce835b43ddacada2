"""Pairs of geoms of a file that may touch."""

from __future__ import annotations

import itertools

import mujoco

from rbjax.contact.geometry.pair_filter import Collider, in_order, may_touch


def contact_pairs(m: mujoco.MjModel) -> tuple[tuple[int, int], ...]:
    """Return the pairs of geoms that may collide, the geom of the earlier type first.

    The pairs of `<pair>` come first, as often as the file gives them. The others are the pairs
    for which `may_touch` is true.
    """
    if m.opt.disableflags & (_Off.mjDSBL_CONTACT | _Off.mjDSBL_CONSTRAINT):
        return ()
    kinds, geoms, excluded = kinds_of(m), _colliders(m), {*excluded_bodies(m)}
    explicit = zip(m.pair_geom1.tolist(), m.pair_geom2.tolist(), strict=True)
    named = [in_order(kinds, a, b) for a, b in explicit]
    others = (
        in_order(kinds, a, b)
        for a, b in itertools.combinations(range(m.ngeom), 2)
        if may_touch(geoms[a], geoms[b], excluded)
    )
    known = set(named)
    return (*named, *(pair for pair in others if pair not in known))


def kinds_of(m: mujoco.MjModel) -> tuple[str, ...]:
    """Return the kind of each geom, such as "box"."""
    return tuple(mujoco.mjtGeom(int(t)).name[7:].lower() for t in m.geom_type)


def excluded_bodies(m: mujoco.MjModel) -> tuple[tuple[int, int], ...]:
    """Return the pairs of bodies of `<exclude>`, -1 for the world, the lesser index first."""
    pairs = ((int(s) >> 16, int(s) & 0xFFFF) for s in m.exclude_signature)
    return tuple((min(pair) - 1, max(pair) - 1) for pair in pairs)


_Off = mujoco.mjtDisableBit


def _colliders(m: mujoco.MjModel) -> list[Collider]:
    """Return the geoms as the rules read them. A mocap body is an assembly that no joint moves."""
    body, assembly = m.geom_bodyid, m.body_weldid
    filtered = not m.opt.disableflags & _Off.mjDSBL_FILTERPARENT
    above = assembly[m.body_parentid[assembly]]
    columns = (
        m.geom_contype, m.geom_conaffinity, body - 1, assembly[body], above[body],
        m.body_treeid[body] < 0,
    )  # fmt: skip
    rows = zip(kinds_of(m), *(x.tolist() for x in columns), strict=True)
    return [
        Collider(kind, contype, affinity, b, own, parent if parent and filtered else None, fixed)
        for kind, contype, affinity, b, own, parent, fixed in rows
    ]
