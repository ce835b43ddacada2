"""Couplings: a joint coordinate as a function of another coordinate, or of time. One row each.

r is a joint's reference: its coordinate in the configuration in which the model file defines it.

Source: MuJoCo, *XML reference*, equality/joint; URDF, mimic; Haug, *Computer-Aided Kinematics and
Dynamics*, 9.5.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.constraints.rows.functions import check_function, evaluate
from rbjax.constraints.rows.geometry import coordinate, time
from rbjax.constraints.rows.row import Constraint, Row
from rbjax.dynamics.arguments import check_takes
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.model.leaves import numbers, scalar, table
from rbjax.model.links import lane
from rbjax.model.record import check_fields, check_number, floats


class JointPolynomial(Constraint):
    """A coupling of two joints, q1 - r1 = sum of c_k (q2 - r2)^k: MuJoCo's equality/joint, URDF's
    mimic.

    Fields:
        joint: static, name or index of joint 1, which has one coordinate.
        driver: static, name or index of joint 2, which has one coordinate; None for q1 - r1 = c_0.
        coefficients: (n,) from c_0, with n at least 1.

    Example:
        >>> import rbjax as rb
        >>> bend = rb.constraints.JointPolynomial("elbow", "shoulder", [0.1, -2.0])
        >>> model = rb.load("double_pendulum").with_constraints(bend)
    """

    joint: str | int = eqx.field(static=True)
    driver: str | int | None = eqx.field(static=True)
    coefficients: jax.Array = eqx.field(converter=floats)
    size = 1

    def __check_init__(self) -> None:
        check_fields(self)
        check_coefficients(self, self.coefficients)

    def rows(self, context: Context) -> Sequence[Row]:
        return [polynomial(context, from_reference, self.joint, self.driver, self.coefficients)]


class Gear(Constraint):
    """A gear between two hinges: q1 - r1 = ratio (q2 - r2).

    Fields:
        joint, driver: static, names or indices of hinges 1 and 2.
        ratio: (), transmission ratio, negative for externally meshing wheels.
    """

    joint: str | int = eqx.field(static=True)
    driver: str | int = eqx.field(static=True)
    ratio: jax.Array = eqx.field(converter=floats)
    size = 1

    def __check_init__(self) -> None:
        check_number(self, "ratio")

    def rows(self, context: Context) -> Sequence[Row]:
        return [_proportional(context, (self.joint, "hinge"), self.driver, self.ratio)]


class Rack(Constraint):
    """A rack (slide 1) and its pinion (hinge 2): q1 - r1 = radius (q2 - r2).

    Fields:
        joint: static, name or index of the slide.
        driver: static, name or index of the hinge.
        radius: (), pitch radius of the pinion, m; negative for the other side of the pinion.
    """

    joint: str | int = eqx.field(static=True)
    driver: str | int = eqx.field(static=True)
    radius: jax.Array = eqx.field(converter=floats)
    size = 1

    def __check_init__(self) -> None:
        check_number(self, "radius")

    def rows(self, context: Context) -> Sequence[Row]:
        return [_proportional(context, (self.joint, "slide"), self.driver, self.radius)]


class Prescribed(Constraint):
    """A joint coordinate that is a given function of time: q = f(t).

    Fields:
        joint: static, name or index of a joint of one coordinate.
        function: static, t () -> rad or m, twice differentiable. Each function is compiled once.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> swing = rb.constraints.Prescribed("hinge", lambda t: 0.3 * jnp.sin(2 * t))
        >>> model = rb.load("pendulum").with_constraints(swing)
    """

    joint: str | int = eqx.field(static=True)
    function: Callable[[Any], Any] = eqx.field(static=True)
    size = 1

    def __check_init__(self) -> None:
        check_function("Prescribed(function=...)", self.function)
        check_takes("Prescribed", "function", self.function, "t")

    def rows(self, context: Context) -> Sequence[Row]:
        _check_kind(context, self.joint, None)

        def f(t: Any) -> Any:
            return evaluate("Prescribed: function", self.function, None, (t,), (), context.q.dtype)

        return [coordinate(context, self.joint) - time(context).apply(f)]


def check_coefficients(coupling: Constraint, coefficients: jax.Array) -> None:
    """Raise `InputError` unless the coefficients of a polynomial are an array (n,), n > 0."""
    shape = jnp.shape(coefficients)
    if len(shape) != 1 or not shape[0]:
        raise InputError(
            f"{type(coupling).__name__}(coefficients=...): got the shape {shape}, expected (n,) "
            "with n at least 1, c_0 first"
        )


def polynomial(
    context: Context, row: Callable[..., Row], own: Any, driver: Any, coefficients: jax.Array
) -> Row:
    """Build the row x1 - r1 - sum of c_k (x2 - r2)^k; row(context, k) builds the row x_k - r_k."""
    c = numbers(coefficients, context.q.dtype)
    if driver is None:
        return row(context, own) - c[0]
    x, out = row(context, driver), Row.constant(c[-1])
    for each in reversed(c[:-1]):
        out = out * x + each
    return row(context, own) - out


def _proportional(context: Context, joint: tuple, driver: str | int, factor: jax.Array) -> Row:
    """Build the row q1 - r1 - factor (q2 - r2), with r the reference of a coordinate.
    joint: (name, kind) of joint 1. driver: joint 2, a hinge."""
    driven = from_reference(context, driver, "hinge")
    return from_reference(context, *joint) - driven * scalar(factor, context.q.dtype)


def from_reference(context: Context, joint: str | int, kind: str | None = None) -> Row:
    """Build the row q - r, with r the reference of a joint of one coordinate.
    Raise InputError if the kind of the joint is not `kind`."""
    _check_kind(context, joint, kind)
    start = context.model.topology.joint_q[context.model.joint(joint)]
    reference = lane(table(context.model.joints.reference, context.q.dtype), start)
    return coordinate(context, joint) - reference


def _check_kind(context: Context, joint: str | int, kind: str | None) -> None:
    found = context.joint(joint)
    if len(found.q) != 1 or kind not in (None, found.kind):
        raise InputError(
            f"a coupling has joint {joint!r}, a {found.kind}, expected a "
            f"{kind or 'joint of one coordinate, such as a hinge or a slide'}"
        )
