"""Torques and dry friction of joints as functions of position.

    tau = -c(x) - F(x) [1 + s exp(-(v / v_s)^2)] tanh(v / v_0)

x runs from -1 to 1 over a joint's range. Both curves are Chebyshev series in x,

    c(x) = c_0 + c_1 T_1(x) + ... + c_n T_n(x),     T_k(cos a) = cos(k a).

c is conservative: motor cogging, the torque of a cable, an offset. F is the friction of a linkage
or a gear at each position, in both directions. Beyond the range both curves are constant. A longer
series contains all shorter ones, so models of growing length can be compared. As in
`joint_friction`, F is smoothed at rest over the velocity v_0, and s is the relative excess of
breakaway friction over sliding friction (Stribeck).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import check_array, check_model
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes, columns_of
from rbjax.forces.joints.polynomials import row_lanes
from rbjax.lanes import Lane, add, is_zero, mul, neg, total
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane


class JointCurves(Element):
    """Torque and dry friction of hinges and slides as functions of position.

    tau = -c(x) - F(x) [1 + s exp(-(v / v_s)^2)] tanh(v / v_0),  c = sum of c_k T_k, F = sum F_k T_k

    Fields, one row per joint. `JointCurves.of` accepts one value for all joints.
        range: (n, 2) rad or m, positions at x = -1 and x = 1.
        torque: c_k (n, k) N m or N.
        coulomb: F_k (n, m) N m or N.
        breakaway: s (n,).
        stribeck, smoothing: v_s, v_0 (n,) rad/s or m/s, positive.
        joints: names or indices; static.

    Source: Trefethen, *Approximation Theory and Approximation Practice*, 2013, ch. 3; Armstrong,
    *Control of Machines with Friction*, 1991 (friction that depends on position).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("pendulum")
        >>> rubs = rb.forces.JointCurves.of(
        ...     model, model.joint_names, [[-2.0, 2.0]], coulomb=jnp.array([[3.0, 1.0]]))
        >>> state = model.default_state().replace(q=jnp.array([1.0]), v=jnp.array([0.5]))
        >>> rubbing = rb.applied_forces(model.with_forces(rubs), state)
        >>> (rubbing - rb.applied_forces(model, state)).round(6).tolist()
        [-3.5]
    """

    range: jax.Array
    torque: jax.Array
    coulomb: jax.Array
    breakaway: jax.Array
    stribeck: jax.Array
    smoothing: jax.Array
    joints: tuple[str | int, ...] = eqx.field(static=True)
    positive = ("stribeck", "smoothing")
    unlimited = ()

    def __check_init__(self) -> None:
        super().__check_init__()
        if not self.joints:
            raise InputError("JointCurves: joints is empty, expected names or indices of joints")

    @classmethod
    def of(
        cls,
        model: Model,
        joints: Sequence[str | int],
        range: Any,
        *,
        torque: Any = 0.0,
        coulomb: Any = 0.0,
        breakaway: Any = 0.0,
        stribeck: Any = 0.1,
        smoothing: Any = 1e-2,
    ) -> JointCurves:
        """Make the curves of joints. range is (2,) or (n, 2). torque and coulomb are a number, (n,)
        or (n, k) coefficients. The other parameters are a number or (n,)."""
        check_model("JointCurves.of", model)
        given = {"breakaway": breakaway, "stribeck": stribeck, "smoothing": smoothing}
        n, dtype = len(joints), model.gravity.dtype
        wrong = [j for j in joints if model.topology.joints[model.joint(j)].nv != 1]
        if wrong:
            raise InputError(
                f"JointCurves.of: joints {wrong} have more than one coordinate, expected hinges or "
                "slides"
            )
        columns = columns_of("JointCurves.of", model, joints, given)

        def series(name: str, x: Any) -> jax.Array:
            if np.ndim(x) < 2:
                return columns_of("JointCurves.of", model, joints, {name: x})[name][:, None]
            return check_array("JointCurves.of", name, x, (n, np.shape(x)[-1])).astype(dtype)

        ends = check_array("JointCurves.of", "range", range, (2,), (n, 2)).astype(dtype)
        if not isinstance(ends, jax.core.Tracer) and not (ends[..., 1] > ends[..., 0]).all():
            raise InputError(f"JointCurves.of: range is {ends.tolist()}, expected [low, high]")
        return cls(
            range=jnp.broadcast_to(ends, (n, 2)),
            torque=series("torque", torque),
            coulomb=series("coulomb", coulomb),
            joints=tuple(joints),
            **columns,
        )

    def shapes(self, model: Model) -> Shapes:
        n = len(self.joints)
        return {
            "range": (n, 2), "torque": (n, None), "coulomb": (n, None),
            "breakaway": (n,), "stribeck": (n,), "smoothing": (n,),
        }  # fmt: skip

    def loads(self, context: Context) -> Loads:
        dtype = context.v.dtype
        torque, coulomb = table(self.torque, dtype), table(self.coulomb, dtype)
        given = (self.breakaway, self.stribeck, self.smoothing)
        columns, out = [table(x, dtype) for x in given], {}
        for row, joint in enumerate(map(context.joint, self.joints)):
            x, _, _ = self._place(context, row)
            c, F = series(row_lanes(torque, row), x), series(row_lanes(coulomb, row), x)
            s, v_s, v_0 = (lane(column, row) for column in columns)
            (v,) = joint.v
            if not is_zero(F):
                more = 0.0 if is_zero(s) else mul(s, jnp.exp(-((v / v_s) ** 2)))
                F = mul(mul(F, add(1.0, more)), jnp.tanh(v / v_0))
            out[joint.start] = neg(add(c, F))
        return Loads(out)

    def energy(self, context: Context) -> Lane:
        """Compute the energy, the integral of the torque c from the middle of the range."""
        torque = table(self.torque, context.q.dtype)

        def stored(row: int) -> Lane:
            x, half, beyond = self._place(context, row)
            c = row_lanes(torque, row)
            return add(mul(half, integral(c, x)), mul(beyond, series(c, x)))

        return total(stored(row) for row in range(len(self.joints)))

    def _place(self, context: Context, row: int) -> tuple[Lane, Lane, Lane]:
        """Compute the joint's position relative to its range.

        Return x in [-1, 1], clipped, half the length of the range, and the distance beyond the
        range.
        """
        ends = table(self.range, context.q.dtype)
        low, high = lane(ends[:, 0], row), lane(ends[:, 1], row)
        (q,) = context.joint(self.joints[row]).q
        half, inside = (high - low) / 2, jnp.clip(q, low, high)
        return (inside - low) / half - 1.0, half, q - inside


def series(c: Sequence[Lane], x: Lane) -> Lane:
    """Evaluate the Chebyshev series c_0 + c_1 T_1(x) + c_2 T_2(x) + ..."""
    return total(mul(a, T) for a, T in zip(c, _chebyshev(x, len(c)), strict=True))


def integral(c: Sequence[Lane], x: Lane) -> Lane:
    """Integrate the series from 0 to x: T_k becomes T_(k+1)/(2k+2) - T_(k-1)/(2k-2)."""
    at, middle = _chebyshev(x, len(c) + 1), _chebyshev(0.0 * x, len(c) + 1)
    T = [a - b for a, b in zip(at, middle, strict=True)]
    whole = [T[1], *([T[2] / 4] if len(c) > 1 else [])]
    whole += [T[k + 1] / (2 * k + 2) - T[k - 1] / (2 * k - 2) for k in range(2, len(c))]
    return total(mul(a, b) for a, b in zip(c, whole, strict=True))


def _chebyshev(x: Lane, n: int) -> list[Lane]:
    """Compute T_0 ... T_(n-1) at x, by T_(k+1) = 2 x T_k - T_(k-1)."""
    T: list[Lane] = [1.0 + 0.0 * x, x]
    while len(T) < n:
        T.append(2.0 * x * T[-1] - T[-2])
    return T[:n]
