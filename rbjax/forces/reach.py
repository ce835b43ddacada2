"""Lengths and moment arms: of a transmission, of a tendon, and of forces between two frames.

    l = l(q),      l' = sum of r_n v_n,      tau_n = r_n f
l is the length and r_n the moment arm of dof n. A straight piece of a tendon with the direction e
pulls its two ends along one line, so the moment arm of a hinge with the axis z at p_n is

    r_n = z . ((p - p_n) x e)
with p any point of the line. Joints that carry both ends have no moment arm, except a flexible link
that carries them at different frames.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from rbjax.dynamics.algorithms.kinematics import LinkMotion
from rbjax.forces.context import Context, FrameState
from rbjax.lanes import Lane, Vec3, add, mul, total
from rbjax.model import WORLD, Topology
from rbjax.rotations.coefficients import where

#: moment arms by dof
Arms = dict[int, Lane]


class Reach(NamedTuple):
    """A length and its moment arms.

    length: m of a length in space, or the unit of its joint coordinates.
    arms: the derivative of the length by dof, without structural zeros.
    """

    length: Lane
    arms: Arms

    def speed(self, context: Context) -> Lane:
        """Compute the rate l' of the length."""
        return total(mul(arm, context.v[n]) for n, arm in self.arms.items())

    def scaled(self, gear: Lane) -> Reach:
        """Multiply the length and the moment arms by a gear ratio."""
        return Reach(mul(gear, self.length), {n: mul(gear, arm) for n, arm in self.arms.items()})


class Piece(NamedTuple):
    """A straight piece of a tendon from link `start` to link `end`.

    point: a point of its line, in the world.
    pull: its direction from start to end, divided by the divisor of its pulley.
    bodies: the bodies of its two ends.
    """

    start: int
    end: int
    point: Vec3
    pull: Vec3
    bodies: tuple[int, int]


def arms_between(
    context: Context, site: FrameState, base: FrameState, force: Vec3, torque: Vec3
) -> Arms:
    """Compute the moment arms of a force and torque (world axes) on `site` and of their reaction on
    `base`."""
    action, reaction = site.world_arms(force, torque), base.world_arms(-force, -torque)
    return opposed_arms(action, reaction, flexible_dofs(context.model.topology, site, base))


def opposed_arms(a: Arms, b: Arms, flexible: Container[int] = ()) -> Arms:
    """Return the moment arms of an action and of its reaction. Joints that carry both ends have
    none, except the coordinates `flexible` of a flexible link between the ends."""
    out = {n: arm for n, arm in (a | b).items() if (n in a) != (n in b)}
    return out | {n: add(a[n], b[n]) for n in a if n in b and n in flexible}


def flexible_dofs(top: Topology, site: FrameState, base: FrameState) -> set[int]:
    """Return the coordinates of flexible links that have a frame on the path between two frames."""
    one, other = (set() if x.link == WORLD else {*top.ancestors[x.link]} for x in (site, base))
    return {n for link in one ^ other if link >= top.nv for n in top.links[link].v}


def add_arms(a: Arms, b: Arms) -> Arms:
    """Add two sets of moment arms."""
    return {n: add(a.get(n, 0.0), b.get(n, 0.0)) for n in a | b}


def arms_of_pieces(links: LinkMotion, pieces: Sequence[Piece]) -> Arms:
    """Compute the moment arms of straight pieces. The pieces that a dof carries at one end only are
    summed before they are multiplied by its axis."""
    summed: dict[tuple, tuple[Vec3, Vec3, Vec3]] = {}
    out: Arms = {}
    for n, crossing in _crossings(links, pieces).items():
        if crossing not in summed:
            summed[crossing] = _sum(pieces, crossing)
        point, force, moment = summed[crossing]
        pose = links.pose(n)
        moment = moment + (point - pose.p).cross(force)
        for dof, S in links.axes(n):
            arm = add((pose.R @ S.ang).dot(moment), (pose.R @ S.lin).dot(force))
            out[dof] = add(out[dof], arm) if dof in out else arm
    return out


def _crossings(links: LinkMotion, pieces: Iterable[Piece]) -> dict[int, tuple]:
    """Return, by link, the pieces that act on it, as pairs (index, True if it moves the end).
    A piece acts on a link if the link carries one of its two ends, but not both."""
    ancestors = links.driver.topology.ancestors
    out: dict[int, tuple] = {}
    for k, piece in enumerate(pieces):
        a, b = (() if x == WORLD else ancestors[x] for x in (piece.start, piece.end))
        for n in (*a, *b):
            if (n in a) != (n in b):
                out[n] = (*out.get(n, ()), (k, n in b))
    return out


def _sum(pieces: Sequence[Piece], crossing: tuple) -> tuple[Vec3, Vec3, Vec3]:
    """Sum the pulls of pieces on a dof. Return a point, the force, and the moment about the point,
    in world axes.
    crossing: pairs (index of a piece, True if the dof moves the piece's end and not its start)."""
    (first, ends), *others = crossing
    point, force, moment = pieces[first].point, pieces[first].pull, Vec3.zero()
    force = force if ends else -force
    for k, ends in others:
        pull = pieces[k].pull if ends else -pieces[k].pull
        force, moment = force + pull, moment + (pieces[k].point - point).cross(pull)
    return point, force, moment


def distance(line: Vec3, dtype: Any) -> tuple[Lane, Lane]:
    """Compute the length of a vector and its inverse; the inverse of 0 is set to 1."""
    square = jnp.asarray(line.dot(line), dtype)
    some = square > 0
    root = jnp.sqrt(where(some, square, jnp.ones_like(square)))
    return where(some, root, jnp.zeros_like(square)), 1 / root
