"""Kirchhoff's equations: the motion from the kinetic energy T(omega, v) in body axes.

    d/dt dT/d omega + omega x dT/d omega + v x dT/d v = n
    d/dt dT/d v     + omega x dT/d v                  = f

T may be any kinetic energy, also that of a body in a fluid. The momenta are its gradient and the
inertia its second derivative, both by differentiation (Olguin Diaz, ch. 7; Lamb, *Hydrodynamics*,
124).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.body.body import Body, Situation, kinetic_energy, total_wrench
from rbjax.body.equations import (
    Spinning,
    State,
    attitude_matrix,
    coordinates,
    pose_of,
    quaternion_rate,
)
from rbjax.lanes import matvec


class Kirchhoff(Spinning):
    """Kirchhoff's equations, from T by differentiation; v is the body twist."""

    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> State:
        return State(coordinates(T), V)

    def rate(self, t: Any, y: State, args: Situation) -> State:
        body, V = args[0], y.v
        F = total_wrench(args, t, self.pose(body, y), V)

        def energy(V):
            return kinetic_energy(body, V)

        h = jax.grad(energy)(V)
        omega, v = V[:3], V[3:]
        n = F[:3] - jnp.cross(omega, h[:3]) - jnp.cross(v, h[3:])
        f = F[3:] - jnp.cross(omega, h[3:])
        acceleration = jnp.linalg.solve(jax.hessian(energy)(V), jnp.concatenate([n, f]))
        rate = jnp.concatenate([matvec(attitude_matrix(y.q), v), quaternion_rate(y.q[3:], omega)])
        return State(rate, acceleration)

    def pose(self, body: Body, y: State) -> jax.Array:
        return pose_of(y.q)

    def twist(self, body: Body, y: State) -> jax.Array:
        return y.v
