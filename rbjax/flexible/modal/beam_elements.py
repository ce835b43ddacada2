"""Frames of straight beam elements in space, with consistent mass.

Two-node elements of Euler-Bernoulli or Timoshenko beams. The shape functions are those of the
static deflection of a uniform element with the shear number Phi = 12 EI / (GA L^2), so that shear
does not lock (Przemieniecki, *Theory of Matrix Structural Analysis*, 1968; Friedman & Kosmatka,
Computers & Structures 47(3), 1993). With s from 0 to 1:

    v = [1 - 3 s^2 + 2 s^3 + Phi (1 - s), L (s - 2 s^2 + s^3 + Phi (s - s^2) / 2), ...] / (1 + Phi)

Sections vary linearly along an element. The axial force stiffens an element by int N (v'^2 + w'^2).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from rbjax.arguments import instance, real_array
from rbjax.errors import InputError
from rbjax.flexible.cross_section import Section
from rbjax.flexible.modal.finite_elements import (
    FiniteElements,
    block_diagonal,
    quadratic_form,
)

#: points of an element: products of two cubic functions and a linear section have degree 7
POINTS = 4


@dataclass(frozen=True, eq=False)
class BeamSection:
    """The section of a beam in its principal axes: x along the beam, y and z across.

    Use it for tapered beams, and for beams without shear. `rbjax.flexible.Section` has the others.

    Each field is a number, or an array with one number for each node (n,), or for both ends of each
    element (e, 2).

    Fields:
        EA: axial stiffness, N.
        EIy, EIz: bending stiffness about y and about z, N m^2.
        GJ: torsional stiffness, N m^2.
        mass: mass per length, kg/m.
        GAy, GAz: shear stiffness along y and z with the shear factor, N; None if rigid in shear.
        rotary: inertia per length about x, y and z, kg m.

    Example:
        >>> from rbjax.flexible.modal import BeamSection
        >>> BeamSection(EA=1e6, EIy=10.0, EIz=10.0, GJ=8.0, mass=[2.0, 1.5, 1.0]).rotary
        (0.0, 0.0, 0.0)
    """

    EA: Any
    EIy: Any
    EIz: Any
    GJ: Any
    mass: Any
    GAy: Any = None
    GAz: Any = None
    rotary: tuple[Any, Any, Any] = (0.0, 0.0, 0.0)


def beam_mesh(
    nodes: Any, section: BeamSection | Section, elements: Any = None, y_axis: Any = None
) -> FiniteElements:
    """Create a frame of beam elements.

    Args:
        nodes: (n, 3), m.
        section: the section of the elements; or a `rbjax.flexible.Section` whose stiffness is
            diagonal, for elements with shear.
        elements: indices of the nodes of each element (e, 2); None for a chain.
        y_axis: direction (3,) or (e, 3) whose part across an element is its y axis; None for the
            global axis that is the most perpendicular to each element.

    Returns:
        `FiniteElements`.

    Raises:
        InputError: shapes do not fit, an element has no length, or a stiffness is not positive.

    Source: Friedman & Kosmatka 1993.

    Example:
        >>> import numpy as np
        >>> from rbjax.flexible.modal import BeamSection, beam_mesh
        >>> bar = BeamSection(EA=1e6, EIy=10.0, EIz=10.0, GJ=8.0, mass=2.0)
        >>> beam_mesh(np.linspace([0, 0, 0], [1, 0, 0], 5), bar).M.shape
        (30, 30)
    """
    from scipy import sparse

    if isinstance(section, Section):
        section = _from_section(section)
    instance("beam_mesh", "section", section, BeamSection, "a BeamSection or a Section")
    x = real_array("beam_mesh", "nodes", nodes)
    if x.ndim != 2 or x.shape[1:] != (3,) or len(x) < 2:
        raise InputError(f"beam_mesh: nodes have the shape {x.shape}, expected (n, 3) with n >= 2")
    ends = (
        np.stack([np.arange(len(x) - 1), np.arange(1, len(x))], 1)
        if elements is None
        else np.asarray(elements)
    )
    if ends.ndim != 2 or ends.shape[1] != 2 or ends.min(initial=0) < 0 or ends.max() >= len(x):
        raise InputError(
            f"beam_mesh: elements have the shape {ends.shape} and indices up to {ends.max()}, "
            f"expected (e, 2) with indices from 0 to {len(x) - 1}"
        )
    along = x[ends[:, 1]] - x[ends[:, 0]]
    length = np.linalg.norm(along, axis=1)
    if not (length > 0).all():
        k = int(np.argmin(length))
        raise InputError(
            f"beam_mesh: element {k} from node {ends[k, 0]} to {ends[k, 1]} has no length"
        )
    R = _element_axes(along / length[:, None], y_axis)
    at = _values(section, ends, len(x))

    s, weight = np.polynomial.legendre.leggauss(POINTS)
    s, weight = (s + 1) / 2, weight / 2
    Phi = {
        a: _shear_number(at[f"EI{b}"], at[f"GA{a}"], length) for a, b in (("y", "z"), ("z", "y"))
    }
    e = len(ends)
    shape, turn, strain, slope = (np.zeros((e, POINTS, k, 12)) for k in (3, 3, 6, 2))
    for g, sg in enumerate(s):
        linear, rate = np.array([1 - sg, sg]), np.stack([-1 / length, 1 / length], 1)
        shape[:, g, 0, [0, 6]] = linear
        turn[:, g, 0, [3, 9]] = linear
        strain[:, g, 0, [3, 9]] = rate  # torsion
        strain[:, g, 3, [0, 6]] = rate
        # rotations about z bend the y direction; about y, with w' = -theta_y, the z direction
        for a, cols, rot, sign in ((1, (1, 5, 7, 11), 2, 1.0), (2, (2, 4, 8, 10), 1, -1.0)):
            v, dv, theta, bend = _hermite(sg, length, Phi["xyz"[a]])
            flip = np.array([1.0, sign, 1.0, sign])
            shape[:, g, a, cols] = v * flip
            slope[:, g, a - 1, cols] = dv * flip
            turn[:, g, rot, cols] = sign * theta * flip
            strain[:, g, rot, cols] = sign * bend * flip
            strain[:, g, 3 + a, cols] = (dv - theta) * flip

    along_s = np.stack([1 - s, s], 1)
    value = {k: np.einsum("gk,ek->eg", along_s, v) for k, v in at.items() if v is not None}
    none = np.zeros((e, POINTS))
    w = (length[:, None] * weight).ravel()
    stiff = np.stack(
        [
            value["GJ"],
            value["EIy"],
            value["EIz"],
            value["EA"],
            value.get("GAy", none),
            value.get("GAz", none),
        ],
        -1,
    )
    D, T, B, G = (
        _global(z, R, ends, len(x), vector)
        for z, vector in ((shape, True), (turn, True), (strain, False), (slope, False))
    )
    spin = np.stack([value["rotary0"], value["rotary1"], value["rotary2"]], -1)
    J = np.einsum("eba,egb,ebc->egac", R, spin, R).reshape(-1, 3, 3) * w[:, None, None]
    masses = value["mass"].ravel() * w
    M = quadratic_form(D, np.repeat(masses, 3)) + T.T @ block_diagonal(J) @ T
    K = quadratic_form(B, (stiff.reshape(-1, 6) * w[:, None]).ravel())
    places = np.einsum("gk,eka->ega", along_s, x[ends]).reshape(-1, 3)
    axial, EA = B[3::6], value["EA"].ravel()

    def prestress(u: np.ndarray) -> Any:
        return quadratic_form(G, np.repeat(EA * (axial @ u) * w, 2))

    return FiniteElements(x, sparse.csr_array(M), K, masses, places, D, T, J, prestress)


def _from_section(given: Section) -> BeamSection:
    """Convert a section of one beam, with its strains in the order k_x, k_y, k_z, e_x, g_y, g_z."""
    C = np.asarray(given.stiffness)
    if C.shape != (6, 6) or np.any(C * (1 - np.eye(6))) or given.eccentric:
        raise InputError(
            "beam_mesh: the section has a coupled or tapered stiffness, or its mass centre is off "
            "the line; expected one diagonal stiffness; give a BeamSection for a tapered beam"
        )
    GJ, EIy, EIz, EA, GAy, GAz = np.diagonal(C).tolist()
    return BeamSection(EA, EIy, EIz, GJ, given.mass, GAy, GAz, tuple(np.asarray(given.inertia)))


def _element_axes(t: np.ndarray, y_axis: Any) -> np.ndarray:
    """Return rotations (e, 3, 3) to element axes: rows x, y, z."""
    if y_axis is None:
        hint = np.eye(3)[np.argmin(np.abs(t).round(12)[:, [1, 2, 0]], axis=1)][:, [2, 0, 1]]
    else:
        hint = np.broadcast_to(np.asarray(y_axis, float), t.shape)
    y = hint - (hint * t).sum(1, keepdims=True) * t
    size = np.linalg.norm(y, axis=1, keepdims=True)
    if not (size > 1e-9).all():
        at = int(np.argmin(size))
        raise InputError(f"beam_mesh: y_axis is along element {at}, expected a direction across it")
    y = y / size
    return np.stack([t, y, np.cross(t, y)], 1)


def _values(section: BeamSection, ends: np.ndarray, n: int) -> dict[str, np.ndarray]:
    """Return each field of the section at both ends of each element (e, 2)."""
    out: dict[str, Any] = {}
    given = {f.name: getattr(section, f.name) for f in fields(section) if f.name != "rotary"}
    given |= {f"rotary{k}": x for k, x in enumerate(section.rotary)}
    for name, x in given.items():
        if x is None:
            continue
        x = np.asarray(x, float)
        if x.shape == (n,) and n != 1:
            x = x[ends]
        elif x.shape not in ((), ends.shape):
            raise InputError(
                f"BeamSection({name}=...): got the shape {x.shape}, expected a number, ({n},) for "
                f"the nodes or {ends.shape} for the ends of the elements"
            )
        least = 0.0 if name.startswith("rotary") else np.finfo(float).tiny
        if not (x >= least).all() or not np.isfinite(x).all():
            raise InputError(
                f"BeamSection({name}=...): got {x.min():g}, expected finite numbers "
                f"{'of at least' if least == 0 else 'above'} zero"
            )
        out[name] = np.broadcast_to(x, ends.shape)
    out.setdefault("GAy", None)
    out.setdefault("GAz", None)
    return out


def _shear_number(EI: np.ndarray, GA: np.ndarray | None, length: np.ndarray) -> np.ndarray:
    return 0 * length if GA is None else 12 * EI.mean(1) / (GA.mean(1) * length**2)


def _hermite(s: float, L: np.ndarray, Phi: np.ndarray) -> tuple[np.ndarray, ...]:
    """Compute v, dv/dx, theta and dtheta/dx (e, 4) for the coordinates v1, theta1, v2, theta2."""
    one = np.ones_like(L)
    v = [
        1 - 3 * s**2 + 2 * s**3 + Phi * (1 - s),
        L * (s - 2 * s**2 + s**3 + Phi * (s - s**2) / 2),
        3 * s**2 - 2 * s**3 + Phi * s,
        L * (s**3 - s**2 - Phi * (s - s**2) / 2),
    ]
    dv = [
        (6 * s**2 - 6 * s - Phi) / L,
        1 - 4 * s + 3 * s**2 + Phi * (1 - 2 * s) / 2,
        (6 * s - 6 * s**2 + Phi) / L,
        3 * s**2 - 2 * s - Phi * (1 - 2 * s) / 2,
    ]
    theta = [
        6 * (s**2 - s) / L,
        1 - 4 * s + 3 * s**2 + Phi * (1 - s),
        6 * (s - s**2) / L,
        3 * s**2 - 2 * s + Phi * s,
    ]
    bend = [
        (12 * s - 6) / L**2,
        (6 * s - 4 - Phi) / L,
        (6 - 12 * s) / L**2,
        (6 * s - 2 + Phi) / L,
    ]
    return tuple(
        np.stack([a * one for a in x], 1) / (1 + Phi)[:, None] for x in (v, dv, theta, bend)
    )


def _global(local: np.ndarray, R: np.ndarray, ends: np.ndarray, n: int, vector: bool) -> Any:
    """Assemble rows (e, g, k, 12) in element axes to a sparse matrix (e g k, 6 n)."""
    from scipy import sparse

    e, points, rows, _ = local.shape
    blocks = local.reshape(e, points, rows, 4, 3)
    out = np.einsum("egkbi,eij->egkbj", blocks, R)
    if vector:
        out = np.einsum("eki,egkbj->egibj", R, out)
    columns = (ends[:, :, None] * 6 + np.arange(6)).reshape(e, 1, 1, 12)
    columns = np.broadcast_to(columns, (e, points, rows, 12))
    where = np.broadcast_to(np.arange(e * points * rows).reshape(e, points, rows, 1), columns.shape)
    data = out.reshape(e, points, rows, 12).ravel()
    return sparse.csr_array((data, (where.ravel(), columns.ravel())), (e * points * rows, 6 * n))
