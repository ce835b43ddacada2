"""Jacobians of SE(3), and rates of poses. The functions are public in `se3`.

SE(3) is SO(3) over the dual numbers (Kotelnikov's principle of transference). Each 6 by 6 Jacobian
is therefore [[J, 0], [Q, J]], with the Jacobian J of SO(3) at phi and its derivative Q along rho.
"""

from __future__ import annotations

import jax

from rbjax.lanes import Mat3
from rbjax.rotations.arguments import entries, pose_parts, stacked, takes
from rbjax.rotations.coefficients import inverse_left_lanes, left_lanes
from rbjax.rotations.pose_lanes import dual_jacobian, halves, skew_part, with_last_row


@takes(xi="twist")
def left_jacobian(xi: jax.Array) -> jax.Array:
    """Compute J_l (..., 6, 6) of exp(xi + d) = exp(J_l d) exp(xi), with V_space = J_l xi'.

    Args:
        xi: (..., 6), twists, angular first: rad, then m.

    Returns:
        (..., 6, 6); its lower left block is in m, the others have no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.se3 import left_jacobian
        >>> left_jacobian([0.0, 0.0, 0.2, 1.0, 0.0, 0.0])[0].round(4).tolist()
        [0.9933000000000001, -0.09970000000000001, 0.0, 0.0, 0.0, 0.0]
    """
    return dual_jacobian(left_lanes, entries(xi))


@takes(xi="twist")
def right_jacobian(xi: jax.Array) -> jax.Array:
    """Compute J_r (..., 6, 6) of exp(xi + d) = exp(xi) exp(J_r d), with V_body = J_r xi'.

    Args:
        xi: (..., 6), twists, angular first: rad, then m.

    Returns:
        (..., 6, 6); its lower left block is in m, the others have no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.se3 import right_jacobian
        >>> right_jacobian([0.0, 0.0, 0.2, 1.0, 0.0, 0.0])[0].round(4).tolist()
        [0.9933000000000001, 0.09970000000000001, 0.0, 0.0, 0.0, 0.0]
    """
    return dual_jacobian(left_lanes, entries(-xi))


@takes(xi="twist")
def inverse_left_jacobian(xi: jax.Array) -> jax.Array:
    """Compute J_l^-1 (..., 6, 6), with xi' = J_l^-1 V_space, for angles below 2 pi.

    Args:
        xi: (..., 6), twists, angular first: rad, then m.

    Returns:
        (..., 6, 6); its lower left block is in m, the others have no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.se3 import inverse_left_jacobian
        >>> inverse_left_jacobian([0.0, 0.0, 0.2, 1.0, 0.0, 0.0])[0].round(4).tolist()
        [0.9967, 0.1, 0.0, 0.0, 0.0, 0.0]
    """
    return dual_jacobian(inverse_left_lanes, entries(xi))


@takes(xi="twist")
def inverse_right_jacobian(xi: jax.Array) -> jax.Array:
    """Compute J_r^-1 (..., 6, 6), with xi' = J_r^-1 V_body, for angles below 2 pi.

    Args:
        xi: (..., 6), twists, angular first: rad, then m.

    Returns:
        (..., 6, 6); its lower left block is in m, the others have no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.se3 import inverse_right_jacobian
        >>> inverse_right_jacobian([0.0, 0.0, 0.2, 1.0, 0.0, 0.0])[0].round(4).tolist()
        [0.9967, -0.1, 0.0, 0.0, 0.0, 0.0]
    """
    return dual_jacobian(inverse_left_lanes, entries(-xi))


# ----------------------------------------------------------------------- pose kinematics


@takes(T="pose", V="twist")
def rate_from_body_twist(T: jax.Array, V: jax.Array) -> jax.Array:
    """Compute the rate of a pose, T' = T [V_body] (..., 4, 4).

    Args:
        T: (..., 4, 4), poses, with lengths in m.
        V: (..., 6), twists, rad/s, then m/s.

    Returns:
        (..., 4, 4), 1/s and m/s.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations.se3 import identity, rate_from_body_twist
        >>> rate_from_body_twist(identity(), [0.0, 0, 2, 1, 0, 0])[0].tolist()
        [0.0, -2.0, 0.0, 1.0]
    """
    R, _ = pose_parts(T)
    omega, v = halves(entries(V))
    return with_last_row(R @ Mat3.skew(omega), R @ v, 0.0)


@takes(T="pose", V="twist")
def rate_from_space_twist(T: jax.Array, V: jax.Array) -> jax.Array:
    """Compute the rate of a pose, T' = [V_space] T (..., 4, 4).

    Args:
        T: (..., 4, 4), poses, with lengths in m.
        V: (..., 6), twists, rad/s, then m/s.

    Returns:
        (..., 4, 4), 1/s and m/s.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations.se3 import identity, rate_from_space_twist
        >>> rate_from_space_twist(identity(), [0.0, 0, 2, 1, 0, 0])[0].tolist()
        [0.0, -2.0, 0.0, 1.0]
    """
    R, p = pose_parts(T)
    omega, v = halves(entries(V))
    return with_last_row(Mat3.skew(omega) @ R, omega.cross(p) + v, 0.0)


@takes(T="pose", dT="matrix4")
def body_twist(T: jax.Array, dT: jax.Array) -> jax.Array:
    """Compute the body twist V_body (..., 6), with [V_body] = T^-1 T'.

    Args:
        T: (..., 4, 4), poses, with lengths in m.
        dT: (..., 4, 4), rates of poses, 1/s and m/s.

    Returns:
        (..., 6), rad/s, then m/s.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations.se3 import body_twist, hat, identity
        >>> body_twist(identity(), hat([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])).tolist()
        [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    """
    (R, _), (dR, dp) = pose_parts(T), pose_parts(dT)
    return stacked([*skew_part(R.T @ dR), *(R.T @ dp)])


@takes(T="pose", dT="matrix4")
def space_twist(T: jax.Array, dT: jax.Array) -> jax.Array:
    """Compute the space twist V_space (..., 6), with [V_space] = T' T^-1.

    Args:
        T: (..., 4, 4), poses, with lengths in m.
        dT: (..., 4, 4), rates of poses, 1/s and m/s.

    Returns:
        (..., 6), rad/s, then m/s.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations.se3 import hat, identity, space_twist
        >>> space_twist(identity(), hat([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])).tolist()
        [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    """
    (R, p), (dR, dp) = pose_parts(T), pose_parts(dT)
    omega = skew_part(dR @ R.T)
    return stacked([*omega, *(dp - omega.cross(p))])
