"""Inertia invariants of an elastic body, from points or from a mass matrix.

Points i have the mass m_i, the place f_i, the modes U_i (3, m), and perhaps rotation modes V_i
(3, m) and an inertia J_i (3, 3). The displacement is p_i = f_i + U_i q. With the cross-product
matrix [a]:

    I1 = sum m              I2 = sum m f                     I3 = sum m U
    I4 = sum m [f] U + J V  I5_j = sum m [U_j] U             I6 = sum m U^T U + V^T J V
    I7 = sum J - m [f][f]   I8_j = -sum m [f][U_j]           N_jk = -sum m [U_j][U_k]

A mass matrix m_ik over the points replaces the masses by double sums: sum_ik m_ik a_i b_k. With
consistent matrices of finite elements the invariants are then those of the element's integrals
(Shabana, section 5.3; Masarati et al., *MBDyn theory manual*, modal joint, invariants 1-9, with
the sign and the transpose of its invariant 9 corrected).

The inertia J_i turns with its point. To first order in q its rotation adds

    J1_j  += [V_j] J - J [V_j],     dc_j/dq_k += [V_k] J V_j - J [V_k] V_j / 2
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rbjax.arguments import flag, integer, real_array, shown
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.flexible.modal.body import FRAME_FIELDS, ModalBody, shapes


@displayed
class InertiaInvariants(NamedTuple):
    """The invariants of a body with m modes.

    Fields:
        I1: mass, kg.
        I2: first moment (3,), kg m.
        I3: sum m U (3, m).
        I4: sum m [f] U + J V (3, m).
        I5: entry j is sum m [U_j] U (m, 3, m).
        I6: modal mass (m, m).
        I7: inertia about the origin (3, 3), kg m^2.
        I8: entry j is -sum m [f][U_j] (m, 3, 3).
        N: entry j, k is -sum m [U_j][U_k] (m, m, 3, 3).
        turned_inertia: derivative of the nodal inertias by q_j (m, 3, 3).
        turned_coupling: derivative of the nodal part of c_j by q_k (3, m, m).
    """

    I1: float
    I2: np.ndarray
    I3: np.ndarray
    I4: np.ndarray
    I5: np.ndarray
    I6: np.ndarray
    I7: np.ndarray
    I8: np.ndarray
    N: np.ndarray
    turned_inertia: np.ndarray
    turned_coupling: np.ndarray


def inertia_invariants(
    masses: Any,
    places: Any,
    modes: Any,
    rotation_modes: Any = None,
    inertias: Any = None,
    turn_inertias: bool = False,
) -> InertiaInvariants:
    """Compute the inertia invariants of n points.

    Args:
        masses: (n,) in kg, or a symmetric mass matrix (n, n), dense or sparse, for one component of
            the displacement.
        places: f (n, 3), m.
        modes: U (n, 3, m).
        rotation_modes: V (n, 3, m), rad per unit of q; None for none.
        inertias: J (n, 3, 3) about each point, kg m^2; None for none.
        turn_inertias: include the rotation of the inertias J with their points to first order.

    Returns:
        `InertiaInvariants`, in SI units.

    Raises:
        InputError: a shape is wrong, a number is not finite, or the mass is not positive.

    Source: Shabana, *Dynamics of Multibody Systems*, 5.3; Masarati, MBDyn theory manual.

    Example:
        >>> import numpy as np
        >>> from rbjax.flexible.modal import inertia_invariants
        >>> shape = np.zeros((2, 3, 1)); shape[1, 2, 0] = 1.0
        >>> found = inertia_invariants([1.0, 2.0], [[0, 0, 0], [3, 0, 0]], shape)
        >>> found.I4[:, 0].tolist()
        [0.0, -6.0, 0.0]
    """
    from scipy.sparse import issparse

    f, U = _array("places", places, (None, 3)), _array("modes", modes, (None, 3, None))
    n, m = len(f), U.shape[-1]
    if len(U) != n:
        raise InputError(
            f"inertia_invariants: got {len(U)} modes' points and {n} places; expected one row of "
            "each for each point"
        )
    flag("inertia_invariants", "turn_inertias", turn_inertias)
    weight: Any = masses if issparse(masses) else real_array("inertia_invariants", "masses", masses)
    if weight.shape not in ((n,), (n, n)):
        raise InputError(
            f"inertia_invariants: masses have the shape {weight.shape}, expected ({n},) or "
            f"({n}, {n}), for {n} places"
        )
    if weight.ndim == 1 and (weight < 0).any():
        raise InputError(f"inertia_invariants: masses are {shown(weight)}, expected at least zero")
    V = (
        np.zeros((n, 3, m))
        if rotation_modes is None
        else _array("rotation_modes", rotation_modes, U.shape)
    )
    J = np.zeros((n, 3, 3)) if inertias is None else _array("inertias", inertias, (n, 3, 3))

    fields = np.concatenate([f[:, :, None], U], axis=2).reshape(n, -1)
    weighted = weight[:, None] * fields if weight.ndim == 1 else np.asarray(weight @ fields)
    mass = float(weight.sum())
    if not mass > 0 or not np.isfinite(mass):
        raise InputError(f"inertia_invariants: the mass is {mass:g}, expected more than zero")
    first = weighted.sum(0).reshape(3, 1 + m)
    # second moments: sum a_i b_k of component and field, and of component and field
    S = (fields.T @ weighted).reshape(3, 1 + m, 3, 1 + m)
    S = (S + S.transpose(2, 3, 0, 1)) / 2
    with_J = np.einsum("nab,nbj->naj", J, V)
    own, modal = S[:, 0, :, 0], S[:, 1:, :, 1:]
    return InertiaInvariants(
        mass,
        first[:, 0],
        first[:, 1:],
        _cross(S[:, 0, :, 1:]) + with_J.sum(0),
        _cross(modal.transpose(0, 2, 1, 3)).transpose(1, 0, 2),
        np.einsum("ajak->jk", modal) + np.einsum("naj,nak->jk", V, with_J),
        _minus_double_cross(own) + J.sum(0),
        _minus_double_cross(S[:, 0, :, 1:].transpose(2, 0, 1)),
        _minus_double_cross(modal.transpose(1, 3, 0, 2)),
        *_turned(V, J, with_J, turn_inertias),
    )


def from_points(
    masses: Any,
    places: Any,
    modes: Any,
    rotation_modes: Any = None,
    inertias: Any = None,
    *,
    stiffness: Any = None,
    damping: Any = None,
    second_modes: Any = None,
    frames: Any = (),
    turn_inertias: bool = False,
) -> ModalBody:
    """Create a modal body from n points.

    Args:
        masses: (n,) in kg, or a symmetric mass matrix (n, n) for one component.
        places: f (n, 3), m.
        modes: U (n, 3, m).
        rotation_modes: V (n, 3, m); None for none.
        inertias: J (n, 3, 3) about each point, kg m^2; None for none.
        stiffness: K (m, m); None for zero.
        damping: D (m, m); None for zero.
        second_modes: A (n, 3, m, m), symmetric in the modes: the displacement is U q + q.A q / 2.
            Its terms of first order in the equations of motion are the geometric stiffening. None
            for none.
        frames: indices of the points that carry a frame; their names are their indices.
        turn_inertias: include the rotation of the inertias with their points to first order.

    Returns:
        `ModalBody`.

    Raises:
        InputError: a shape is wrong, a number is not finite, or a frame is not a point.

    Source: see `inertia_invariants`.

    Example:
        >>> import numpy as np
        >>> from rbjax.flexible.modal import from_points
        >>> shape = np.zeros((2, 3, 1)); shape[1, 2, 0] = 1.0
        >>> body = from_points([1.0, 2.0], [[0, 0, 0], [3, 0, 0]], shape, frames=[1])
        >>> body.first_moment1[:, 0].tolist(), body.frame_names
        ([0.0, 0.0, 2.0], ('1',))
    """
    U = _array("modes", modes, (None, 3, None))
    found = inertia_invariants(masses, places, U, rotation_modes, inertias, turn_inertias)
    if isinstance(frames, str | Mapping) or not isinstance(frames, Iterable):
        raise InputError(f"from_points: frames is {shown(frames)}, expected indices of points")
    at = [integer("from_points", "frames", k) for k in frames]
    if any(not 0 <= k < len(U) for k in at) or len(set(at)) != len(at):
        raise InputError(
            f"from_points: frames are {list(frames)}, expected different indices from 0 to "
            f"{len(U) - 1}"
        )
    f = np.asarray(places, float)
    V = np.zeros(U.shape) if rotation_modes is None else np.asarray(rotation_modes, float)
    A, second = None, {}
    if second_modes is not None:
        A = _array("second_modes", second_modes, (*U.shape, U.shape[-1]))
        second = second_order(masses, f, A)
    return modal_body(
        found,
        stiffness=stiffness,
        damping=damping,
        frames=(
            f[at],
            np.tile(np.eye(3), (len(at), 1, 1)),
            U[at],
            V[at],
            None if A is None else A[at],
            [str(k) for k in at],
        ),
        second=second,
    )


def second_order(masses: Any, places: np.ndarray, A: np.ndarray) -> dict[str, np.ndarray]:
    """Compute h2, G and the part of c1 of second-order displacements A (n, 3, m, m)."""
    weight = masses if getattr(masses, "ndim", 1) == 2 else np.asarray(masses, float)
    flat = A.reshape(len(A), -1)
    weighted = weight[:, None] * flat if weight.ndim == 1 else np.asarray(weight @ flat)
    S = (places.T @ weighted).reshape(3, *A.shape[1:])  # sum f_a A_b
    J = _minus_double_cross(S.transpose(2, 3, 0, 1))
    return {
        "first_moment2": weighted.sum(0).reshape(A.shape[1:]),
        "centrifugal_stiffness": -(J + J.swapaxes(-1, -2)) / 2,
        "coupling1": _cross(S),
    }


def modal_body(
    found: InertiaInvariants,
    *,
    stiffness: Any = None,
    damping: Any = None,
    frames: Any = None,
    second: dict[str, np.ndarray] | None = None,
    mode_names: Any = None,
) -> ModalBody:
    """Create a modal body from inertia invariants.

    Args:
        found: the invariants.
        stiffness: K (m, m); None for zero.
        damping: D (m, m); None for zero.
        frames: (positions, orientations, modes, rotation modes, second modes or None, names).
        second: first_moment2, centrifugal_stiffness and the part of coupling1 of second-order
            displacements.
        mode_names: m names; None for "mode 1", "mode 2", ...
    """
    m = len(found.I6)
    none = shapes(m, 0)
    if frames is None:
        frames = (*(np.zeros(none[k]) for k in FRAME_FIELDS), ())
    *arrays, names = frames
    given: dict[str, Any] = dict(zip(FRAME_FIELDS, arrays, strict=True))
    if given["second_modes"] is None:
        given["second_modes"] = np.zeros((len(names), 3, m, m))
    second = second or {}
    J2 = (found.N + found.N.transpose(1, 0, 2, 3)) / 2
    J2 = (J2 + J2.swapaxes(-1, -2)) / 2
    given |= dict(
        mass=found.I1,
        first_moment=found.I2,
        first_moment1=found.I3,
        first_moment2=second.get("first_moment2", np.zeros(none["first_moment2"])),
        inertia=found.I7,
        inertia1=found.I8 + found.I8.swapaxes(-1, -2) + found.turned_inertia,
        inertia2=J2,
        centrifugal_stiffness=second.get("centrifugal_stiffness", np.zeros(none["inertia2"])),
        coupling=found.I4,
        # (I5_k)_j is the derivative of c_j by q_k
        coupling1=found.I5.transpose(1, 2, 0)
        + found.turned_coupling
        + second.get("coupling1", 0.0),
        modal_mass=found.I6,
        stiffness=np.zeros((m, m)) if stiffness is None else stiffness,
        damping=np.zeros((m, m)) if damping is None else damping,
    )
    labels = tuple(mode_names or (f"mode {k + 1}" for k in range(m)))
    return ModalBody(**given, mode_names=labels, frame_names=tuple(names))


def _array(name: str, x: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    try:
        out = np.asarray(x, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: got {type(x).__name__}, expected an array of numbers") from error
    due = tuple(n if want is None else want for n, want in zip(out.shape, shape, strict=False))
    if out.ndim != len(shape) or out.shape != due:
        form = ", ".join("any" if n is None else str(n) for n in shape)
        raise InputError(f"{name}: got the shape {out.shape}, expected ({form})")
    if not np.isfinite(out).all():
        raise InputError(f"{name}: a number is not finite, expected finite numbers")
    return out


def _cross(S: np.ndarray) -> np.ndarray:
    """Compute sum a x b (3, ...) from the moments sum a_i b_k (3, 3, ...)."""
    return np.stack([S[1, 2] - S[2, 1], S[2, 0] - S[0, 2], S[0, 1] - S[1, 0]])


def _minus_double_cross(S: np.ndarray) -> np.ndarray:
    """Compute -sum [a][b] = sum (a.b) 1 - b a^T (..., 3, 3) from sum a_i b_k (..., 3, 3)."""
    trace = np.trace(S, axis1=-2, axis2=-1)[..., None, None]
    return trace * np.eye(3) - S.swapaxes(-1, -2)


def _turned(
    V: np.ndarray, J: np.ndarray, with_J: np.ndarray, include: bool
) -> tuple[np.ndarray, np.ndarray]:
    m = V.shape[-1]
    if not include:
        return np.zeros((m, 3, 3)), np.zeros((3, m, m))
    axes = np.eye(3)
    skew = np.cross(V.transpose(0, 2, 1)[:, :, None, :], axes).swapaxes(-1, -2)  # (n, m, 3, 3)
    first = np.einsum("njab,nbc->njac", skew, J)
    first = (first + first.swapaxes(-1, -2)).sum(0)
    turned = np.einsum("nkab,nbj->ajk", skew, with_J)
    half = np.einsum("nab,nkbc,ncj->ajk", J, skew, V) / 2
    return first, turned - half
