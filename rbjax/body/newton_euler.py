"""Newton-Euler equations about the centre of mass or any body point P (Olguin Diaz, ch. 6).

With c from P to the centre of mass and a the acceleration of P, all in body axes:

    m (a + omega' x c + omega x (omega x c)) = f
    I_P omega' + omega x I_P omega + m c x a = n_P

About the centre of mass (c = 0) they separate. The velocities are omega in body axes and v of P in
world axes, so that a free body's centre of mass moves at a constant v.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax import spatial
from rbjax.body.body import Body, Situation, total_wrench
from rbjax.body.equations import (
    Spinning,
    State,
    attitude_matrix,
    coordinates,
    pose_of,
    quaternion_rate,
)
from rbjax.lanes import matvec
from rbjax.rotations import se3, so3


class NewtonEuler(Spinning):
    """The equations about `point` (3,) in the body's frame; None for the centre of mass."""

    def __init__(self, point: Any = None):
        super().__init__()
        self.point = None if point is None else np.asarray(point, float)

    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> State:
        r = self._point(body)
        q = coordinates(T)
        at = spatial.twist_at(V, r)
        R = attitude_matrix(q)
        q = q.at[:3].add(matvec(R, r))
        return State(q, jnp.concatenate([at[:3], matvec(R, at[3:])]))

    def rate(self, t: Any, y: State, args: Situation) -> State:
        body = args[0]
        omega, v, R = y.v[:3], y.v[3:], attitude_matrix(y.q)
        F = spatial.wrench_at(
            total_wrench(args, t, self.pose(body, y), self.twist(body, y)), self._point(body)
        )
        n, f = F[:3], F[3:]
        c = body.com - self._point(body)
        if self.point is None and body.added_mass is None:
            alpha = jnp.linalg.solve(
                body.inertia, n - jnp.cross(omega, matvec(body.inertia, omega))
            )
            a = f / body.mass
        else:
            I_P = spatial.parallel_axes(body.inertia, body.mass, c)
            n = n - jnp.cross(omega, matvec(I_P, omega))
            f = f - body.mass * jnp.cross(omega, jnp.cross(omega, c))
            mc = body.mass * so3.hat(c)
            M = jnp.block([[I_P, mc], [-mc, body.mass * jnp.eye(3, dtype=mc.dtype)]])
            if body.added_mass is not None:
                A, drag = self._fluid(body, jnp.concatenate([omega, matvec(R.T, v)]))
                M, n, f = M + A, n - drag[:3], f - drag[3:]
            x = jnp.linalg.solve(M, jnp.concatenate([n, f]))
            alpha, a = x[:3], x[3:]
        rate = jnp.concatenate([v, quaternion_rate(y.q[3:], omega)])
        return State(rate, jnp.concatenate([alpha, matvec(R, a)]))

    def pose(self, body: Body, y: State) -> jax.Array:
        T = pose_of(y.q)
        return T.at[:3, 3].add(-matvec(T[:3, :3], self._point(body)))

    def twist(self, body: Body, y: State) -> jax.Array:
        at = jnp.concatenate([y.v[:3], matvec(attitude_matrix(y.q).T, y.v[3:])])
        return spatial.twist_at(at, -self._point(body))

    def _point(self, body: Body) -> jax.Array:
        return body.com if self.point is None else jnp.asarray(self.point, body.com.dtype)

    def _fluid(self, body: Body, V: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Added mass A at P, and the wrench A (V' - (alpha, a)) + V x* A V that goes with it.

        a is the acceleration of a point, v' + omega x v, but the fluid's momentum changes with v'.
        """
        shift = se3.pose(jnp.eye(3, dtype=V.dtype), -self._point(body))
        A = spatial.transform_inertia(shift, body.added_mass)
        apart = jnp.concatenate([jnp.zeros(3, V.dtype), jnp.cross(V[:3], V[3:])])
        return A, spatial.force_cross(V, matvec(A, V)) - matvec(A, apart)
