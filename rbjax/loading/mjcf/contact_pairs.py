"""Pairs of geoms that may touch, by the rules of MuJoCo."""

from __future__ import annotations

import itertools

import mujoco


def contact_pairs(m: mujoco.MjModel) -> tuple[tuple[int, int], ...]:
    """Return the pairs of geoms that may collide, the geom of the earlier type first.

    The pairs of `<pair>` come first, as often as the file gives them. All other pairs need matching
    masks. Excluded are geoms of one rigid body, of two bodies that no joint moves, such as a mocap
    body and the world, of a body and its parent unless the parent is fixed, and the pairs of
    `<exclude>`. (MuJoCo, *Computation*, "Collision detection".)
    """
    off, bit = m.opt.disableflags, mujoco.mjtDisableBit
    if off & (bit.mjDSBL_CONTACT | bit.mjDSBL_CONSTRAINT):
        return ()
    explicit = zip(m.pair_geom1.tolist(), m.pair_geom2.tolist(), strict=True)
    named = [_in_order(m, a, b) for a, b in explicit]
    excluded = {(int(s) >> 16, int(s) & 0xFFFF) for s in m.exclude_signature}
    body, weld = m.geom_bodyid, m.body_weldid
    moves = m.body_treeid[body] >= 0
    parent = weld[m.body_parentid[weld]]
    filtered = not off & bit.mjDSBL_FILTERPARENT
    types, affinities = m.geom_contype, m.geom_conaffinity

    def may_touch(a: int, b: int) -> bool:
        masks = types[a] & affinities[b] | types[b] & affinities[a]
        i, j = weld[body[a]], weld[body[b]]
        if not masks or i == j or not (moves[a] or moves[b]):
            return False
        if filtered and i and j and (parent[i] == j or parent[j] == i):
            return False
        return not excluded & {(body[a], body[b]), (body[b], body[a])}

    every = itertools.combinations(range(m.ngeom), 2)
    others = (_in_order(m, a, b) for a, b in every if may_touch(a, b))
    known = set(named)
    return (*named, *(pair for pair in others if pair not in known))


def _in_order(m: mujoco.MjModel, a: int, b: int) -> tuple[int, int]:
    """Return a pair of geoms in the order of their kinds, then of their indices."""
    kinds = m.geom_type
    return (a, b) if (kinds[a], a) <= (kinds[b], b) else (b, a)
