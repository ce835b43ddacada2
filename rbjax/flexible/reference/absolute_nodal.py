"""The planar cable element of the absolute nodal coordinate formulation (ANCF).

Gerstmayr and Shabana, "Analysis of thin beams and cables using the absolute nodal coordinate
formulation", Nonlinear Dyn. 45 (2006). Gerstmayr and Irschik, "On the correct representation of
bending and axial deformation in the ANCF", J. Sound Vib. 318 (2008), on the curvature.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import UnknownName
from rbjax.flexible.cross_section import Section
from rbjax.flexible.reference.mesh import (
    Curve,
    Formulation,
    Mesh,
    chain,
    check_elements,
    initial_strains,
    principal,
)

#: points and weights on [0, 1] of extension and of bending
_LOBATTO = (np.array([0, 0.5, 1]), np.array([1, 4, 1]) / 6)


def _gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    x, w = np.polynomial.legendre.leggauss(n)
    return (1 + x) / 2, w / 2


QUADRATURES = {"full": (_gauss(5), _gauss(3)), "reduced": (_LOBATTO, _gauss(2))}


@dataclass(frozen=True)
class AbsoluteNodal(Formulation):
    """Planar two-node cable element with coordinates x, y and slopes dx/ds, dy/ds of each node.

    Use it to compare with ANCF. It has no shear: it converges to the beam with infinite GAy. The
    position is a cubic Hermite polynomial. Strains: |r'| - 1 and the change of dphi/ds, with phi
    the angle of the tangent. The mass matrix of translation is constant. A rotary inertia rhoI adds
    rhoI (dphi/dt)^2 / 2 to the kinetic energy per length.

    quadrature: "full", 5 points for extension, 3 for bending; or "reduced", Lobatto's 3 points and
        Gauss' 2 points, as in Gerstmayr and Irschik.
    Raises UnknownName for another word.

    >>> import rbjax.flexible.reference as rf
    >>> from rbjax.flexible import section
    >>> flat = section([1.0, 1.0, 1.0, 1e9, 1e9, 1e9], 1.0, [0.0, 0.0, 0.0])
    >>> x = rf.cantilever(rf.AbsoluteNodal(), flat, 1.0, 8, force=(0, 1, 0), steps=4)
    >>> f"{x[1]:.4f}"
    '0.3017'
    """

    quadrature: str = "reduced"

    c, d, k = 4, 4, 2
    planar = (True,) * 4
    clamped = (True, True, False, True)  # in the basis of the clamp: the slope stays parallel to it

    def __post_init__(self) -> None:
        if self.quadrature not in QUADRATURES:
            raise UnknownName("quadrature", self.quadrature, QUADRATURES)

    @property
    def name(self) -> str:  # type: ignore[override]
        """Text for tables."""
        return f"ANCF cable, {self.quadrature} quadrature"

    def build(self, curve: Curve, length: float, section: Section, elements: int) -> Mesh:
        check_elements(elements, length)
        C, rhoA, rhoI = principal(section)
        h, ends = length / elements, chain(elements, 2)
        x, R = curve(np.linspace(0, length, elements + 1))
        q = jnp.concatenate([jnp.asarray(x[:, :2]), jnp.asarray(R[:, :2, 0])], -1)
        fill = lambda x: jnp.broadcast_to(jnp.asarray(x, float), (elements, *np.shape(x)))  # noqa: E731
        axial, bending = QUADRATURES[self.quadrature]
        stiffness = np.concatenate([C[0] * h * axial[1], C[5] * h * bending[1]])
        data = {
            "length": fill(h),
            "stiffness": fill(stiffness),
            "unloaded": jnp.zeros((elements, len(stiffness))),
            "rhoA": fill(rhoA),
            "rhoI": fill(rhoI[2]),
        }
        data["unloaded"] = initial_strains(self, data, {}, q[ends])
        return Mesh(self, q, ends, data, {})

    def retract(self, q: jax.Array, delta: jax.Array) -> jax.Array:
        return q + delta

    def strains(self, data: Any, history: Any, before: jax.Array, q: jax.Array) -> jax.Array:
        h, (axial, bending) = data["length"], QUADRATURES[self.quadrature]
        values = _stretch(q, h, axial[0]), _curvature(q, h, bending[0])
        return jnp.concatenate(values) - data["unloaded"]

    def kinetic_energy(self, data: Any, q: jax.Array, v: jax.Array) -> jax.Array:
        h, (points, weights) = data["length"], _gauss(4)
        speed, slope, rate = _position(v, h, points), _slope(q, h, points), _slope(v, h, points)
        turn = _cross(slope, rate) / (slope**2).sum(-1)
        return 0.5 * h * weights @ (data["rhoA"] * (speed**2).sum(-1) + data["rhoI"] * turn**2)

    def momentum(self, data: Any, q: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        dq, dv = jax.grad(self.kinetic_energy, (1, 2))(data, q, v)
        return dv, dq

    def load(self, q: jax.Array, wrench: jax.Array) -> jax.Array:
        slope = q[2:]
        normal = jnp.stack([-slope[1], slope[0]])
        return jnp.concatenate([wrench[:2], wrench[5] * normal / (slope @ slope)])

    def pose(self, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, slope, zero = q[..., :2], q[..., 2:], jnp.zeros_like(q[..., :1])
        tangent = slope / jnp.linalg.norm(slope, axis=-1, keepdims=True)
        return jnp.concatenate([x, zero], -1), jnp.concatenate([tangent, zero], -1)

    def clamp_basis(self, angle: jax.Array | float) -> jax.Array:
        c, s = jnp.cos(angle), jnp.sin(angle)
        return jnp.eye(4).at[2:, 2:].set(jnp.array([[c, -s], [s, c]]))

    def clamp_increment(self, q: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
        normal = self.clamp_basis(after)[2:, 3]
        return jnp.zeros(4).at[3].set(-normal @ q[2:])


def _cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the component z of a cross product of vectors (..., 2) in the plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _stretch(q: jax.Array, h: Any, t: np.ndarray) -> jax.Array:
    """Compute |r'| at points t (points,) of [0, 1]."""
    return jnp.sqrt((_slope(q, h, t) ** 2).sum(-1))


def _curvature(q: jax.Array, h: Any, t: np.ndarray) -> jax.Array:
    """Compute dphi/ds at points t (points,), phi the angle of the tangent, by unloaded length."""
    slope = _slope(q, h, t)
    second = _hermite(q, h, np.array([12 * t - 6, 6 * t - 4, 6 - 12 * t, 6 * t - 2])) / h**2
    return _cross(slope, second) / (slope**2).sum(-1)


def _position(q: jax.Array, h: Any, t: np.ndarray) -> jax.Array:
    """Compute r (points, 2)."""
    N = [1 - 3 * t**2 + 2 * t**3, t - 2 * t**2 + t**3, 3 * t**2 - 2 * t**3, t**3 - t**2]
    return _hermite(q, h, np.array(N))


def _slope(q: jax.Array, h: Any, t: np.ndarray) -> jax.Array:
    """Compute r' (points, 2)."""
    N = [6 * t**2 - 6 * t, 1 - 4 * t + 3 * t**2, 6 * t - 6 * t**2, 3 * t**2 - 2 * t]
    return _hermite(q, h, np.array(N)) / h


def _hermite(q: jax.Array, h: Any, N: np.ndarray) -> jax.Array:
    """Combine positions and slopes of both nodes, q (2, 4), by functions N (4, points)."""
    values = jnp.stack([q[0, :2], h * q[0, 2:], q[1, :2], h * q[1, 2:]])
    return jnp.asarray(N).T @ values
