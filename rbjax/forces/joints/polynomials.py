"""Joint springs and dampers of higher order than the linear ones.

    hinge, slide:           tau = -x (k_1 x + k_2 x^2 + ...)
    ball, a free joint's two halves:  tau = -x (k_1 |x| + k_2 |x|^2 + ...)
    each velocity:          tau = -v (d_1 |v| + d_2 |v|^2 + ...)

x is how far the joint is from the rest of its linear spring, `model.joints.springref`, in the
coordinates of v. These terms stand beside the linear ones, -k_0 x - d_0 v, which the model's joints
have already. Dampers are odd in v, so that positive coefficients dissipate. Springs are not odd in
the coordinate of a hinge or a slide: that is MuJoCo's law (measured on its `qfrc_spring`), whose
k_1 makes a spring stiffer to one side and softer to the other. It is the law of a potential,

    V = x^2 (k_1 x / 3 + k_2 x^2 / 4 + ...),

and so is that of a ball with |x|: the torque -f(|x|) x / |x| on the tangent is conservative because
the rate of the angle |x| is x . w / |x|.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.forces.element import Element, Loads, Shapes, coordinates
from rbjax.forces.instant import Instant
from rbjax.forces.joints.springs import stretch
from rbjax.lanes import Lane, add, inner, is_zero, mul, neg, total
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.rotations.coefficients import length


class JointPolynomials(Element):
    """Springs and dampers of joints, beyond their linear terms.

    tau = -x (k_1 x + k_2 x^2 + ...) - v (d_1 |v| + d_2 |v|^2 + ...); balls and free joints have |x|
    for x within the brackets.

    Fields: stiffness (n, s), a row a joint: k_1 in N m/rad^2 or N/m^2, and so on; damping (m, d), a
    row a velocity coordinate of these joints: d_1 in N m s^2/rad^2 or N s^2/m^2, and so on. Static:
    `joints`, their names or indices.

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

    def may_be_endless(self, name: str) -> bool:
        return False

    def shapes(self, model: Model) -> Shapes:
        return {
            "stiffness": (len(self.joints), None),
            "damping": (coordinates(model, self.joints), None),
        }

    def loads(self, now: Instant) -> Loads:
        out: dict[int, Lane] = {}
        for coefficients, at, x in self._springs(now):
            k = polynomial(coefficients, _size(x))
            out |= {at + i: neg(mul(k, y)) for i, y in enumerate(x)}
        damping, row = table(self.damping, now.v.dtype), 0
        for joint in map(now.joint, self.joints):
            for i, v in enumerate(joint.v, joint.start):
                coefficients = _row(damping, row)
                if not all(map(is_zero, coefficients)):
                    drag = mul(polynomial(coefficients, jnp.abs(v)), v)
                    out[i] = add(out.get(i, 0.0), neg(drag))
                row += 1
        return Loads(out)

    def energy(self, now: Instant) -> Lane:
        """sum of x^2 (k_1 x / 3 + k_2 x^2 / 4 + ...)."""

        def stored(coefficients: Sequence[Lane], x: Sequence[Lane]) -> Lane:
            shares = [mul(1 / n, k) for n, k in enumerate(coefficients, 3)]
            return mul(polynomial(shares, _size(x)), inner(x, x))

        return total(stored(coefficients, x) for coefficients, _, x in self._springs(now))

    def _springs(self, now: Instant) -> list[tuple[list[Lane], int, list[Lane]]]:
        """Coefficients, first velocity coordinate and stretch of each spring; of a free joint the
        three slides are one and the ball another."""
        stiffness, out = table(self.stiffness, now.q.dtype), []
        for row, name in enumerate(self.joints):
            coefficients = _row(stiffness, row)
            if all(map(is_zero, coefficients)):
                continue
            index = now.model.joint(name)
            x, at = stretch(now, index), now.model.topology.joint_v[index]
            out += [(coefficients, at + i, x[i : i + 3]) for i in range(0, len(x), 3)]
        return out


def polynomial(coefficients: Sequence[Lane], x: Lane) -> Lane:
    """c_1 x + c_2 x^2 + ..."""
    out: Lane = 0.0
    for c in reversed(coefficients):
        out = mul(x, add(c, out))
    return out


def _size(x: Sequence[Lane]) -> Lane:
    """A single number as it is, the length of a vector."""
    return x[0] if len(x) == 1 else length(inner(x, x))


def _row(numbers: jax.Array, i: int) -> list[Lane]:
    return [lane(numbers[:, k], i) for k in range(numbers.shape[1])]
