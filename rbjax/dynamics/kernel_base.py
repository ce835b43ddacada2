"""A floating base inside a kernel: its six velocities are solved for at once.

With R the attitude, w the angular velocity (body axes) and a = [w'; R^T (v' - g)] the base obeys

    I_A a + p = [tau_ang; R^T tau_lin] - armature,

where I_A and p are what ABA has gathered from the limbs. One 6 by 6 factorization replaces six
eliminations, three of them with an articulated inertia turned by R.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax

from rbjax.dynamics.aba import bias_force
from rbjax.lanes import Lane, Mat3, Sym3, Vec3, as_arrays, mul, quaternion_matrix, sub
from rbjax.spatial import ArticulatedInertia, Force, Motion


class FloatingBase:
    """The first six links of a tree whose root joint is free; q and v read a coordinate."""

    def __init__(self, prepared: Any, q: Callable[[int], Lane], v: Callable[[int], Lane]):
        self._prepared, self._q, self._v = prepared, q, v

    @property
    def attitude(self) -> Mat3:
        return quaternion_matrix(*(self._q(i) for i in range(3, 7)))

    @property
    def spin(self) -> Vec3:
        """Angular velocity in body axes."""
        return Vec3(*(self._v(i) for i in range(3, 6)))

    @property
    def inertia(self) -> Any:
        return self._prepared.link(5)().inertia

    def solve(
        self, gathered: tuple, tau: Sequence[Lane], y: Sequence[Lane] | None, gravity: Vec3
    ) -> tuple[Motion, list[Lane], Motion | None, list[Lane]]:
        """The base's a and v', and its share of b = M^-1 y in body axes and in coordinates."""
        R = self.attitude
        armature = [self._prepared.link(i)().armature for i in range(6)]
        I_A = self.inertia.articulated() + gathered[0]
        p = bias_force(self.inertia, self.spin) + gathered[1]
        zero = (0.0,) * 3
        M = I_A.M + Sym3(*armature[:3], *zero).rotated(R.T)
        J = I_A.J + Sym3(*armature[3:], *zero)
        solve = _factorized(ArticulatedInertia(J, I_A.H, M))

        def force(tau: Sequence[Lane], rate: Vec3) -> Force:
            held = [sub(t, mul(a, g)) for t, a, g in zip(tau[:3], armature, rate, strict=False)]
            return Force(Vec3(*tau[3:]), R.T @ Vec3(*held))

        a = solve(force(tau, gravity) - p)
        qdd = [*(R @ a.lin + gravity), *a.ang]
        if y is None:
            return a, qdd, None, []
        e = solve(force(y, Vec3.zero()) - gathered[2])
        return a, qdd, e, [*(R @ e.lin), *e.ang]

    def transposed(
        self, gathered: tuple, a: Motion, e: Motion, like: jax.Array
    ) -> tuple[list[Lane], list[Lane]]:
        """Cotangents of the quaternion and of the angular velocity (see `kernel_aba.pull`)."""
        f, w_bar, a_bar = gathered
        inertia = self.inertia

        def local(w: Vec3, a: Motion) -> Force:
            return as_arrays(inertia(a) + bias_force(inertia, w), like)

        own, back = jax.vjp(local, as_arrays(self.spin, like), as_arrays(a, like))
        w_more, a_more = back(as_arrays(Force(-e.ang, -e.lin), like))
        f_lin, a_lin = f.lin + own.lin, a_bar.lin + a_more.lin
        turn = a_lin.cross(a.lin) - f_lin.cross(e.lin)
        return quaternion_cotangent([self._q(i) for i in range(3, 7)], turn), [*(w_bar + w_more)]


def quaternion_cotangent(q: Sequence[Lane], turn: Vec3) -> list[Lane]:
    """The cotangent of q (of any length) from that of a small turn in body axes."""
    w, x, y, z = q
    a, b, c = turn
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    product = (-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c,
               w * c + x * b - y * a)  # fmt: skip
    return [scale * n for n in product]


def _factorized(inertia: ArticulatedInertia) -> Callable[[Force], Motion]:
    """I^-1 by L D L^T, forces first, so that the masses are eliminated before the moments."""
    H, M, J = inertia.H, inertia.M.dense, inertia.J.dense
    A = [[*M.rows[i], 0.0, 0.0, 0.0] for i in range(3)]
    A += [[*H.rows[i], *J.rows[i]] for i in range(3)]
    L: list[list[Lane]] = [[0.0] * 6 for _ in range(6)]
    scaled: list[list[Lane]] = [[0.0] * 6 for _ in range(6)]  # L D
    inverse: list[Lane] = []
    for j in range(6):
        for i in range(j, 6):
            x = A[i][j]
            for k in range(j):
                x = sub(x, mul(scaled[i][k], L[j][k]))
            scaled[i][j] = x
        inverse.append(1.0 / scaled[j][j])
        for i in range(j + 1, 6):
            L[i][j] = mul(scaled[i][j], inverse[j])

    def solve(f: Force) -> Motion:
        x = [*f.lin, *f.ang]
        for i in range(6):
            for k in range(i):
                x[i] = sub(x[i], mul(L[i][k], x[k]))
        x = [mul(a, d) for a, d in zip(x, inverse, strict=True)]
        for i in reversed(range(6)):
            for k in range(i + 1, 6):
                x[i] = sub(x[i], mul(L[k][i], x[k]))
        return Motion(Vec3(*x[3:]), Vec3(*x[:3]))

    return solve
