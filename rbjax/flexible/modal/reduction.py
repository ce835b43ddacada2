"""Craig-Bampton reduction of finite elements to a modal body.

The displacements are u = Psi r + Phi e. A static mode Psi_k is the deflection for a unit motion of
one coordinate of an interface, while all other interfaces are at rest. Phi are the lowest normal
modes with all interfaces at rest. The motion of an interface is the averaged rigid motion B u of
its nodes:

    [K, B^T; B, 0] [Psi; lambda] = [0; 1],     (K - s M) phi + B^T lambda = 0,  B phi = 0

The floating frame is fixed to one interface, or it is the mean axes of the free body. Then the six
rigid modes are removed, and the others are orthogonal to them in the mass matrix (Tisserand).

Sources: Craig & Bampton, AIAA J. 6(7), 1968; Géradin & Rixen, *Mechanical Vibrations*, 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rbjax.errors import InputError, UnknownName
from rbjax.flexible.modal.body import ModalBody, generalized_modes
from rbjax.flexible.modal.finite_elements import FiniteElements
from rbjax.flexible.modal.interfaces import (
    Interface,
    check_interfaces,
    frame_position,
    rigid_motion,
)
from rbjax.flexible.modal.invariants import inertia_invariants, modal_body
from rbjax.flexible.modal.stiffening import geometric_stiffening

#: up to this number of coordinates the normal modes are those of full matrices
DENSE = 400


def craig_bampton(
    elements: FiniteElements,
    interfaces: Sequence[Interface] = (),
    modes: int = 10,
    *,
    frame: str | None = None,
    stiffening: bool = True,
    orthogonal: bool = True,
    keep: int | None = None,
    turn_inertias: bool = False,
) -> ModalBody:
    """Reduce finite elements to a modal body with a frame at each interface.

    Args:
        elements: the structure, such as `beam_mesh(...)`.
        interfaces: places where joints, children and forces are attached.
        modes: number of normal modes with all interfaces at rest.
        frame: name of the interface to which the floating frame is fixed; the frame has its
            position. None: mean axes of the free body, with the origin of the mesh.
        stiffening: include geometric stiffening, if the elements have `prestress`.
        orthogonal: return the natural modes of the reduced body, with a modal mass of 1 and
            ascending frequencies, instead of static and normal modes. Mean axes need it.
        keep: number of natural modes to keep; None for all.
        turn_inertias: see `inertia_invariants`.

    Returns:
        The modal body. Its damping is zero; see `ModalBody.with_damping`.

    Raises:
        InputError: an interface does not determine its motion, has a node that does not exist or
            is used twice; the structure has a mechanism; there are no modes.
        UnknownName: `frame` is not an interface.

    Source: Craig & Bampton 1968.

    Example:
        >>> import numpy as np
        >>> from rbjax.flexible.modal import BeamSection, Interface, beam_mesh, craig_bampton
        >>> section = BeamSection(EA=1e6, EIy=10.0, EIz=10.0, GJ=8.0, mass=2.0, rotary=(0.01, 0, 0))
        >>> mesh = beam_mesh(np.linspace([0, 0, 0], [1, 0, 0], 11), section)
        >>> ends = [Interface("root", [0]), Interface("tip", [10])]
        >>> body = craig_bampton(mesh, ends, 4, frame="root")
        >>> body.frame_names, float(body.frequencies[0].round(3))
        (('root', 'tip'), 7.863)
    """
    check_interfaces(elements, interfaces)
    names = [at.name for at in interfaces]
    if frame is not None and frame not in names:
        raise UnknownName("interface", frame, names)
    if not orthogonal and frame is None:
        raise InputError("craig_bampton: mean axes need natural modes; set orthogonal=True")
    if modes < 0 or (keep is not None and keep < 1):
        raise InputError(
            f"craig_bampton: got {modes} modes and keep={keep}, expected at least 0 and 1"
        )
    origin = np.zeros(3)
    if frame is not None:
        origin = frame_position(elements, interfaces[names.index(frame)])
    motions = {at.name: rigid_motion(elements, at) for at in interfaces}
    rigid = elements.rigid_modes(origin)
    mean = (elements.M @ rigid).T

    # without interfaces the free modes, which are orthogonal to the rigid modes
    held = np.concatenate(list(motions.values())) if motions else mean
    solver = ConstrainedSolver(elements.K, held)
    free = [k for k, name in enumerate(names) if name != frame]
    wanted = (
        np.concatenate([np.arange(6 * k, 6 * k + 6) for k in free]) if free else np.zeros(0, int)
    )
    static = (
        solver.displaced(np.eye(len(held))[:, wanted]) if motions else np.zeros((len(mean.T), 0))
    )
    basis = np.concatenate([static, solver.normal_modes(elements.M, modes)], 1)
    if basis.shape[1] == 0:
        raise InputError("craig_bampton: there are no modes; give modes >= 1 or a second interface")
    labels = [f"{names[k]} {c}" for k in free for c in ("rx", "ry", "rz", "x", "y", "z")]
    labels += [f"normal {k + 1}" for k in range(basis.shape[1] - len(labels))]

    K, M = (basis.T @ (A @ basis) for A in (elements.K, elements.M))
    if orthogonal:
        values, vectors = generalized_modes(K, M)
        rigid_count = 6 if frame is None and motions else 0
        if rigid_count and not abs(values[5]) < 1e-6 * abs(values[6:7]).sum():
            raise InputError(
                "craig_bampton: the structure is not free, so mean axes do not exist; give the "
                "matrices without supports, or name the interface that the frame is fixed to"
            )
        chosen = np.arange(rigid_count, len(values))[:keep]
        values = values[chosen]
        basis = _separated(values, basis @ vectors[:, chosen], elements.per_node)
        K, M = np.diag(values), np.eye(len(chosen))
        labels = [f"mode {k + 1}" for k in range(len(chosen))]
        largest = np.abs(basis).argmax(0)
        basis = basis * np.sign(basis[largest, range(len(chosen))])  # a unique sign

    m = basis.shape[1]
    D, T = elements.displacement, elements.rotation
    found = inertia_invariants(
        elements.masses,
        elements.places - origin,
        (D @ basis).reshape(-1, 3, m),
        None if T is None else (T @ basis).reshape(-1, 3, m),
        elements.inertias,
        turn_inertias,
    )
    # of first order in the modes the mass matrix is exact, also if the points are lumped
    of_rigid, coupled = mean @ rigid, mean @ basis
    found = found._replace(
        I1=of_rigid[3, 3],
        I2=np.array([of_rigid[2, 4], of_rigid[0, 5], of_rigid[1, 3]]),
        I3=coupled[3:],
        I4=coupled[:3],
        I6=M,
        I7=of_rigid[:3, :3],
    )
    at = (
        np.stack([frame_position(elements, x) for x in interfaces]) if motions else np.zeros((0, 3))
    )
    moved = np.array([B @ basis for B in motions.values()]).reshape(-1, 6, m)
    second: dict[str, np.ndarray] = {}
    bent = None
    if stiffening and elements.prestress is not None:
        held = mean if frame is None else motions[frame]
        support = ConstrainedSolver(elements.K, held)
        second, bent = geometric_stiffening(
            elements, support, basis, origin, list(motions.values()), fixed=frame is not None
        )
    frames = (
        at - origin,
        np.tile(np.eye(3), (len(names), 1, 1)),
        moved[:, 3:],
        moved[:, :3],
        bent,
        names,
    )
    return modal_body(found, stiffness=K, frames=frames, second=second, mode_names=labels)


def _separated(values: np.ndarray, modes: np.ndarray, step: int) -> np.ndarray:
    """Rotate modes of equal frequency to directions: the modes of a round beam to its planes."""
    out, weight = modes.copy(), np.tile(np.arange(1.0, step + 1), len(modes) // step)
    split = np.flatnonzero(np.diff(values) > 1e-6 * np.abs(values[1:])) + 1
    for group in np.split(np.arange(len(values)), split):
        if len(group) > 1:
            part = modes[:, group]
            _, turn = np.linalg.eigh(part.T @ (part * weight[:, None]))
            out[:, group] = part @ turn
    return out


class ConstrainedSolver:
    """Solutions of K u + B^T lambda = f with B u = b, by one sparse factorization."""

    def __init__(self, K: Any, B: np.ndarray):
        from scipy import sparse
        from scipy.sparse.linalg import splu

        self.K, self.n, self.B = K, K.shape[0], B
        # rows of unit size, scaled to the size of K
        self.scale = abs(K).max() / np.abs(B).max(axis=1)
        C = sparse.csr_array(B * self.scale[:, None])
        system = sparse.block_array([[K, C.T], [C, None]], format="csc")
        message = (
            "craig_bampton: the structure can move without deformation while its interfaces are "
            "at rest; connect all of its parts, and give an interface or frame=None to a free body"
        )
        try:
            self.factor = splu(system)
        except RuntimeError as error:
            raise InputError(message) from error
        pivots = np.abs(self.factor.U.diagonal())
        if pivots.min() < 1e-13 * pivots.max():
            raise InputError(message)

    def loaded(self, forces: np.ndarray) -> np.ndarray:
        """Return the displacements (N, k) of forces (N, k), with B u = 0."""
        rest = np.zeros((len(self.B), forces.shape[1]))
        return self.factor.solve(np.concatenate([forces, rest]))[: self.n]

    def displaced(self, b: np.ndarray) -> np.ndarray:
        """Return the displacements (N, k) without forces, with B u = b (r, k)."""
        none = np.zeros((self.n, b.shape[1]))
        return self.factor.solve(np.concatenate([none, b * self.scale[:, None]]))[: self.n]

    def normal_modes(self, M: Any, count: int) -> np.ndarray:
        """Return the lowest modes (N, count) with B u = 0, orthonormal in M."""
        from scipy.linalg import LinAlgError, eigh, null_space
        from scipy.sparse.linalg import LinearOperator, eigsh

        possible = self.n - len(self.B)
        if count > possible:
            raise InputError(
                f"craig_bampton: {count} normal modes are wanted, and the structure has {possible} "
                "with its interfaces at rest"
            )
        if count == 0:
            return np.zeros((self.n, 0))
        if self.n <= DENSE or count > possible // 3:
            Z = null_space(self.B / np.abs(self.B).max(axis=1)[:, None])
            K, mass = (Z.T @ (A @ Z) for A in (self.K, M))
            try:
                found = eigh((K + K.T) / 2, (mass + mass.T) / 2, subset_by_index=[0, count - 1])
            except LinAlgError as error:
                raise InputError(
                    "craig_bampton: the mass matrix is not positive definite: a coordinate has no "
                    "mass, such as the rotation about a beam; give BeamSection(rotary=...)"
                ) from error
            return Z @ found[1]
        inverse = LinearOperator((self.n, self.n), lambda f: self.loaded(f.reshape(-1, 1))[:, 0])
        start = np.random.default_rng(0).normal(size=self.n)
        values, vectors = eigsh(self.K, count, M, sigma=0.0, OPinv=inverse, v0=start)
        return vectors[:, np.argsort(values)]
