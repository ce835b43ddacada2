"""Stiffness and damping of forces, for steps that are implicit in position or velocity.

    f = f(l, l'),      tau = r f,      d tau/dq = -k r r^T,      d tau/dv = -d r r^T
l is a length, r = dl/dq its moment arms, k = -df/dl the stiffness and d = -df/dl' the damping. The
moment arms are held constant. A wrench on a body, whose components f_a depend on all components of
the twist J v, is a sum of terms  d tau/dv = -sum of d_ab r_a r_b^T, with the rows r_a of J.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes import Lane, add, is_zero, mul


class Slope(NamedTuple):
    """The stiffness and damping of one force along moment arms.

    Fields:
        arms: moment arms r of the force, by dof.
        stiffness: k = -df/dl.
        damping: d = -df/dl'.
        along: moment arms of the length, if they are not those of the force.
    """

    arms: Mapping[int, Lane]
    stiffness: Lane
    damping: Lane
    along: Mapping[int, Lane] | None = None

    def scaled(self, factor: Callable[[Lane], Lane]) -> Slope:
        """Apply a function to stiffness and damping, and keep structural zeros."""
        k, d = (x if is_zero(x) else factor(x) for x in (self.stiffness, self.damping))
        return self._replace(stiffness=k, damping=d)


def derivatives(
    f: Callable[[Lane, Lane], Lane], length: Lane, speed: Lane, dtype: jax.typing.DTypeLike
) -> tuple[Lane, Lane]:
    """Compute the derivatives of a force f(l, l') by the length and by the speed."""
    at = [jnp.asarray(x, dtype) for x in (length, speed)]
    one, none = jnp.ones((), dtype), jnp.zeros((), dtype)
    directions = ((one, none), (none, one))
    by_length, by_speed = (jax.jvp(f, at, [*to])[1] for to in directions)
    return by_length, by_speed


def matrix(
    slopes: Iterable[Slope], weigh: Callable[[Slope], Lane], unsymmetric: Container[int] = ()
) -> dict[tuple[int, int], Lane]:
    """Sum w r r^T over slopes by entry, without structural zeros.

    Args:
        slopes: the slopes.
        weigh: the weight w of a slope.
        unsymmetric: the dofs whose entries are not replaced by the symmetric part.
    """
    out: dict[tuple[int, int], Lane] = {}

    def put(i: int, j: int, entry: Lane) -> None:
        if not is_zero(entry):
            out[i, j] = add(out.get((i, j), 0.0), entry)

    for slope in slopes:
        weight = weigh(slope)
        along = slope.arms if slope.along is None else slope.along
        for i, a in slope.arms.items():
            for j, b in along.items():
                entry = mul(mul(a, weight), b)
                if slope.along is None or (i in unsymmetric and j in unsymmetric):
                    put(i, j, entry)
                else:
                    put(i, j, mul(0.5, entry))
                    put(j, i, mul(0.5, entry))
    return out
