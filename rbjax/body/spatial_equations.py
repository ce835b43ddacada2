"""The equation of motion in spatial vectors, F = I A + V x* I V (Featherstone, 2.14-15).

It is the same in the body's own frame and about any point fixed in space. In space the rate of the
momentum is the wrench, so the momentum of a free body is constant.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax import spatial
from rbjax.body.body import Body, Situation, inertia_matrix, total_wrench
from rbjax.body.equations import (
    Spinning,
    State,
    accelerate,
    attitude_matrix,
    coordinates,
    pose_of,
    quaternion_rate,
)
from rbjax.lanes import matvec
from rbjax.rotations import se3


class _Spatial(Spinning):
    """The equation in the body's frame, or in world axes about a fixed point `about` (3,)."""

    def __init__(self, about: Any = None):
        super().__init__()
        self.about = None if about is None else np.asarray(about, float)

    def pose(self, body: Body, y: State) -> jax.Array:
        return pose_of(y.q)

    def _frame(self, q: jax.Array) -> jax.Array:
        """The pose of the body in the frame of the equation."""
        if self.about is None:
            return se3.identity(q.dtype)
        return pose_of(q).at[:3, 3].add(-jnp.asarray(self.about, q.dtype))

    def _inertia(self, body: Body, q: jax.Array) -> jax.Array:
        matrix = inertia_matrix(body)
        return matrix if self.about is None else spatial.transform_inertia(self._frame(q), matrix)

    def _wrench(self, t: Any, y: State, args: Situation) -> jax.Array:
        F = total_wrench(args, t, self.pose(args[0], y), self.twist(args[0], y))
        return F if self.about is None else spatial.transform_force(self._frame(y.q), F)

    def _coordinate_rate(self, body: Body, y: State) -> jax.Array:
        V = self.twist(body, y)
        v = matvec(attitude_matrix(y.q), V[3:])
        return jnp.concatenate([v, quaternion_rate(y.q[3:], V[:3])])


class Spatial(_Spatial):
    """v is the twist: I A = F - V x* I V."""

    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> State:
        q = coordinates(T)
        return State(q, V if self.about is None else spatial.transform_motion(self._frame(q), V))

    def rate(self, t: Any, y: State, args: Situation) -> State:
        M = self._inertia(args[0], y.q)
        A = accelerate(M, y.v, self._wrench(t, y, args))
        return State(self._coordinate_rate(args[0], y), A)

    def twist(self, body: Body, y: State) -> jax.Array:
        if self.about is None:
            return y.v
        return spatial.transform_motion(se3.inverse(self._frame(y.q)), y.v)


class Momentum(_Spatial):
    """v is the momentum h = I V: h' = F in space, h' = F - V x* h in the body's frame."""

    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> State:
        q = coordinates(T)
        h = matvec(inertia_matrix(body), V)
        return State(q, h if self.about is None else spatial.transform_force(self._frame(q), h))

    def rate(self, t: Any, y: State, args: Situation) -> State:
        F = self._wrench(t, y, args)
        if self.about is None:
            F = F - spatial.force_cross(self.twist(args[0], y), y.v)
        return State(self._coordinate_rate(args[0], y), F)

    def twist(self, body: Body, y: State) -> jax.Array:
        h = y.v
        if self.about is not None:
            h = spatial.transform_force(se3.inverse(self._frame(y.q)), h)
        return jnp.linalg.solve(inertia_matrix(body), h)
