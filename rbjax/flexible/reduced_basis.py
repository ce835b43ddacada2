"""Reduced bases of beams: coordinates that are combinations of Legendre coefficients.

    xi = xi_0 + sum_j P_j T_j q,   T^T K T diagonal

T_j are the rows of T for the coefficients of degree j, and K is the stiffness of the Legendre
coefficients. The columns of T are the principal directions of given states of the beam in the inner
product of the elastic energy (proper orthogonal decomposition; Volkwein, *Proper Orthogonal
Decomposition: Theory and Reduced-Order Modelling*, 2013). The states are vibration modes, static
modes (Craig, *Coupling of substructures for dynamic analyses*, 2000), static solutions or a motion.
The strains are reduced, and the kinematics are exact: large deflections and rotations need no
further terms.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from rbjax.arguments import real_array
from rbjax.errors import InputError, UnknownName
from rbjax.flexible.strain import STRAINS, StrainBeam, stiffness_matrix
from rbjax.joints.frame_motion import FrameMotion
from rbjax.lanes import Vec3
from rbjax.spatial import Motion

if TYPE_CHECKING:
    from rbjax.flexible.beams import Beam

_CONSTANTS = "constants, because a basis does not depend on traced values"
_LEAST = 1e-10  # singular values below this fraction of the largest are rounding errors


def principal_shapes(
    beam: Beam, snapshots: Any, count: int | Mapping[str, int] | None
) -> tuple[tuple[float, ...], ...]:
    """Compute the rows of the basis T of `Beam.reduced`."""
    joint, where = beam.joint(), "Beam.reduced"
    K = _stiffness(where, beam, beam.replace(basis=()).joint())  # of the Legendre coefficients
    q = real_array(where, "snapshots", snapshots, "coordinates of the beam, constants")
    if q.ndim != 2 or q.shape[1] != joint.coordinates:
        raise InputError(
            f"{where}: snapshots has the shape {q.shape}, expected (k, {joint.coordinates}), "
            "one row of coordinates of the beam for each state"
        )
    X = q @ np.array(joint.basis).T
    known, T = dict(joint.shape.degrees), np.zeros((len(K), 0))
    for name, n in (count if isinstance(count, Mapping) else {None: count}).items():
        if name is not None and name not in known:
            raise UnknownName("strain in count", name, known)
        strains = [STRAINS[k] for k, _ in joint.coefficients]
        own = [i for i, strain in enumerate(strains) if name in (None, strain)]
        found = _principal(name or "all strains", X[:, own], K[np.ix_(own, own)], n)
        T = np.concatenate([T, np.zeros((len(K), found.shape[1]))], 1)
        T[own, -found.shape[1] :] = found
    if not T.shape[1]:
        raise InputError(f"{where}: count is empty, expected a number for at least one strain")
    return tuple(map(tuple, (T / _largest_strain(joint, T)).tolist()))


def _principal(what: str, X: np.ndarray, K: np.ndarray, count: Any) -> np.ndarray:
    """Compute the principal directions (coefficients, count) of the rows of X.

    what: the strains of the coefficients, for errors. count: None for as many as independent rows.
    """
    factor = np.linalg.cholesky(K)
    _, sizes, directions = np.linalg.svd(X @ factor, full_matrices=False)
    rank = int((sizes > _LEAST * sizes[:1]).sum())
    n = rank if count is None else count
    if isinstance(n, bool) or not isinstance(n, int) or n < 1:
        raise InputError(
            f"Beam.reduced: the number of coordinates is {n!r}, expected an integer of at least 1; "
            "None for as many as the snapshots have, or a mapping from strain to number"
        )
    if n > rank:
        raise InputError(
            f"Beam.reduced: count is {n} for {what}, and the snapshots have {rank} independent "
            "shapes there; give more snapshots, or a smaller count"
        )
    return np.linalg.solve(factor.T, directions[:n].T)


def _largest_strain(joint: StrainBeam, T: np.ndarray) -> np.ndarray:
    """Compute the strain of largest size of each column, with its sign."""
    values = [np.zeros((len(STRAINS), T.shape[1])) for _ in joint.values]
    for at, P in zip(values, joint.values, strict=True):
        for (k, j), row in zip(joint.coefficients, T, strict=True):
            at[k] += P[j] * row
    every = np.concatenate(values)
    return np.take_along_axis(every, abs(every).argmax(0)[None], 0)[0]


def vibration_modes(beam: Beam, count: int) -> np.ndarray:
    """Compute the modes of `Beam.vibration_modes`."""
    joint, where = beam.joint(), "Beam.vibration_modes"
    n = joint.coordinates
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= n:
        raise InputError(
            f"{where}: count is {count!r}, expected an integer from 1 to {n}, the number of "
            "coordinates"
        )
    M, units = np.zeros((n, n)), [Motion(Vec3(*x[:3]), Vec3(*x[3:])) for x in np.eye(6).tolist()]
    for frame, S in _frames_at_rest(where, beam, joint)[: joint.tip]:
        inertia = np.array([[float(x) for x in frame.own(unit)] for unit in units])
        M += S @ inertia @ S.T
    K = _stiffness(where, beam, joint)
    scale = np.sqrt(np.diag(K))
    # M x = K x / omega^2, in coordinates of unit stiffness
    _, modes = scipy.linalg.eigh(M / scale / scale[:, None], K / scale / scale[:, None])
    return (modes[:, ::-1][:, :count] / scale[:, None]).T


def static_modes(beam: Beam) -> np.ndarray:
    """Compute the modes of `Beam.static_modes`."""
    joint, where = beam.joint(), "Beam.static_modes"
    K = _stiffness(where, beam, joint)
    _, S = _frames_at_rest(where, beam, joint)[joint.tip]
    modes = np.linalg.solve(K, S).T
    size = np.sqrt(np.einsum("mi,ij,mj->m", modes, K, modes))
    return modes[size > 0] / size[size > 0, None]


def _stiffness(where: str, beam: Beam, joint: StrainBeam) -> np.ndarray:
    """Compute the stiffness matrix of a beam in the coordinates of a joint."""
    C = real_array(where, "section.stiffness", beam.elasticity("").stiffness, _CONSTANTS)
    length = real_array(where, "length", beam.length, _CONSTANTS)
    return np.array(stiffness_matrix(joint, C.tolist(), float(length)))


def _frames_at_rest(
    where: str, beam: Beam, joint: StrainBeam
) -> list[tuple[FrameMotion, np.ndarray]]:
    """Return the frames of a beam at q = 0 and their axes (coordinates, 6)."""
    params = real_array(where, "the parameters", beam.params(joint), _CONSTANTS).tolist()
    zero = [0.0] * joint.coordinates
    frames = joint.frames(zero, zero, params)
    return [(x, np.array([[float(y) for y in axis] for axis in x.axes])) for x in frames]
