"""Excitation trajectories: finite Fourier series, and splines from rest to rest.

Both have closed forms of q, v and a, which are differentiable by their coefficients:
    Fourier  q = q0 + sum_k a_k/(w k) sin(w k t) - b_k/(w k) cos(w k t),  w = 2 pi / period
    Spline   q = sum_i c_i B_i(t), B-splines of degree 5 on a clamped uniform knot vector
The first and the last three c of a spline are equal, which gives v = a = 0 at both ends.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, integer, real_array, real_number
from rbjax.display import displayed
from rbjax.errors import InputError

DEGREE = 5  # polynomial degree of the splines, for a smooth acceleration


@displayed
class Motion(NamedTuple):
    """A sampled trajectory.

    Fields:
        q: positions (samples, n) in rad, or m for slides.
        v: velocities (samples, n) in rad/s or m/s.
        a: accelerations (samples, n) in rad/s^2 or m/s^2.
    """

    q: jax.Array
    v: jax.Array
    a: jax.Array


def _seconds(x: Any) -> Any:
    """Convert a number to float. Return other values unchanged: `_check_time` rejects them."""
    return float(x) if isinstance(x, (int, float, np.number)) else x


@displayed
class Fourier(eqx.Module):
    """A finite Fourier series for each joint, with one common period.

    q = q0 + sum_k a_k/(w k) sin(w k t) - b_k/(w k) cos(w k t)
    v = sum_k a_k cos(w k t) + b_k sin(w k t)

    Args:
        q0: (n,) mean positions in rad or m.
        a: (n, harmonics) cosine coefficients of the velocity, in rad/s or m/s.
        b: (n, harmonics) sine coefficients of the velocity, in rad/s or m/s.
        period: period in s.

    Raises:
        InputError: inconsistent shapes, or a period that is not positive.

    Source: Swevers, Ganseman, Tuekel, De Schutter, Van Brussel 1997, equations 8 to 10.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid.design import Fourier
        >>> swing = Fourier(jnp.zeros(1), jnp.ones((1, 1)), jnp.zeros((1, 1)), period=2 * jnp.pi)
        >>> q, v, a = swing(jnp.array([0.0]))
        >>> q.tolist(), v.tolist(), abs(a).tolist()
        ([[0.0]], [[1.0]], [[0.0]])
    """

    q0: jax.Array
    a: jax.Array
    b: jax.Array
    period: float = eqx.field(static=True, converter=_seconds)

    def __check_init__(self) -> None:
        for name in ("q0", "a", "b"):
            _check_numbers("Fourier", name, getattr(self, name))
        shapes = [np.shape(x) for x in (self.q0, self.a, self.b)]
        if len(shapes[1]) != 2 or shapes[0] != shapes[1][:1] or shapes[1] != shapes[2]:
            raise InputError(
                f"Fourier: q0, a and b have shapes {shapes}, expected (n,), (n, harmonics) twice"
            )
        _check_time("Fourier", "period", self.period)

    def __call__(self, t: jax.Array) -> Motion:
        """Compute the trajectory at times t (samples,) in s."""
        w = 2 * np.pi / self.period * np.arange(1, self.a.shape[1] + 1)
        phase = jnp.asarray(t)[:, None] * w
        s, c = jnp.sin(phase), jnp.cos(phase)
        q = self.q0 + s @ (self.a / w).T - c @ (self.b / w).T
        return Motion(q, c @ self.a.T + s @ self.b.T, c @ (self.b * w).T - s @ (self.a * w).T)

    @property
    def duration(self) -> float:
        """The period in s."""
        return self.period

    @classmethod
    def random(
        cls, key: jax.Array, q0: ArrayLike, harmonics: int, period: float, speed: float = 0.1
    ) -> Fourier:
        """Draw normal coefficients for velocities with a standard deviation of `speed` in rad/s."""
        q0 = _random("Fourier.random", key, q0, speed)
        integer("Fourier.random", "harmonics", harmonics, least=1)
        shape = (2, len(q0), harmonics)
        a, b = speed / np.sqrt(harmonics) * jax.random.normal(key, shape)
        return cls(q0, a, b, period)


@displayed
class Spline(eqx.Module):
    """A quintic B-spline for each joint that starts and ends at rest.

    Args:
        points: (n, m) control points in rad or m, in order of time, with m of at least 3.
        duration: duration in s.

    Raises:
        InputError: too few points, or a duration that is not positive.

    Source: de Boor, *A Practical Guide to Splines*, IX (the recursion) and X (derivatives).

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid.design import Spline
        >>> reach = Spline(jnp.array([[0.0, 0.5, 1.0]]), duration=2.0)
        >>> q, v, a = reach(jnp.array([0.0, 1.0, 2.0]))
        >>> q.ravel().round(4).tolist(), v[0].tolist(), a[0].tolist()
        ([0.0, 0.5, 1.0], [0.0], [0.0])
    """

    points: jax.Array
    duration: float = eqx.field(static=True, converter=_seconds)

    def __check_init__(self) -> None:
        _check_numbers("Spline", "points", self.points)
        shape = np.shape(self.points)
        if len(shape) != 2 or shape[1] < 3:
            raise InputError(
                f"Spline: points has shape {shape}, expected (n, m), at least 3 points a joint"
            )
        _check_time("Spline", "duration", self.duration)

    def __call__(self, t: jax.Array) -> Motion:
        """Compute the trajectory at times t (samples,) in s, from 0 to the duration."""
        c = jnp.concatenate([self.points[:, :1]] * 2 + [self.points] + [self.points[:, -1:]] * 2, 1)
        inner = np.linspace(0, self.duration, c.shape[1] - DEGREE + 1)
        knots = np.concatenate([[0.0] * DEGREE, inner, [self.duration] * DEGREE])
        out = []
        for degree in (DEGREE, DEGREE - 1, DEGREE - 2):
            out.append(_basis(knots, degree, jnp.asarray(t)) @ c.T)
            c = degree * jnp.diff(c, axis=1) / (knots[degree + 1 : -1] - knots[1 : -degree - 1])
            knots = knots[1:-1]
        return Motion(*out)

    @classmethod
    def random(
        cls, key: jax.Array, q0: ArrayLike, points: int, duration: float, size: float = 0.1
    ) -> Spline:
        """Draw a trajectory from q0 back to q0.

        The offsets of the inner control points from q0 are normal with standard deviation `size` in
        rad.
        """
        q0 = _random("Spline.random", key, q0, size)
        integer("Spline.random", "points", points, least=3)
        away = size * jax.random.normal(key, (len(q0), points))
        return cls(q0[:, None] + away.at[:, [0, -1]].set(0.0), duration)


def _basis(knots: np.ndarray, degree: int, t: jax.Array) -> jax.Array:
    """Evaluate the B-splines (samples, functions) by Cox and de Boor's recursion with 0/0 = 0."""
    t = t[:, None]
    ends = (knots[1:] == knots[-1]) & (knots[:-1] < knots[-1])  # the last interval is closed
    B = ((knots[:-1] <= t) & ((t < knots[1:]) | (ends & (t <= knots[1:])))).astype(t.dtype)
    for p in range(1, degree + 1):
        rise, fall = knots[p:-1] - knots[: -p - 1], knots[p + 1 :] - knots[1:-p]
        up = np.divide(1.0, rise, where=rise > 0, out=np.zeros_like(rise))
        down = np.divide(1.0, fall, where=fall > 0, out=np.zeros_like(fall))
        B = (t - knots[: -p - 1]) * up * B[:, :-1] + (knots[p + 1 :] - t) * down * B[:, 1:]
    return B


def _random(where: str, key: Any, q0: Any, size: Any) -> jax.Array:
    """Check the arguments of `random` (key, q0 and size), and return q0 as an array."""
    if not jnp.issubdtype(getattr(key, "dtype", float), jax.dtypes.prng_key) and np.shape(key) != (
        2,
    ):
        raise InputError(f"{where}: key is {type(key).__name__}, expected jax.random.key(seed)")
    _check_numbers(where, "q0", q0)
    if np.ndim(q0) != 1:
        raise InputError(f"{where}: q0 has shape {np.shape(q0)}, expected (n,)")
    real_number(where, "the size of the motion", size, "a finite number")
    return jnp.asarray(q0, float)


def _check_numbers(where: str, name: str, x: Any) -> None:
    """Raise InputError unless x is an array of finite numbers or a JAX tracer."""
    if isinstance(x, jax.core.Tracer):
        return
    # skip other classes, which JAX and equinox use as placeholders for arrays
    if x is None or isinstance(x, (jax.Array, np.ndarray, str, list, tuple, int, float)):
        real_array(where, name, x, "an array of finite numbers")


def _check_time(where: str, name: str, seconds: Any) -> None:
    if not isinstance(seconds, float) or not 0 < seconds < np.inf:
        raise InputError(f"{where}: {name} is {seconds}, expected a positive time in s")
