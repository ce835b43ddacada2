"""The common signature of the formulations of one body's motion. They are interchangeable.

    y0 = f.initial(body, T, V)         from pose and body twist to the state of the formulation
    f.rate(t, y, (body, forces))       the vector field: `diffrax.ODETerm(f.rate)` is `f.term()`
    f.pose(body, y), f.twist(body, y)  and back

A state is (q, v): q = [position (3), attitude], v the formulation's own velocities or momenta.
"""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp

from rbjax import spatial
from rbjax.body.body import Body, Situation
from rbjax.lanes import matvec
from rbjax.rotations import quaternion, se3
from rbjax.rotations.representation import Representation, find


class State(NamedTuple):
    """q (3 + size of the attitude), v (6,)."""

    q: jax.Array
    v: jax.Array


class Formulation(abc.ABC):
    """The motion of one rigid body, in its own coordinates and velocities."""

    def __init__(self, attitude: str):
        self.attitude: Representation = find(attitude)

    @abc.abstractmethod
    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> State:
        """The state of a body with pose T (4, 4) and body twist V (6,)."""

    @abc.abstractmethod
    def rate(self, t: Any, y: State, args: Situation) -> State:
        """The state's rate under the forces."""

    @abc.abstractmethod
    def pose(self, body: Body, y: State) -> jax.Array:
        """T (4, 4) of the body's frame."""

    @abc.abstractmethod
    def twist(self, body: Body, y: State) -> jax.Array:
        """V (6,) = (omega, v) of the body's frame, in its axes."""

    def term(self) -> diffrax.ODETerm:
        """For diffrax, with (body, forces) as args."""
        return diffrax.ODETerm(self.rate)

    def singularity_distance(self, y: State) -> jax.Array:
        """The angle to the nearest singularity of the equations; inf if there is none."""
        return self.attitude.singularity_distance(y.q[3:])

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.attitude.name!r})"


class Spinning(Formulation):
    """Attitude as a quaternion. Its rate is linear in it, so its length has no effect."""

    def __init__(self) -> None:
        super().__init__("unit_quaternion")

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"


def attitude_matrix(q: jax.Array) -> jax.Array:
    """R of the quaternion in q."""
    return quaternion.to_matrix(q[3:])


def pose_of(q: jax.Array) -> jax.Array:
    """T of [position, quaternion]."""
    return se3.pose(attitude_matrix(q), q[:3])


def coordinates(T: jax.Array) -> jax.Array:
    """[position, quaternion] of T."""
    return jnp.concatenate([T[:3, 3], quaternion.from_matrix(T[:3, :3])])


def quaternion_rate(q: jax.Array, omega: jax.Array) -> jax.Array:
    """q (0, omega) / 2, with omega in body axes."""
    return quaternion.multiply(q, jnp.concatenate([jnp.zeros(1, q.dtype), omega])) / 2


def accelerate(M: jax.Array, V: jax.Array, F: jax.Array) -> jax.Array:
    """V' from M V' + V x* M V = F."""
    return jnp.linalg.solve(M, F - spatial.force_cross(V, matvec(M, V)))
