"""Flexible links of a picture: beams as swept tubes, other links as lines between their frames.

A flexible link has stations, which follow the bodies of the model in all arrays of poses: its base,
and points along a beam, or the frames of another link. The section of a beam is drawn as an ellipse
whose semi-axes follow from the rotary inertia: a_y^2 = 4 J_z / m and a_z^2 = 4 J_y / m, m per
length. Without rotary inertia they follow from the stiffness, a^2 = 4 EI / EA. Very thin and very
thick sections are limited to 1/160 and 1/8 of the length, to be visible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.flexible import BeamElasticity
from rbjax.flexible.strain import StrainBeam
from rbjax.joints.flexible import Flexible
from rbjax.lanes import quaternion_matrix
from rbjax.model import WORLD, Model
from rbjax.plotting.solid_shapes import Solid, sphere
from rbjax.style import PALETTE, rgb

Array = np.ndarray
Color = tuple[float, float, float]
#: the number of segments of one beam, and the least number if there are many beams
_SEGMENTS, _FEWEST = 48, 8
#: limits of a semi-axis, and the radius of the lines of other links, relative to the length
_THIN, _THICK, _LINE = 1 / 160, 1 / 8, 1 / 80
_RING = np.linspace(0, 2 * np.pi, 16, endpoint=False)


@dataclass(frozen=True)
class FlexibleLink:
    """A flexible link as it is drawn."""

    joint: Flexible  # the kind of joint of the model
    kind: Flexible  # the same kind. A beam has further frames along its line.
    #: the indices of the frames that are stations; the base is a station before them
    chosen: tuple[int, ...]
    body: int  # of the joint
    parent: int  # the body that carries the base
    coordinates: slice  # its entries of q
    params: tuple[float, ...]  # the parameters of the kind
    lines: tuple[tuple[int, int], ...]  # pairs of stations that are joined
    axes: Array  # (stations, 2), semi-axes of the section along y and z, m

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Compute rotations (T, n, 3, 3) and positions (T, n, 3) of the stations in the base frame,
        from the coordinates q (T, coordinates) of the link."""
        R, p = _frames(self.kind, q, self.params)
        chosen = list(self.chosen)
        R, p = R[:, chosen], p[:, chosen]
        base = np.broadcast_to(np.eye(3), (len(q), 1, 3, 3))
        return np.concatenate([base, R], 1), np.concatenate([np.zeros((len(q), 1, 3)), p], 1)

    def at_rest(self) -> tuple[Array, Array]:
        """Return rotations (n, 3, 3) and positions (n, 3) of the frames of the joint in the base
        frame at zero coordinates."""
        R, p = _frames(self.joint, np.zeros((1, self.joint.coordinates)), self.params)
        return R[0], p[0]


def flexible_links(model: Model) -> list[FlexibleLink]:
    """Return the flexible links of a model, in the order of their joints."""
    top, at, out = model.topology, 0, []
    beams = sum(isinstance(joint, StrainBeam) for joint in top.joints)
    for j, joint in enumerate(top.joints):
        count = len(joint.defaults)
        if isinstance(joint, Flexible):
            params = tuple(np.asarray(model.joints.params[at : at + count], float).tolist())
            body = top.joint_bodies[j]
            own = body, top.body_parents[body], model.q_slice(top.joint_names[j]), params
            if isinstance(joint, StrainBeam):
                segments = max(_FEWEST, _SEGMENTS // beams)
                out.append(
                    _beam(
                        joint,
                        *own,
                        segments,
                        _stiffness(model, top.joint_names[j], joint.shape.tapered),
                    )
                )
            else:
                out.append(_lines(joint, *own))
        at += count
    return out


def station_poses(model: Model, R: Array, p: Array, q: Array) -> tuple[Array, Array]:
    """Append the stations of the flexible links to the rotations R (T, nb, 3, 3) and positions p
    (T, nb, 3) of the bodies at q (T, nq)."""
    turns, places = [R], [p]
    bodies = model.bodies
    for link in flexible_links(model):
        own_R, own_p = link.poses(q[:, link.coordinates])
        turn = quaternion_matrix(*np.asarray(bodies.orientation[link.body], float))
        base_R = np.reshape([*turn], (3, 3))
        base_p = np.asarray(bodies.position[link.body], float)
        if link.parent != WORLD:
            base_p = p[:, link.parent] + R[:, link.parent] @ base_p
            base_R = R[:, link.parent] @ base_R
        else:
            base_R, base_p = np.tile(base_R, (len(q), 1, 1)), np.tile(base_p, (len(q), 1))
        turns.append(base_R[:, None] @ own_R)
        places.append(base_p[:, None] + np.einsum("tij,tnj->tni", base_R, own_p))
    return np.concatenate(turns, 1), np.concatenate(places, 1)


def tubes(model: Model, colors: Sequence[Color] | None = None) -> list[Solid]:
    """Make the solids of the flexible links: one between each pair of joined stations.

    colors: of each body; None for a colour of the palette for each series of links.
    """
    first, out = model.nb, []
    series: dict[int, int] = {}
    for link in flexible_links(model):
        k = series.get(link.parent, len({*series.values()}))
        series[link.body] = k
        color = rgb(PALETTE[k % len(PALETTE)]) if colors is None else colors[link.body]
        if isinstance(link.kind, StrainBeam):
            ends = [_ring(*axes) for axes in link.axes]
        else:
            ends = [sphere(axes[0]) for axes in link.axes]
        for a, b in link.lines:
            both = np.concatenate([ends[a], ends[b]])
            out.append(Solid(both, first + a, color, 1.0, first + b))
        first += len(link.axes)
    return out


def _ring(y: float, z: float) -> Array:
    """Return points (n, 3) of an ellipse about x."""
    return np.stack([0 * _RING, y * np.cos(_RING), z * np.sin(_RING)], -1)


def _frames(kind: Flexible, q: Array, params: Sequence[float]) -> tuple[Array, Array]:
    """Compute rotations (T, frames, 3, 3) and positions (T, frames, 3) in the base frame."""
    coordinates = list(np.asarray(q, float).T)
    if isinstance(kind, StrainBeam):
        found: Any = [(T.R, T.p) for T in kind.poses(coordinates, params)]
    else:
        still = [0.0] * kind.coordinates
        found = [(m.J, m.at) for m in kind.frames(coordinates, still, params)]

    def stacked(lanes: Any) -> Array:
        return np.stack([np.broadcast_to(np.asarray(x, float), len(q)) for x in lanes], -1)

    R = [stacked(R).reshape(-1, 3, 3) for R, _ in found]
    return np.stack(R, 1), np.stack([stacked(p) for _, p in found], 1)


def _beam(
    joint: StrainBeam,
    body: int,
    parent: int,
    coordinates: slice,
    params: tuple[float, ...],
    segments: int,
    stiffness: Array | None,
) -> FlexibleLink:
    places = tuple((np.arange(1, segments) / segments).tolist())
    fine = StrainBeam(joint.shape._replace(places=places))  # not registered: only for its poses
    chosen = (*range(joint.tip + 1, joint.tip + segments), joint.tip)
    given = joint.named(params)
    (length,) = given["length"]
    mass = np.reshape(given["mass_per_length"], (-1, 1))
    around, *inertia = np.reshape(given["rotary_inertia"], (-1, 3)).T
    both = np.stack(inertia[::-1], -1)  # J_z has the extent along y
    both = np.where(both > 0, both, np.maximum(around[:, None], 0.0) / 2)
    square = 4 * both / np.where(mass > 0, mass, 1.0)
    if stiffness is not None:
        square = np.where(square > 0, square, stiffness)
    axes = np.clip(np.sqrt(square), _THIN * length, _THICK * length)
    at = np.linspace(0, 1, segments + 1)
    nodes = joint.nodes if len(axes) > 1 else [0.5]
    radii = np.stack([np.interp(at, nodes, x) for x in axes.T], -1)
    lines = tuple((k, k + 1) for k in range(segments))
    return FlexibleLink(joint, fine, chosen, body, parent, coordinates, params, lines, radii)


def _stiffness(model: Model, name: str, tapered: bool) -> Array | None:
    """Return 4 EI / EA about z and y, (1 or points, 2), of a beam; None if it has no stiffness."""
    for force in model.forces:
        if isinstance(force, BeamElasticity) and force.joint == name:
            C = np.asarray(force.stiffness, float)
            C = np.diagonal(C, axis1=-2, axis2=-1) if C.ndim == 2 + tapered else C
            C = C.reshape(-1, 6)
            axial = C[:, 3:4]
            return np.where(axial > 0, 4 * C[:, [2, 1]] / np.where(axial > 0, axial, 1.0), 0.0)
    return None


def _lines(
    joint: Flexible, body: int, parent: int, coordinates: slice, params: tuple[float, ...]
) -> FlexibleLink:
    """Join the frames of a link and its base by the shortest lines that connect all of them."""
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial.distance import cdist

    _, p = _frames(joint, np.zeros((1, joint.coordinates)), params)
    points = np.concatenate([np.zeros((1, 3)), p[0]])
    apart = cdist(points, points)
    pairs = np.argwhere(minimum_spanning_tree(apart).toarray() > 0).tolist()
    axes = np.full((len(points), 2), _LINE * (apart.max() or 1.0))
    lines = tuple((a, b) for a, b in pairs)
    return FlexibleLink(
        joint, joint, tuple(range(joint.count)), body, parent, coordinates, params, lines, axes
    )
