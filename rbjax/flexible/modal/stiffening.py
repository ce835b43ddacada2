"""Geometric stiffening of a modal body, elastic forces, and a check of fast rotation.

The stress of a load changes the stiffness by K_g, which is proportional to the load. The loads of a
floating frame are its accelerations, its rotation, and forces at its frames. The deflection of each
unit load is static, with the structure held at the floating frame. In the equations of motion the
terms K_g q are those of second-order displacements (Wallrapp & Schwertassek, IJNME 32, 1991):

    acceleration a_c            h2_c = K_g
    angular acceleration w'_c   c1_c += K_g
    rotation w_a w_b            G_ab = K_g (a = b), K_g / 2 (a != b)
    force F_c at a frame        A_c = -K_g

Without them a rotating beam becomes softer with its speed, where a real one becomes stiffer: its
stiffness in the plane of rotation is omega_1^2 - Omega^2 (Kane, Ryan & Banerjee, JGCD 10(2), 1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from rbjax.arguments import floating_array, real_array, shown
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.flexible.modal.body import ModalBody, check_body, generalized_modes
from rbjax.flexible.modal.finite_elements import FiniteElements
from rbjax.lanes import matvec
from rbjax.model.record import check_numbers

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def geometric_stiffening(
    elements: FiniteElements,
    support: Any,
    basis: np.ndarray,
    origin: np.ndarray,
    motions: Sequence[np.ndarray],
    fixed: bool,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Compute the second-order terms of all unit loads of a floating frame.

    Args:
        elements: the structure, with `prestress`.
        support: `ConstrainedSolver` of the structure, held at the floating frame.
        basis: modes (N, m).
        origin: origin of the floating frame (3,), m.
        motions: B (6, N) of each frame.
        fixed: True if the floating frame is fixed to the structure. Accelerations of mean axes
            need forces that are not known, so they do not stiffen.

    Returns:
        first_moment2, centrifugal_stiffness and a part of coupling1 of a `ModalBody`, and
        second_modes (P, 3, m, m).
    """
    assert elements.prestress is not None
    m, p = basis.shape[1], elements.places - origin
    axes = np.eye(3)
    loads = []
    for a, b in PAIRS:  # w x (w x p) = w (w.p) - p |w|^2
        field = np.outer(p[:, b], axes[a]) + np.outer(p[:, a], axes[b])
        loads.append(elements.load(field / 2 - p if a == b else field))
    if fixed:
        loads += [elements.load(np.broadcast_to(axes[c], p.shape)) for c in range(3)]
        loads += [elements.load(np.cross(axes[c], p)) for c in range(3)]
    loads += [B[3 + c] for B in motions for c in range(3)]
    deflections = support.loaded(np.stack(loads, 1))
    found = []
    for u in deflections.T:
        K = basis.T @ (elements.prestress(u) @ basis)
        found.append((K + K.T) / 2)
    K = np.array(found)

    G = np.zeros((m, m, 3, 3))
    for n, (a, b) in enumerate(PAIRS):
        G[:, :, a, b] = G[:, :, b, a] = K[n] if a == b else K[n] / 2
    second = {"centrifugal_stiffness": G}
    if fixed:
        second |= {"first_moment2": K[6:9], "coupling1": K[9:12]}
    bent = -K[12 if fixed else 6 :].reshape(len(motions), 3, m, m)
    return second, bent


def elastic_force(body: ModalBody, q: jax.Array, qd: jax.Array) -> jax.Array:
    """Compute the generalized force K q + D q' (m,) that the elasticity opposes to the motion.

    It is on the side of the inertia: M q'' + ... + K q + D q' = tau. Geometric stiffening is not
    included, because it is part of the inertia and of the frames of a `ModalLink`.

    Args:
        body: the body.
        q: coordinates (m,).
        qd: their rates (m,).

    Returns:
        (m,), in J per unit of q.

    Raises:
        InputError: not a modal body, another shape, or values that are not finite.

    Source: Shabana, section 5.5.

    Example:
        >>> import numpy as np
        >>> from rbjax.flexible.modal import elastic_force, from_points
        >>> shape = np.ones((1, 3, 1))
        >>> body = from_points([1.0], [[0, 0, 0]], shape, stiffness=[[8.0]], damping=[[0.5]])
        >>> elastic_force(body, np.array([0.5]), np.array([2.0])).tolist()
        [5.0]
    """
    check_body("elastic_force", body)
    m = body.mode_count
    q, qd = (
        floating_array("elastic_force", name, x, lambda shape: shape == (m,), f"({m},)")
        for name, x in (("q", q), ("qd", qd))
    )
    for name, x in (("q", q), ("qd", qd)):
        check_numbers(f"elastic_force: {name}", x, infinite=False)
    return matvec(body.stiffness, q) + matvec(body.damping, qd)


def stiffness_in_motion(
    body: ModalBody, w: Any, acceleration: Any = None, angular_acceleration: Any = None
) -> np.ndarray:
    """Compute the stiffness (m, m) of small deformations in a steady motion of the floating frame.

        K + h2.a + c1.w' + w.(G - J2) w

    Args:
        body: the body.
        w: angular velocity of the floating frame in its axes (3,), rad/s.
        acceleration: of its origin minus gravity (3,), m/s^2; None for zero.
        angular_acceleration: (3,), rad/s^2; None for zero.

    Returns:
        (m, m), in J per squared unit of q.

    Raises:
        InputError: not a modal body, or a vector that is not three finite numbers.

    Source: Wallrapp & Schwertassek 1991.

    Example:
        >>> import numpy as np
        >>> from rbjax.flexible.modal import from_points, stiffness_in_motion
        >>> shape = np.zeros((1, 3, 1)); shape[0, 1] = 1.0
        >>> body = from_points([1.0], [[1, 0, 0]], shape, stiffness=[[4.0]])
        >>> stiffness_in_motion(body, [0.0, 0.0, 3.0]).tolist()
        [[-5.0]]
    """
    where = "stiffness_in_motion"
    check_body(where, body)
    w = _vector(where, "w", w)
    spun = np.asarray(body.centrifugal_stiffness) - np.asarray(body.inertia2)
    K = np.asarray(body.stiffness) + np.einsum("a,jkab,b", w, spun, w)
    if acceleration is not None:
        K = K + np.tensordot(
            _vector(where, "acceleration", acceleration), np.asarray(body.first_moment2), 1
        )
    if angular_acceleration is not None:
        c1 = np.tensordot(
            _vector(where, "angular_acceleration", angular_acceleration),
            np.asarray(body.coupling1),
            1,
        )
        K = K + c1
    return K


@displayed
class FastRotation(NamedTuple):
    """The modal stiffness of a body that rotates at constant angular velocity.

    Fields:
        success: True if no mode has a negative stiffness.
        squares: squared frequencies (m,) without gyroscopic terms, rad^2/s^2, ascending.
        at_rest: squared frequencies (m,) without rotation.
        stiffened: True if the body has second-order displacements.
        status: a sentence.
    """

    success: bool
    squares: np.ndarray
    at_rest: np.ndarray
    stiffened: bool
    status: str

    def summary(self) -> str:
        """Return the status."""
        return self.status


def fast_rotation(body: ModalBody, omega: Any, acceleration: Any = None) -> FastRotation:
    """Check that a modal body is valid in rotation at constant angular velocity.

    Use it before a simulation in which a modal body turns fast. A negative stiffness without
    geometric stiffening is an error of the linear floating frame, and the deformation diverges.

    Args:
        body: the body.
        omega: angular velocity of the floating frame in its axes (3,), rad/s.
        acceleration: of its origin minus gravity (3,), such as omega x (omega x r) on a hub of
            radius r; None for zero.

    Returns:
        `FastRotation`, with squared frequencies and a sentence.

    Raises:
        InputError: a vector has a wrong shape.

    Source: Kane, Ryan & Banerjee 1987.

    Example:
        >>> import numpy as np
        >>> from rbjax.flexible.modal import fast_rotation, from_points
        >>> shape = np.zeros((1, 3, 1)); shape[0, 1] = 1.0
        >>> body = from_points([1.0], [[1, 0, 0]], shape, stiffness=[[4.0]])
        >>> fast_rotation(body, [0.0, 0.0, 3.0]).success
        False
    """
    check_body("fast_rotation", body)
    w = _vector("fast_rotation", "omega", omega)
    mass = np.asarray(body.modal_mass)
    squares, _ = generalized_modes(stiffness_in_motion(body, w, acceleration), mass)
    at_rest, _ = generalized_modes(np.asarray(body.stiffness), mass)
    second = (body.first_moment2, body.second_modes, body.centrifugal_stiffness)
    stiffened = any(np.any(np.asarray(x)) for x in second)
    speed, lowest = float(np.linalg.norm(w)), squares[0]
    scale = f"lowest squared frequency {lowest:.4g} rad^2/s^2 at {speed:.4g} rad/s"
    softer = lowest < at_rest[0] - 1e-12 * abs(at_rest[0])
    if lowest >= 0:
        status = f"stable: {scale}, and {at_rest[0]:.4g} at rest"
        if softer and not stiffened and lowest < 0.9 * at_rest[0]:
            status += (
                "; the body has no geometric stiffening, so its frequencies fall with the speed "
                "instead of rising; create it with stiffening=True"
            )
    elif stiffened:
        status = f"unstable: {scale}, with geometric stiffening; the body buckles in this motion"
    else:
        status = (
            f"unstable: {scale}. The body has no geometric stiffening: a linear floating frame "
            "becomes softer in rotation where a real body becomes stiffer, and its deformation "
            "diverges. Create it with craig_bampton(..., stiffening=True), read a file with "
            "first-order terms, or use a beam in strain coordinates"
        )
    return FastRotation(bool(lowest >= 0), squares, at_rest, stiffened, status)


def _vector(where: str, name: str, x: Any) -> np.ndarray:
    out = real_array(where, name, x, "three finite numbers")
    if out.shape != (3,):
        raise InputError(f"{where}: {name} is {shown(x)}, expected three finite numbers")
    return out
