"""The linear two-node element of Simo and Reissner.

Simo and Vu-Quoc, "A three-dimensional finite-strain rod model, part II", Comput. Methods Appl.
Mech. Eng. 58 (1986). On the interpolations: Crisfield and Jelenic, "Objectivity of strain measures
in the geometrically exact three-dimensional beam theory", Proc. R. Soc. A 455 (1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import UnknownName
from rbjax.flexible.cross_section import Section
from rbjax.flexible.reference import quaternions
from rbjax.flexible.reference.mesh import (
    Curve,
    Mesh,
    chain,
    check_elements,
    initial_strains,
    principal,
)
from rbjax.flexible.reference.rotation_nodes import (
    RotationNodes,
    nodes_on,
    with_curvature,
    world_increment,
)

#: points in [-1, 1] of each quadrature; all weights are equal
QUADRATURES = {"reduced": (0.0,), "full": (-(3**-0.5), 3**-0.5)}
INTERPOLATIONS = ("relative", "total", "incremental")


@dataclass(frozen=True)
class Reissner(RotationNodes):
    """Linear two-node geometrically exact beam element in space, with six dofs a node.

    Use it as the standard nodal beam. Positions are interpolated linearly. The strains are the
    changes of Gamma = R^T r' and of the curvature kappa of the interpolated rotation.

    quadrature: "reduced", one point; or "full", two points, which locks in shear.
    interpolation of rotations:
        "relative": R = R1 exp(N2 log(R1^T R2)). Objective, independent of the path.
        "total": the rotation vectors from the unloaded beam, at most pi. Not objective.
        "incremental": the rotation vectors from the step before. Depends on the path.
    Raises UnknownName for another word.

    >>> import rbjax.flexible.reference as rf
    >>> from rbjax.flexible import section
    >>> flat = section([1.0, 1.0, 1.0, 1e9, 1e9, 1e9], 1.0, [0.0, 0.0, 0.0])
    >>> x = rf.cantilever(rf.Reissner(), flat, 1.0, 16, force=(0, 1, 0), steps=4)
    >>> f"{x[1]:.3f}"
    '0.301'
    """

    quadrature: str = "reduced"
    interpolation: str = "relative"

    k = 2

    def __post_init__(self) -> None:
        if self.quadrature not in QUADRATURES:
            raise UnknownName("quadrature", self.quadrature, QUADRATURES)
        if self.interpolation not in INTERPOLATIONS:
            raise UnknownName("interpolation", self.interpolation, INTERPOLATIONS)

    @property
    def name(self) -> str:  # type: ignore[override]
        """Text for tables."""
        rule = "" if self.interpolation == "relative" else f", {self.interpolation} rotations"
        return f"Reissner, {self.quadrature} quadrature{rule}"

    def build(self, curve: Curve, length: float, section: Section, elements: int) -> Mesh:
        check_elements(elements, length)
        C, rhoA, rhoI = principal(section)
        h, points = length / elements, np.array(QUADRATURES[self.quadrature])
        chords = chain(elements, 2)
        q = nodes_on(curve, np.linspace(0, length, elements + 1))
        middle = (np.arange(elements) + 0.5)[:, None] * h
        at = nodes_on(curve, middle + points * h / 2)
        fill = lambda x: jnp.broadcast_to(jnp.asarray(x, float), (elements, *np.shape(x)))  # noqa: E731
        stiffness = h / len(points) * C
        data = {
            "length": fill(h),
            "stiffness": fill(np.tile(stiffness, len(points))),
            "unloaded": jnp.zeros((elements, 6 * len(points))),
            "mass": fill(rhoA * h / 6 * np.array([[2.0, 1.0], [1.0, 2.0]])),
            "inertia": fill(np.array([rhoI] * 2) * h / 2),
            "nodes": q[chords],  # of the unloaded beam
            "sections": at[..., 3:],
        }
        history = {}
        if self.interpolation == "incremental":
            history = {"sections": at[..., 3:], "kappa": jnp.zeros((elements, len(points), 3))}
        data["unloaded"] = initial_strains(self, data, history, q[chords])
        return Mesh(self, q, chords, data, history)

    def strains(self, data: Any, history: Any, before: jax.Array, q: jax.Array) -> jax.Array:
        sections, kappa = self._sections(data, history, before, q)
        tangent = (q[1, :3] - q[0, :3]) / data["length"]
        Gamma = quaternions.rotate(quaternions.conjugate(sections), tangent)
        return jnp.concatenate([Gamma, kappa], -1).ravel() - data["unloaded"]

    def advance(self, data: Any, history: Any, before: jax.Array, q: jax.Array) -> Any:
        if not history:
            return history
        sections, kappa = self._sections(data, history, before, q)
        return {"sections": sections, "kappa": kappa}

    def _sections(self, data, history, before, q) -> tuple[jax.Array, jax.Array]:
        """Compute the quaternions (points, 4) of sections and their curvatures (points, 3)."""
        N2 = (1 + jnp.array(QUADRATURES[self.quadrature])) / 2
        h, turns = data["length"], q[:, 3:]
        if self.interpolation == "relative":
            first = turns[0]
            phi = quaternions.log(quaternions.multiply(quaternions.conjugate(first), turns[1]))
            sections = quaternions.multiply(first, quaternions.exp(N2[:, None] * phi))
            return sections, jnp.broadcast_to(phi / h, (len(N2), 3))
        if self.interpolation == "total":
            start, sections, kappa = data["nodes"][:, 3:], data["sections"], jnp.zeros((len(N2), 3))
        else:
            start, sections, kappa = before[:, 3:], history["sections"], history["kappa"]
        phi = quaternions.log(world_increment(start, turns))
        at = (1 - N2)[:, None] * phi[0] + N2[:, None] * phi[1]
        slope = jnp.broadcast_to((phi[1] - phi[0]) / h, at.shape)
        return with_curvature(quaternions.exp, at, slope, sections, kappa)
