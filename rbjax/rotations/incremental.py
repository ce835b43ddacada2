"""Incremental orientation: a reference attitude, and a local parameter that stays near zero.

R = R_ref R(x). The three parameters x are integrated, x' = E^-1(x) omega_body. Before x comes near
the singularity of its representation, it is folded into the reference, R_ref <- R_ref R(x), x <- 0
(the updated-updated scheme of Masarati, 2.4.1). The reference is a unit quaternion, so a fold is
one product and causes no drift.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.lanes import matvec
from rbjax.rotations import quaternion
from rbjax.rotations.arguments import takes
from rbjax.rotations.euler import SEQUENCES
from rbjax.rotations.representation import Representation, find

__all__ = [
    "Incremental", "start", "attitude", "rate", "fold", "integrate",
]  # fmt: skip

# representations with three parameters that are zero for the identity and smooth at zero
LOCAL = (
    *("mrp", "wiener_milenkovic", "euler_vector", "gibbs", "cayley", "roll_pitch_yaw"),
    *(f"{k}_{s}" for k in ("intrinsic", "extrinsic") for s in SEQUENCES if s[0] != s[2]),
)


@displayed
class Incremental(NamedTuple):
    """The attitude R(reference) R(x): a reference, and a parameter that stays near zero.

    Fields:
        reference: (..., 4), unit quaternions, no unit.
        x: (..., 3), parameters in a local representation, such as MRP.
    """

    reference: jax.Array
    x: jax.Array


@takes(q="quaternion")
def start(q: jax.Array) -> Incremental:
    """Return the incremental attitude of a unit quaternion (..., 4), with x = 0.

    Args:
        q: (..., 4), unit quaternions, no unit.

    Returns:
        An `Incremental` with x = 0.

    Raises:
        InputError: another shape, values that are not finite, or a quaternion of length zero.

    Example:
        >>> from rbjax.rotations.incremental import start
        >>> start([1.0, 0.0, 0.0, 0.0]).x.tolist()
        [0.0, 0.0, 0.0]
    """
    q = quaternion.normalize(q)
    return Incremental(q, jnp.zeros_like(q[..., :3]))


def attitude(state: Incremental, local: str = "mrp") -> jax.Array:
    """Return the unit quaternion (..., 4) of a state whose x is in the representation `local`.

    Args:
        state: an `Incremental`.
        local: name of the representation of x; one of `LOCAL`.

    Returns:
        (..., 4), unit quaternions, no unit.

    Example:
        >>> from rbjax.rotations.incremental import attitude, start
        >>> attitude(start([1.0, 0.0, 0.0, 0.0])).tolist()
        [1.0, 0.0, 0.0, 0.0]
    """
    return quaternion.multiply(state.reference, _local(local).to_quaternion(state.x))


def rate(state: Incremental, omega: jax.Array, local: str = "mrp") -> jax.Array:
    """Compute x' (..., 3) from the angular velocity (..., 3) in body axes.

    Args:
        state: an `Incremental`.
        omega: (..., 3), angular velocities in body axes, rad/s.
        local: name of the representation of x; one of `LOCAL`.

    Returns:
        (..., 3), x', in the unit of x per second.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.incremental import rate, start
        >>> here = start([1.0, 0.0, 0.0, 0.0])
        >>> rate(here, jnp.array([0.0, 0.0, 1.0])).tolist()
        [0.0, 0.0, 0.25]
    """
    inverse = _local(local).inverse_body_rate_matrix(state.x)
    return matvec(inverse, omega)


def fold(state: Incremental, local: str = "mrp", margin: float | None = None) -> Incremental:
    """Fold x into the reference if x is nearer than `margin` (rad) to its singularity.

    The attitude does not change. The default margin is half the distance from zero to the
    singularity.

    Args:
        state: an `Incremental`.
        local: name of the representation of x; one of `LOCAL`.
        margin: least distance from the singularity, rad; None for half the distance of zero.

    Returns:
        An `Incremental` of the same attitude.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.incremental import Incremental, attitude, fold, quaternion
        >>> state = Incremental(quaternion.identity(), jnp.array([0.0, 0.0, 1.1]))
        >>> state = fold(state)
        >>> state.x.tolist(), attitude(state).round(3).tolist()
        ([0.0, 0.0, 0.0], [-0.095, 0.0, 0.0, 0.995])
    """
    rep = _local(local)
    left = rep.singularity_distance(state.x)
    zero = jnp.zeros_like(state.x)
    least = rep.singularity_distance(zero) / 2 if margin is None else margin
    due = (left < least)[..., None]
    moved = quaternion.normalize(attitude(state, local))
    return Incremental(jnp.where(due, moved, state.reference), jnp.where(due, zero, state.x))


def integrate(
    omega: Callable[[jax.Array, jax.Array], jax.Array],
    q: jax.Array,
    ts: jax.Array,
    *,
    local: str = "mrp",
    margin: float | None = None,
) -> jax.Array:
    """Integrate q' = q omega(t, q) / 2 from q to unit quaternions (len(ts), ..., 4) at times ts.

    omega is in body axes. The method is the classical Runge-Kutta method of order 4 on the local
    parameter, with one step from each time to the next and a `fold` after each step.

    Args:
        omega: function (t, q (..., 4)) -> angular velocity in body axes (..., 3), rad/s.
        q: (..., 4), initial unit quaternions, no unit.
        ts: (T,), times, s.
        local: name of the representation of x; one of `LOCAL`.
        margin: as in `fold`, rad.

    Returns:
        (T, ..., 4), unit quaternions.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.incremental import integrate, quaternion
        >>> ts = jnp.linspace(0.0, 10.0, 101)
        >>> turned = integrate(lambda t, q: jnp.array([0.0, 0.0, 1.0]), quaternion.identity(), ts)
        >>> bool(quaternion.distance(turned[-1], quaternion.exp([0.0, 0.0, 10.0])) < 1e-5)
        True
    """

    def slope(t, reference, x):
        here = Incremental(reference, x)
        return rate(here, omega(t, attitude(here, local)), local)

    def step(state, interval):
        t, h = interval[0], interval[1] - interval[0]
        r, x = state
        k1 = slope(t, r, x)
        k2 = slope(t + h / 2, r, x + h / 2 * k1)
        k3 = slope(t + h / 2, r, x + h / 2 * k2)
        k4 = slope(t + h, r, x + h * k3)
        state = fold(Incremental(r, x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)), local, margin)
        return state, attitude(state, local)

    first = start(q)
    intervals = jnp.stack([ts[:-1], ts[1:]], -1)
    _, later = jax.lax.scan(step, first, intervals)
    return jnp.concatenate([first.reference[None], later])


def _local(name: str) -> Representation:
    rep = find(name)
    if name not in LOCAL:
        raise InputError(
            f"{name!r} cannot be a local parameter, expected one that is smooth at zero and where "
            f"zero is no rotation: {', '.join(LOCAL)}"
        )
    return rep
