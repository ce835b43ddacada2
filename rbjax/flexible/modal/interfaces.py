"""Interfaces: sets of nodes whose averaged rigid motion is the motion of a frame.

The motion of an interface is the rigid motion r = [rotation; translation] about its position that
fits the displacements of its nodes in the sense of least squares, r = B u with

    B = (R^T W R)^-1 R^T W,   R = the rigid motions of the nodes

Its transpose distributes a wrench over the nodes without stiffening them. A joint on averaged nodes
transmits all six components, which one node of a solid cannot (Zwölfer & Gerstmayr, MSD 2020).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.flexible.modal.finite_elements import FiniteElements


@displayed
@dataclass(frozen=True)
class Interface:
    """A set of nodes to which a joint, a child or a force is attached.

    Fields:
        name: name of the frame.
        nodes: indices of the nodes. A solid needs three nodes at least that are not on one line.
        position: position of the frame (3,), m; None for the mean of the nodes.

    Example:
        >>> from rbjax.flexible.modal import Interface
        >>> Interface("tip", [20]).nodes
        [20]
    """

    name: str
    nodes: Sequence[int]
    position: Any = None


def frame_position(elements: FiniteElements, at: Interface) -> np.ndarray:
    """Return the position (3,) of the frame of an interface."""
    if at.position is None:
        return elements.positions[np.asarray(at.nodes)].mean(0)
    return np.asarray(at.position, float)


def rigid_motion(elements: FiniteElements, at: Interface) -> np.ndarray:
    """Return B (6, N), which maps displacements to the averaged rigid motion of an interface."""
    step, nodes = elements.per_node, np.asarray(at.nodes)
    rows = (nodes[:, None] * step + np.arange(step)).ravel()
    about = frame_position(elements, at)
    R = elements.rigid_modes(about)[rows]
    spread = elements.positions[nodes] - elements.positions[nodes].mean(0)
    size = np.sqrt((spread**2).sum(1).mean()) or 1.0
    weight = np.ones((len(nodes), step))
    weight[:, 3:] = size**2
    scaled = R * np.array([1 / size] * 3 + [1.0] * 3)
    normal = scaled.T @ (scaled * weight.ravel()[:, None])
    values = np.linalg.eigvalsh(normal)
    if values[0] < 1e-9 * values[-1]:
        what = "is one node" if len(nodes) == 1 else f"has {len(nodes)} nodes on one line"
        raise InputError(
            f"interface {at.name!r} {what}, whose coordinates are displacements only: its rotation "
            "is not determined; give three nodes at least that are not on one line"
        )
    B = np.zeros((6, elements.M.shape[0]))
    B[:, rows] = np.linalg.solve(normal, (scaled * weight.ravel()[:, None]).T)
    B[:3] /= size
    return B


def check_interfaces(elements: FiniteElements, interfaces: Sequence[Interface]) -> None:
    """Raise `InputError` if a name or a node is used twice, or a node does not exist."""
    n, names = len(elements.positions), set()
    owner: dict[int, str] = {}
    for at in interfaces:
        nodes = np.asarray(at.nodes)
        if at.name in names:
            raise InputError(f"interface {at.name!r} is given twice; give each its own name")
        names.add(at.name)
        if nodes.ndim != 1 or nodes.size == 0 or nodes.dtype.kind not in "iu":
            raise InputError(
                f"interface {at.name!r}: nodes are {at.nodes!r}, expected indices of nodes, one at "
                "least"
            )
        if nodes.min() < 0 or nodes.max() >= n:
            wrong = nodes[(nodes < 0) | (nodes >= n)][0]
            raise InputError(
                f"interface {at.name!r}: there is no node {wrong}; the mesh has the nodes 0 to "
                f"{n - 1}"
            )
        for k in nodes.tolist():
            if k in owner:
                twice = "twice" if owner[k] == at.name else f"and interface {owner[k]!r}"
                raise InputError(
                    f"interface {at.name!r} has node {k} {twice}: its motion would be prescribed "
                    "by two conditions; give each node to one interface, once"
                )
            owner[k] = at.name
        if at.position is not None and np.shape(at.position) != (3,):
            raise InputError(
                f"interface {at.name!r}: the position has the shape {np.shape(at.position)}, "
                "expected (3,)"
            )
