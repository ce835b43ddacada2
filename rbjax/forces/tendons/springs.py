"""Springs and dampers of the tendons of a model.

    x = l - l_high  if l > l_high,    l - l_low  if l < l_low,    else 0
    F = x (k_0 + k_1 x + ...) + l' (d_0 + d_1 |l'| + ...),      tau_n = -r_n F
(MuJoCo, *Computation*, passive forces.) l is the length of the tendon and r_n its moment arms.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads
from rbjax.forces.joints.polynomials import polynomial
from rbjax.forces.place import Place
from rbjax.forces.slopes import Slope
from rbjax.forces.springs import PointSpring, coefficients, stretch, stretch_energy
from rbjax.forces.tendons.paths import tendon_reach
from rbjax.lanes import Lane, add, is_zero, mul, neg, total
from rbjax.model import Model
from rbjax.model.leaves import table


class TendonSprings(Element):
    """The springs and dampers of `model.tendons`. Tendons without stiffness and damping cost
    nothing if their parameters are compile-time constants."""

    def loads(self, context: Context) -> Loads:
        out = Loads()
        for i, k, d in _springs(context):
            direct = _point_spring(context.model, i)
            if direct is not None:
                out = out + direct.loads(context)
                continue
            reach, force = tendon_reach(context, i), _force(context, i, k, d)
            out = out + Loads({n: neg(mul(arm, force)) for n, arm in reach.arms.items()})
        return out

    def slopes(self, context: Context) -> list[Slope]:
        """Compute the damping and stiffness of each tendon."""
        out = []
        for i, k, d in _springs(context):
            reach = tendon_reach(context, i)
            shares = [mul(n, c) for n, c in enumerate(d, 1)]
            damping = shares[0]
            if len(shares) > 1:
                speed = jnp.abs(jnp.asarray(reach.speed(context), context.q.dtype))
                damping = add(damping, polynomial(shares[1:], speed))
            stiffness: Lane = 0.0
            if not all(map(is_zero, k)):
                x = _stretch(context, i, reach.length)
                shares = [mul(n, c) for n, c in enumerate(k, 1)]
                stiffness = jnp.where(x != 0, add(shares[0], polynomial(shares[1:], x)), 0.0)
            out.append(Slope(reach.arms, stiffness, damping))
        return out

    def energy(self, context: Context) -> Lane:
        """Compute the energy, the sum of x^2 (k_0 / 2 + k_1 x / 3 + ...) over stretches x of
        tendons, J."""
        return total(_energy(context, i, k) for i, k, _ in _springs(context))


def spring_forces(context: Context) -> dict[int, Lane]:
    """Compute the forces of the springs and dampers of tendons, positive if they pull."""
    if context.model.tendons is None:
        return {}
    return {i: _force(context, i, k, d) for i, k, d in _springs(context)}


def _force(context: Context, i: int, k: list[Lane], d: list[Lane]) -> Lane:
    reach = tendon_reach(context, i)
    force: Lane = 0.0
    if not all(map(is_zero, k)):
        x = _stretch(context, i, reach.length)
        force = mul(add(k[0], polynomial(k[1:], x)), x)
    if not all(map(is_zero, d)):
        rate = jnp.asarray(reach.speed(context), context.q.dtype)
        size = jnp.abs(rate) if len(d) > 1 else 0.0
        force = add(force, mul(add(d[0], polynomial(d[1:], size)), rate))
    return force


#: the element of all tendons of a model; it has no parameters of its own
TENDON_SPRINGS = TendonSprings()


def tendon_springs(model: Model) -> tuple[Element, ...]:
    """Return the element of the springs and dampers of a model's tendons, if it has tendons."""
    return () if model.tendons is None else (TENDON_SPRINGS,)


def _springs(context: Context) -> Iterator[tuple[int, list[Lane], list[Lane]]]:
    """Iterate over the tendons with stiffness or damping: index and polynomial coefficients."""
    own: Any = context.model.tendons
    dtype = context.q.dtype
    stiffness, damping = table(own.stiffness, dtype), table(own.damping, dtype)
    for i in range(len(own.names)):
        k, d = coefficients(stiffness[i], dtype), coefficients(damping[i], dtype)
        if not all(map(is_zero, (*k, *d))):
            yield i, k, d


def _point_spring(model: Model, i: int) -> PointSpring | None:
    """Return the spring of a tendon between two sites, or None if the tendon has another path. If
    its rest length is zero, its force is smooth at the length zero."""
    own: Any = model.tendons
    if [x.kind for x in own.paths[i]] != ["site", "site"]:
        return None
    origin: Any = np.zeros(3)  # NumPy arrays are constants while tracing
    aligned: Any = np.array([1.0, 0.0, 0.0, 0.0])
    a, b = (Place(origin, aligned, site=x.index) for x in own.paths[i])
    columns: Any = (own.stiffness, own.damping, own.springlength)
    return PointSpring(a, b, *(table(x, x.dtype)[i] for x in columns))


def _energy(context: Context, i: int, k: list[Lane]) -> Lane:
    direct = _point_spring(context.model, i)
    if direct is not None:
        return direct.energy(context)
    if all(map(is_zero, k)):
        return 0.0
    return stretch_energy(k, _stretch(context, i, tendon_reach(context, i).length))


def _stretch(context: Context, i: int, length: Lane) -> Lane:
    own: Any = context.model.tendons
    length = jnp.asarray(length, context.q.dtype)
    return stretch(length, 1.0, table(own.springlength, context.q.dtype)[i], context.q.dtype)[0]
