"""Lie groups of states, and terms whose rate is in the Lie algebra of the group.

    y' = y xi(t, y),    xi: the velocity in the axes of the moving frame
A vector space is the group `Vector`, so the same solver also integrates vector fields.

Source: Iserles, Munthe-Kaas, Norsett & Zanna, *Lie-group methods*, 2000.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.lanes import fusion_barrier
from rbjax.rotations import quaternion
from rbjax.rotations.coefficients import inverse_jacobian_coefficient, stumpff


class AbstractGroup(eqx.Module):
    """Base class of Lie groups: exponential map from the right, its inverse, and Lie bracket."""

    @abc.abstractmethod
    def retract(self, y: Any, u: Any) -> Any:
        """Return y exp(u)."""

    @abc.abstractmethod
    def difference(self, y: Any, z: Any) -> Any:
        """Return log(y^-1 z), the u with y exp(u) = z."""

    @abc.abstractmethod
    def bracket(self, u: Any, w: Any) -> Any:
        """Return the Lie bracket [u, w]."""


class Vector(AbstractGroup):
    """Group of pytrees of arrays under addition."""

    def retract(self, y, u):
        return jax.tree.map(lambda a, b: a + b, y, u)

    def difference(self, y, z):
        return jax.tree.map(lambda a, b: b - a, y, z)

    def bracket(self, u, w):
        return jax.tree.map(jnp.zeros_like, w)


class SO3(AbstractGroup):
    """Group of unit quaternions (4,). Its algebra is the rotation vectors (3,) in body axes."""

    def retract(self, y, u):
        return jnp.stack(fusion_barrier(quaternion.turned(list(y), list(u))))

    def difference(self, y, z):
        return quaternion.log(quaternion.normalize(quaternion.multiply(quaternion.conjugate(y), z)))

    def bracket(self, u, w):
        return jnp.cross(u, w)


class SE3(AbstractGroup):
    """Group of poses (quaternion (4,), position (3,)).

    Its algebra are pairs (rotation (3,), translation (3,)) in body axes, with

        exp(w, v) = (exp w, V v),  V = 1 + (1 - cos a) / a^2 [w] + (a - sin a) / a^3 [w]^2,  a = |w|
    """

    def retract(self, y, u):
        (turn, at), (w, v) = y, u
        once = jnp.cross(w, v)
        first, second = stumpff((w * w).sum(), 2, 3)
        step = v + first * once + second * jnp.cross(w, once)
        return SO3().retract(turn, w), at + _rotated(turn, step)

    def difference(self, y, z):
        w = SO3().difference(y[0], z[0])
        v = _rotated(quaternion.conjugate(y[0]), z[1] - y[1])
        once = jnp.cross(w, v)
        e = inverse_jacobian_coefficient((w * w).sum())
        return w, v - once / 2 + e * jnp.cross(w, once)

    def bracket(self, u, w):
        (a, x), (b, y) = u, w
        return jnp.cross(a, b), jnp.cross(a, y) + jnp.cross(x, b)


class Product(AbstractGroup):
    """Direct product of groups: a tuple of states, each in its own group.

    Fields:
        parts: the groups, one for each state.
    """

    parts: tuple[AbstractGroup, ...]

    def retract(self, y, u):
        return tuple(g.retract(a, b) for g, a, b in zip(self.parts, y, u, strict=True))

    def difference(self, y, z):
        return tuple(g.difference(a, b) for g, a, b in zip(self.parts, y, z, strict=True))

    def bracket(self, u, w):
        return tuple(g.bracket(a, b) for g, a, b in zip(self.parts, u, w, strict=True))


def _rotated(turn: jax.Array, v: jax.Array) -> jax.Array:
    return (quaternion.to_matrix(turn) * v).sum(-1)


class OnGroup(diffrax.AbstractTerm):
    """The equation y' = y xi(t, y) on a Lie group, as a diffrax term.

    Fields:
        vector_field: (t, y, args) -> xi.
        group: group of the states y.
        momentum: (t, y, args) -> p, linear in the velocity of y = (q, v), for
            `VariationalMidpoint`; None if the mass is constant.
    """

    vector_field: Callable[..., Any]
    group: AbstractGroup
    momentum: Callable[..., Any] | None = None

    def vf(self, t, y, args):
        return self.vector_field(t, y, args)

    def contr(self, t0, t1, **kwargs):
        return t1 - t0

    def prod(self, vf, control):
        return jax.tree.map(lambda x: control * x, vf)


def unwrap(terms: Any) -> Any:
    """Return the user's term, without diffrax's wrapper that may reverse time."""
    return getattr(terms, "term", terms)


def group_of(terms: Any) -> AbstractGroup:
    """Return the group of a term's states: `Vector` unless the term is `OnGroup`."""
    term = unwrap(terms)
    return term.group if isinstance(term, OnGroup) else Vector()
