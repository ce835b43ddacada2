"""The free rigid body, and the splitting that turns it by exact rotations about its axes.

    q' = q (0, w) / 2,    J w' = J w x w + torque(t, q)
The kinetic energy is the sum of three terms m_i^2 / 2 J_i with m = J w. Under one term only, the
body turns about its axis i at the constant rate m_i / J_i while m turns the other way. The
symmetric product X(h/2) Y(h/2) Z(h) Y(h/2) X(h/2) is of order 2 and symplectic. It keeps the unit
length and the momentum in space exactly (McLachlan 1993; Hairer, Lubich & Wanner, *Geometric
Numerical Integration*, VII.5.3). A torque kicks m before and after.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.solvers.common.field import field, forwards
from rbjax.solvers.common.groups import SO3, AbstractGroup, OnGroup, Product, Vector, unwrapped
from rbjax.solvers.common.steps import AbstractGroupSolver, dense_between


class RigidBody(OnGroup):
    """A body about its centre or a fixed point: state (quaternion (4,), angular velocity (3,)).

    inertia (3,): principal moments, kg m^2, along the body axes; torque: (t, quaternion, args) ->
    (3,) in body axes, N m, or None. Any solver of terms on groups takes it.

    Raises:
        InputError: the inertia has another shape, or is not positive.
    """

    inertia: jax.Array  # type: ignore[misc]
    torque: Callable[..., jax.Array] | None  # type: ignore[misc]

    def __init__(self, inertia: Any, torque: Callable[..., jax.Array] | None = None):
        self.inertia = jnp.asarray(inertia)
        if self.inertia.shape != (3,):
            raise InputError(
                f"RigidBody: inertia has shape {self.inertia.shape}, expected (3,): the principal "
                "moments, along the body axes"
            )
        known = not isinstance(self.inertia, jax.core.Tracer)
        if known and not (np.asarray(self.inertia) > 0).all():
            raise InputError(f"RigidBody: inertia {self.inertia}, expected positive moments")
        self.torque = torque
        self.group: AbstractGroup = Product((SO3(), Vector()))
        self.vector_field = _no_field
        self.momentum = None

    def vf(self, t, y, args):
        turn, w = y
        m = self.inertia * w
        moment = jnp.cross(m, w) + self.moment(t, turn, args)
        return w, moment / self.inertia

    def moment(self, t, turn, args):
        """The torque (3,)."""
        return jnp.zeros(3, turn.dtype) if self.torque is None else self.torque(t, turn, args)


def _no_field(t, y, args):
    raise TypeError("RigidBody has its own equations")


class RigidBodySplitting(AbstractGroupSolver):
    """Exact rotations about the three axes, and kicks: order 2. Its term is a `RigidBody`."""

    term_structure: ClassVar[Any] = RigidBody

    def order(self, terms):
        return 2

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        body, h = unwrapped(terms), terms.contr(t0, t1)
        inertia = body.inertia
        ahead = forwards(terms, t0)
        turn, w = y0
        m = inertia * w + h / 2 * body.moment(ahead * t0, turn, args)
        for axis, share in ((0, 0.5), (1, 0.5), (2, 1.0), (1, 0.5), (0, 0.5)):
            angle = share * h * m[axis] / inertia[axis]
            turn = SO3().retract(turn, jnp.zeros(3, m.dtype).at[axis].set(angle))
            m = _turned_back(m, axis, angle)
        m = m + h / 2 * body.moment(ahead * t1, turn, args)
        y1 = (turn, m / inertia)
        dense = dense_between(body.group, field(terms, args), t0, t1, y0, y1)
        return y1, None, dense, None, diffrax.RESULTS.successful


def _turned_back(m: jax.Array, axis: int, angle: jax.Array) -> jax.Array:
    """m in axes that have turned by an angle about one of them.

    The change of m is added. A cosine near 1 would round the same way in each turn, and m would
    grow or shrink.
    """
    i, j = (axis + 1) % 3, (axis + 2) % 3
    versine, s = 2 * jnp.sin(angle / 2) ** 2, jnp.sin(angle)
    return m.at[i].add(s * m[j] - versine * m[i]).at[j].add(-s * m[i] - versine * m[j])
