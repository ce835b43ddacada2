"""Rows of the lengths of tendons, and couplings of two tendons.

The length of a straight piece is a `distance`. The length of a piece around a geom is a function of
the coordinates of its two sites in the axes of the geom. l_0 is a tendon's length in the
configuration in which the model file defines it (`model.tendons.length0`).

Source: MuJoCo, *XML reference*, equality/tendon.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax

from rbjax.constraints.rows.couplings import check_coefficients, polynomial
from rbjax.constraints.rows.geometry import AXES, Z, along, coordinate, distance
from rbjax.constraints.rows.row import Constraint, Row, function_of
from rbjax.forces.context import Context
from rbjax.forces.tendons.paths import Segment, segments
from rbjax.forces.tendons.wrapping import is_inside, wrapped
from rbjax.lanes import Vec3
from rbjax.model import Frame
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.model.record import check_fields, floats


class TendonPolynomial(Constraint):
    """A coupling l1 - l1_0 = sum of c_k (l2 - l2_0)^k of two tendons: MuJoCo's equality/tendon.

    Fields:
        tendon: static, name or index of tendon 1.
        driver: static, name or index of tendon 2; None for l1 - l1_0 = c_0.
        coefficients: (n,) from c_0, with n at least 1.

    Example:
        >>> import rbjax as rb
        >>> arm = '<body><joint name="j"/><geom size=".1" contype="0"/></body>'
        >>> belt = '<fixed name="belt"><joint joint="j" coef="2"/></fixed>'
        >>> text = f"<worldbody>{arm}</worldbody><tendon>{belt}</tendon>"
        >>> model = rb.load(f"<mujoco>{text}</mujoco>")
        >>> tight = rb.constraints.TendonPolynomial("belt", None, [0.5])
        >>> state = model.default_state()
        >>> rb.constraints.residual(model.with_constraints(tight), state).value.tolist()
        [-0.5]
    """

    tendon: str | int = eqx.field(static=True)
    driver: str | int | None = eqx.field(static=True)
    coefficients: jax.Array = eqx.field(converter=floats)
    size = 1

    def __check_init__(self) -> None:
        check_fields(self)
        check_coefficients(self, self.coefficients)

    def rows(self, context: Context) -> Sequence[Row]:
        return [polynomial(context, _from_reference, self.tendon, self.driver, self.coefficients)]


def _from_reference(context: Context, tendon: str | int) -> Row:
    own: Any = context.model.tendons
    reference = lane(table(own.length0, context.q.dtype), context.model.tendon(tendon))
    return tendon_row(context, tendon) - reference


def tendon_row(context: Context, tendon: str | int) -> Row:
    """Return the row whose value is the length of a tendon."""
    i, own = context.model.tendon(tendon), context.model.tendons
    assert own is not None
    path, first = own.paths[i], own.first_coefficient(i)
    coefficients = table(own.coefficients, context.q.dtype)
    out = Row.constant(0.0)
    if path and path[0].kind == "joint":
        for k, one in enumerate(path, first):
            out = out + coordinate(context, one.index) * lane(coefficients, k)
        return out
    for piece in segments(path, first):
        share = 1.0 if piece.pulley < 0 else 1 / lane(coefficients, piece.pulley)
        out = out + _segment_row(context, piece) * share
    return out


def _segment_row(context: Context, one: Segment) -> Row:
    """Return the row of the length of a tendon between two sites, straight or around a geom."""
    start, end = context.site(one.start), context.site(one.end)
    if one.geom is None:
        return distance(start, end)
    geom = context.frame(Frame(geom=one.geom.index))
    geoms, dtype = context.model.geoms, context.q.dtype
    assert geoms is not None
    kind = geoms.types[one.geom.index]
    radius = lane(table(geoms.size, dtype)[:, 0], one.geom.index)
    side, inside = None, False
    if one.geom.side >= 0:
        at = context.site(one.geom.side).position - geom.position
        side, inside = geom.rotation.T @ at, is_inside(at, radius)

    def length(x: jax.Array) -> jax.Array:
        found = wrapped(
            Vec3(*x[:3]), Vec3(*x[3:]), radius, axis=Z if kind == "cylinder" else None,
            side=side, inside=inside, dtype=dtype,
        )  # fmt: skip
        return found.length[None]

    rows = [along(geom, axis, site) for site in (start, end) for axis in AXES]
    return function_of(rows, length, dtype)[0]
