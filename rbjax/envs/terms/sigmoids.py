"""`tolerance`: 1 inside an interval, and a sigmoid of the distance outside of it.

With d = max(lower - x, x - upper, 0) / margin and v the value at d = 1:
    gaussian      exp(-(a d)^2 / 2),      a = sqrt(-2 ln v)
    hyperbolic    1 / cosh(a d),          a = arcosh(1 / v)
    long_tail     1 / (1 + (a d)^2),      a = sqrt(1 / v - 1)
    reciprocal    1 / (1 + a d),          a = 1 / v - 1
    cosine        (1 + cos(pi a d)) / 2,  a = arccos(2 v - 1) / pi,  0 beyond a d = 1
    linear        1 - a d,                a = 1 - v,                 0 beyond a d = 1
    quadratic     1 - (a d)^2,            a = sqrt(1 - v),           0 beyond a d = 1
    tanh_squared  1 - tanh(a d)^2,        a = artanh(sqrt(1 - v))
(Tassa et al., *DeepMind Control Suite*, 2018, sec. 2.4, and its module `rewards`.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, floating_array, real_array, real_number, shown
from rbjax.errors import InputError


class Sigmoid(NamedTuple):
    """A function of x = a d >= 0 that is 1 at x = 0.

    scale: the number a at which the value at d = 1 is v.
    value: the function of x.
    reaches_zero: whether v = 0 is possible.
    """

    scale: Callable[[float], float]
    value: Callable[[jax.Array], jax.Array]
    reaches_zero: bool = False


def _cosine(x: jax.Array) -> jax.Array:
    return (1 + jnp.cos(math.pi * jnp.minimum(x, 1.0))) / 2


SIGMOIDS = {
    "gaussian": Sigmoid(lambda v: math.sqrt(-2 * math.log(v)), lambda x: jnp.exp(-0.5 * x * x)),
    "hyperbolic": Sigmoid(
        lambda v: math.acosh(1 / v), lambda x: 2 * jnp.exp(-x) / (1 + jnp.exp(-2 * x))
    ),
    "long_tail": Sigmoid(lambda v: math.sqrt(1 / v - 1), lambda x: 1 / (1 + x * x)),
    "reciprocal": Sigmoid(lambda v: 1 / v - 1, lambda x: 1 / (1 + x)),
    "cosine": Sigmoid(lambda v: math.acos(2 * v - 1) / math.pi, _cosine, True),
    "linear": Sigmoid(lambda v: 1 - v, lambda x: jnp.maximum(1 - x, 0.0), True),
    "quadratic": Sigmoid(lambda v: math.sqrt(1 - v), lambda x: jnp.maximum(1 - x * x, 0.0), True),
    "tanh_squared": Sigmoid(lambda v: math.atanh(math.sqrt(1 - v)), lambda x: 1 - jnp.tanh(x) ** 2),
}


def tolerance(
    x: Any,
    bounds: tuple[Any, Any] = (0.0, 0.0),
    margin: Any = 0.0,
    sigmoid: str = "gaussian",
    value_at_margin: float = 0.1,
) -> jax.Array:
    """Compute 1 for x inside of bounds, and a value that falls from 1 to 0 with the distance.

    Use it for rewards between 0 and 1, which can be multiplied. The derivative is finite at each x.

    Args:
        x: a number () or an array (...), of any unit.
        bounds: the lower and the upper bound, which may be infinite or equal, in the unit of x.
        margin: the distance from the bounds at which the result is `value_at_margin`, in the unit
            of x. 0: the result is 0 outside of the bounds.
        sigmoid: the shape outside of the bounds, a name of the table above.
        value_at_margin: the value at the margin, between 0 and 1; 0 only for "cosine", "linear" and
            "quadratic".

    Returns:
        (...), values in the shape and dtype of x; NaN for x = NaN if the margin is not 0.

    Raises:
        InputError: bounds in the wrong order, a negative margin, a value at the margin out of
            its range.
        UnknownName: no sigmoid has this name.

    Source: Tassa et al., *DeepMind Control Suite*, 2018, sec. 2.4.

    Example:
        >>> from rbjax.envs.terms import tolerance
        >>> far = float("inf")
        >>> float(tolerance(0.8, (1.0, far), 0.4, "linear", value_at_margin=0.5))
        0.75
    """
    choice("sigmoid", sigmoid, SIGMOIDS)
    real_number("tolerance", "value_at_margin", value_at_margin)
    if _known(margin):
        margin = real_number("tolerance", "margin", margin, least=0.0)
    shape = SIGMOIDS[sigmoid]
    low, high = _bounds(bounds)
    least = 0.0 if shape.reaches_zero else math.ulp(0.0)
    if not least <= value_at_margin < 1:
        raise InputError(
            f"tolerance: value_at_margin is {value_at_margin} for the sigmoid {sigmoid!r}, "
            f"expected a number {'at least' if shape.reaches_zero else 'above'} 0 and below 1"
        )
    x = floating_array("tolerance", "x", x, lambda shape: True, "of numbers")
    if _known(margin) and margin == 0:
        return jnp.where((low <= x) & (x <= high), jnp.ones_like(x), 0.0)
    d = jnp.maximum(jnp.maximum(low - x, x - high), 0.0)
    if _known(margin):
        return shape.value(d * (shape.scale(value_at_margin) / margin))
    wide = margin > 0
    found = shape.value(d * (shape.scale(value_at_margin) / jnp.where(wide, margin, 1.0)))
    inside = jnp.where((low <= x) & (x <= high), jnp.ones_like(x), 0.0)
    return jnp.where(wide, found, inside)


def _known(x: Any) -> bool:
    """Return whether Python can compare x: an array of JAX may become traced when it is used."""
    return not isinstance(x, jax.Array)


def _bounds(bounds: Any) -> tuple[Any, Any]:
    """Return the two bounds; Python floats if they are known."""
    pair = isinstance(bounds, tuple | list) or np.ndim(bounds) > 0
    if not pair or len(bounds) != 2:
        raise InputError(f"tolerance: bounds are {shown(bounds)}, expected a pair (lower, upper)")
    for b in filter(_known, bounds):
        real_array("tolerance", "bounds", b, finite=False)
    low, high = (
        (float(b) if np.ndim(b) == 0 else np.asarray(b)) if _known(b) else b for b in bounds
    )
    if _known(low) and _known(high) and not np.all(low <= high):
        raise InputError(
            f"tolerance: bounds are ({low}, {high}), expected lower <= upper; exchange them"
        )
    return low, high
