"""Springs and dampers of joints, with polynomial force laws.

    hinge, slide:                       tau = -x (k_0 + k_1 x + k_2 x^2 + ...)
    ball, each half of a free joint:    tau = -x (k_0 + k_1 |x| + k_2 |x|^2 + ...)
    each dof:                           tau = -v (d_0 + d_1 |v| + d_2 |v|^2 + ...)

x is the displacement of a joint from `model.joints.springref`, in the coordinates of v (MuJoCo,
*Computation*, passive forces). The linear terms k_0, d_0 are the model's `joints.stiffness` and
`joints.damping`. Dampers are odd in v, so that positive coefficients dissipate. Springs of hinges
and slides are not odd in x, as in MuJoCo: k_1 makes a spring stiffer on one side and softer on the
other. The potential is

    V = x^2 (k_0 / 2 + k_1 x / 3 + k_2 x^2 / 4 + ...),

with |x| for a ball: the torque -f(|x|) x / |x| on the tangent is conservative, because the rate of
the angle |x| is x . w / |x|.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.dynamics.algorithms.manifold import difference_lanes
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes, coordinates
from rbjax.forces.slopes import Slope
from rbjax.lanes import Lane, add, inner, is_zero, mul, neg, safe_sqrt, total
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane


class JointPolynomials(Element):
    """Polynomial springs and dampers of joints, by default without the linear terms of the model.

    tau = -x (k_1 x + k_2 x^2 + ...) - v (d_1 |v| + d_2 |v|^2 + ...); for balls and free joints with
    |x| instead of x within the brackets.

    Fields:
        stiffness: (n, s), a row per joint: k_1 in N m/rad^2 or N/m^2, and so on.
        damping: (m, d), a row per dof of these joints: d_1 in N m s^2/rad^2 or N s^2/m^2, and so
            on.
        joints: names or indices; static.
        lowest: index of the first coefficients, 0 or 1; static.

    Source: MuJoCo 4, XML reference, joint, stiffness and damping.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("pendulum")
        >>> cubic = rb.forces.JointPolynomials(
        ...     jnp.array([[0.0, 3.0]]), jnp.zeros((1, 1)), model.joint_names
        ... )
        >>> state = model.default_state().replace(q=jnp.array([2.0]))
        >>> rb.applied_forces(model.with_forces(cubic), state).tolist()
        [-24.0]
    """

    stiffness: jax.Array
    damping: jax.Array
    joints: tuple[str | int, ...] = eqx.field(static=True)
    lowest: int = eqx.field(static=True, default=1)
    unlimited = ()

    def shapes(self, model: Model) -> Shapes:
        return {
            "stiffness": (len(self.joints), None),
            "damping": (coordinates(model, self.joints), None),
        }

    def loads(self, context: Context) -> Loads:
        out: dict[int, Lane] = {}
        for coefficients, at, x in self._springs(context):
            k = self._polynomial(coefficients, x)
            out |= {at + i: neg(mul(k, y)) for i, y in enumerate(x)}
        damping, row = table(self.damping, context.v.dtype), 0
        for joint in map(context.joint, self.joints):
            for i, v in enumerate(joint.v, joint.start):
                coefficients = row_lanes(damping, row)
                if not all(map(is_zero, coefficients)):
                    size = [jnp.abs(v)] if self.lowest or len(coefficients) > 1 else [v]
                    drag = mul(self._polynomial(coefficients, size), v)
                    out[i] = add(out.get(i, 0.0), neg(drag))
                row += 1
        return Loads(out)

    def slopes(self, context: Context) -> list[Slope]:
        """Compute the damping and stiffness of each dof. The stiffness of the three rotations or
        translations of a joint is the derivative along the displacement."""
        damping, stiffness = table(self.damping, context.v.dtype), dict[int, Lane]()
        for coefficients, at, x in self._springs(context):
            shares = [mul(n, c) for n, c in enumerate(coefficients, self.lowest + 1)]
            stiffness |= dict.fromkeys(range(at, at + len(x)), self._polynomial(shares, x))
        out: list[Slope] = []
        for joint in map(context.joint, self.joints):
            for i, v in enumerate(joint.v, joint.start):
                k = stiffness.get(i, 0.0)
                coefficients = row_lanes(damping, len(out))
                shares = [mul(n, c) for n, c in enumerate(coefficients, self.lowest + 1)]
                speed = [jnp.abs(v)] if self.lowest or len(shares) > 1 else [v]
                out.append(Slope({i: 1.0}, k, self._polynomial(shares, speed)))
        return out

    def energy(self, context: Context) -> Lane:
        """Compute the potential energy of the springs, J."""

        def stored(coefficients: Sequence[Lane], x: Sequence[Lane]) -> Lane:
            shares = [mul(1 / n, k) for n, k in enumerate(coefficients, self.lowest + 2)]
            return mul(self._polynomial(shares, x), inner(x, x))

        return total(stored(coefficients, x) for coefficients, _, x in self._springs(context))

    def _springs(self, context: Context) -> list[tuple[list[Lane], int, list[Lane]]]:
        """List the coefficients, first dof and displacement of each spring. A free joint has one
        spring for its translation and one for its rotation."""
        stiffness, out = table(self.stiffness, context.q.dtype), []
        for row, name in enumerate(self.joints):
            coefficients = row_lanes(stiffness, row)
            if all(map(is_zero, coefficients)):
                continue
            index = context.model.joint(name)
            x, at = displacement(context, index), context.model.topology.joint_v[index]
            out += [(coefficients, at + i, x[i : i + 3]) for i in range(0, len(x), 3)]
        return out

    def _polynomial(self, coefficients: Sequence[Lane], x: Sequence[Lane]) -> Lane:
        """Evaluate the polynomial in x, or in the length of a vector x."""
        if not self.lowest and len(coefficients) == 1:
            return coefficients[0]
        size = x[0] if len(x) == 1 else safe_sqrt(inner(x, x))
        if self.lowest:
            return polynomial(coefficients, size)
        return add(coefficients[0], polynomial(coefficients[1:], size))


def linear_springs(model: Model) -> JointPolynomials:
    """Make an element of the linear springs and dampers of a model's joints."""
    own = model.joints
    stiffness, damping = (table(x, x.dtype)[:, None] for x in (own.stiffness, own.damping))
    return JointPolynomials(stiffness, damping, (*range(len(model.joint_names)),), lowest=0)


def displacement(context: Context, joint: int) -> list[Lane]:
    """Compute the displacement of a joint from its spring reference, in the coordinates of v."""
    top, rest = context.model.topology, table(context.model.joints.springref, context.q.dtype)
    kind, start = top.joints[joint], top.joint_q[joint]
    at = range(start, start + kind.nq)
    return difference_lanes(
        _OneJoint((kind,)), [lane(rest, i) for i in at], [context.q[i] for i in at]
    )


class _OneJoint(NamedTuple):
    """The topology of one joint, an argument of `difference_lanes`."""

    joints: tuple[Any]
    joint_q: tuple[int] = (0,)
    joint_v: tuple[int] = (0,)


def polynomial(coefficients: Sequence[Lane], x: Lane) -> Lane:
    """Evaluate c_1 x + c_2 x^2 + ..."""
    out: Lane = 0.0
    for c in reversed(coefficients):
        out = mul(x, add(c, out))
    return out


def row_lanes(numbers: jax.Array, i: int) -> list[Lane]:
    """Return row i of a table (n, k) as lanes."""
    return [lane(numbers[:, k], i) for k in range(numbers.shape[1])]
