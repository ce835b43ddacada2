"""Motion of points and frames relative to a moving frame (Olguin Diaz, 3.3.2, 3.3.3).

A frame B moves in A with rotation R = R_AB, origin p, angular velocity omega, angular acceleration
alpha, and velocity v and acceleration a of its origin, all in the axes of A. A point at r in B that
moves in B with r' and r'' has

    velocity       v + omega x R r + R r'
    acceleration   a + alpha x R r + omega x (omega x R r) + 2 omega x R r' + R r''
                       Euler          centripetal             Coriolis        relative

Newton's law in B is m R r'' = f + apparent forces. The apparent forces are -m times all terms but
the relative one, such as the centrifugal force -m omega x (omega x R r).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import instance
from rbjax.body.body import unbatched
from rbjax.errors import InputError
from rbjax.lanes import matmat, matvec
from rbjax.rotations import so3


class MovingFrame(NamedTuple):
    """The motion of a frame B in a frame A, in the axes of A."""

    R: jax.Array  # (3, 3), the rotation R_AB
    p: jax.Array  # (3,), the position of the origin of B
    omega: jax.Array  # (3,), angular velocity
    v: jax.Array  # (3,), velocity of the origin
    alpha: jax.Array  # (3,), angular acceleration
    a: jax.Array  # (3,), acceleration of the origin


class AccelerationTerms(NamedTuple):
    """The five terms (3,) whose sum is the acceleration of a point, in the axes of A."""

    transport: jax.Array
    euler: jax.Array
    centripetal: jax.Array
    coriolis: jax.Array
    relative: jax.Array


class ApparentForces(NamedTuple):
    """The apparent forces (3,) on a unit mass in a moving frame B, in the axes of B."""

    translation: jax.Array
    euler: jax.Array
    centrifugal: jax.Array
    coriolis: jax.Array


def moving_frame(path: Callable[[jax.Array], jax.Array], t: jax.Array) -> MovingFrame:
    """Compute the `MovingFrame` at time t of a path t -> pose (4, 4), by differentiation.

    >>> from rbjax.rotations import se3
    >>> turning = moving_frame(lambda t: se3.exp(t * jnp.array([0.0, 0, 2, 0, 0, 0])), 0.0)
    >>> turning.omega.tolist(), turning.alpha.tolist()
    ([0.0, 0.0, 2.0], [0.0, 0.0, 0.0])
    """

    def rate(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(path, (t,), (jnp.ones_like(t),))

    t = jnp.asarray(t, jnp.result_type(float, t))
    (T, dT), (_, ddT) = jax.jvp(rate, (t,), (jnp.ones_like(t),))
    if T.shape != (4, 4):
        raise InputError(f"moving_frame: the path gives shape {T.shape}, expected a pose (4, 4)")
    R, Rt = T[:3, :3], T[:3, :3].T
    # R'' R^T = [alpha] + [omega]^2, whose second term is symmetric
    omega, alpha = (so3.vee(matmat(d[:3, :3], Rt)) for d in (dT, ddT))
    return MovingFrame(R, T[:3, 3], omega, dT[:3, 3], alpha, ddT[:3, 3])


def position(frame: MovingFrame, r: jax.Array) -> jax.Array:
    """Compute the position p + R r (3,) in A of a point at r in B."""
    (r,) = _vectors("position", frame, r=r)
    return frame.p + matvec(frame.R, r)


def velocity(frame: MovingFrame, r: jax.Array, rd: jax.Array) -> jax.Array:
    """Compute the velocity (3,) in A of a point with position r and velocity rd in B's axes."""
    r, rd = _vectors("velocity", frame, r=r, rd=rd)
    return frame.v + jnp.cross(frame.omega, matvec(frame.R, r)) + matvec(frame.R, rd)


def acceleration_terms(
    frame: MovingFrame, r: jax.Array, rd: jax.Array, rdd: jax.Array
) -> AccelerationTerms:
    """Compute the terms of the acceleration in A of a point that moves in B.

    r, rd, rdd: (3,) position, velocity and acceleration of the point in B, in B's axes.
    """
    given = _vectors("acceleration_terms", frame, r=r, rd=rd, rdd=rdd)
    r, rd, rdd = (matvec(frame.R, x) for x in given)
    w = frame.omega
    return AccelerationTerms(
        transport=frame.a,
        euler=jnp.cross(frame.alpha, r),
        centripetal=jnp.cross(w, jnp.cross(w, r)),
        coriolis=2 * jnp.cross(w, rd),
        relative=rdd,
    )


def acceleration(frame: MovingFrame, r: jax.Array, rd: jax.Array, rdd: jax.Array) -> jax.Array:
    """Compute the acceleration (3,) in A of a point that moves in B.

    r, rd, rdd: (3,) position, velocity and acceleration of the point in B, in B's axes.

    >>> wheel = MovingFrame(jnp.eye(3), *jnp.zeros((5, 3)))._replace(omega=jnp.array([0.0, 0, 2]))
    >>> acceleration(wheel, [1.0, 0.0, 0.0], [3.0, 0.0, 0.0], jnp.zeros(3)).tolist()
    [-4.0, 12.0, 0.0]
    """
    terms = acceleration_terms(frame, r, rd, rdd)
    return sum(terms, start=jnp.zeros_like(terms.relative))


def apparent_forces(frame: MovingFrame, r: jax.Array, rd: jax.Array) -> ApparentForces:
    """Compute the apparent forces on a unit mass that moves in B, in B's axes.

    The relative acceleration is r'' = f / m + their sum, under a force f on a mass m.

    r, rd: (3,) position and velocity of the mass in B, in B's axes.

    >>> wheel = MovingFrame(jnp.eye(3), *jnp.zeros((5, 3)))._replace(omega=jnp.array([0.0, 0, 2]))
    >>> forces = apparent_forces(wheel, [1.0, 0.0, 0.0], [3.0, 0.0, 0.0])
    >>> forces.centrifugal[0].item(), forces.coriolis[1].item()
    (4.0, -12.0)
    """
    _known("apparent_forces", frame)
    terms = acceleration_terms(frame, r, rd, jnp.zeros_like(frame.a))
    return ApparentForces(*(-matvec(frame.R.T, x) for x in terms[:4]))


def relative_acceleration(
    frame: MovingFrame, r: jax.Array, rd: jax.Array, a: jax.Array
) -> jax.Array:
    """Compute the acceleration r'' (3,) in B of a point with the acceleration a (3,) in A.

    r, rd: (3,) position and velocity of the point in B, in B's axes.
    """
    (a,) = _vectors("relative_acceleration", frame, a=a)
    a = matvec(frame.R.T, a)
    return sum(apparent_forces(frame, r, rd), start=a)


def compose(outer: MovingFrame, inner: MovingFrame) -> MovingFrame:
    """Compute the motion of C in A from the motion of B in A (`outer`) and of C in B (`inner`).

    alpha_AC = alpha_AB + R alpha_BC + omega_AB x R omega_BC
    """
    _known("compose", outer, "outer"), _known("compose", inner, "inner")
    omega, alpha = matvec(outer.R, inner.omega), matvec(outer.R, inner.alpha)
    return MovingFrame(
        so3.compose(outer.R, inner.R),
        position(outer, inner.p),
        outer.omega + omega,
        velocity(outer, inner.p, inner.v),
        outer.alpha + alpha + jnp.cross(outer.omega, omega),
        acceleration(outer, inner.p, inner.v, inner.a),
    )


def inverse(frame: MovingFrame) -> MovingFrame:
    """Compute the motion of A in B from the motion of B in A."""
    _known("inverse", frame)
    Rt = frame.R.T
    r = -matvec(Rt, frame.p)
    rd = -matvec(Rt, frame.v + jnp.cross(frame.omega, -frame.p))
    rdd = relative_acceleration(frame, r, rd, jnp.zeros_like(frame.a))
    return MovingFrame(Rt, r, -matvec(Rt, frame.omega), rd, -matvec(Rt, frame.alpha), rdd)


def _known(where: str, frame: Any, name: str = "frame") -> MovingFrame:
    instance(where, name, frame, MovingFrame, "MovingFrame")
    return frame


def _vectors(where: str, frame: Any, **vectors: Any) -> list[jax.Array]:
    """Check a frame and vectors (3,), and return the vectors."""
    _known(where, frame)
    return [unbatched(where, name, x, "vector") for name, x in vectors.items()]
