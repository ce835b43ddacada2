"""The three-node finite-volume beam of Ghiringhelli, Masarati and Mantegazza, as in MBDyn.

"Multibody implementation of finite volume C0 beams", AIAA J. 38(1) (2000) 131-138. Equilibrium
holds for three pieces of the beam, which are separated at two evaluation points. No energy is
integrated, so the tangent matrix is not symmetric. Inertia is separate, at the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.flexible.cross_section import Section
from rbjax.flexible.reference import quaternions
from rbjax.flexible.reference.mesh import Curve, Mesh, chain, check_elements, principal
from rbjax.flexible.reference.rotation_nodes import (
    RotationNodes,
    nodes_on,
    with_curvature,
    world_increment,
)

_ROOT = 3**0.5
#: parabolic shape functions of nodes at -1, 0, 1, at the points -1/sqrt3 and 1/sqrt3
SHAPE = np.array(
    [[(1 + _ROOT) / 6, 2 / 3, (1 - _ROOT) / 6], [(1 - _ROOT) / 6, 2 / 3, (1 + _ROOT) / 6]]
)
#: their derivatives there
SLOPE = np.array(
    [
        [-(2 * _ROOT + 3) / 6, 2 / _ROOT, -(2 * _ROOT - 3) / 6],
        [(2 * _ROOT - 3) / 6, -2 / _ROOT, (2 * _ROOT + 3) / 6],
    ]
)
#: share of the element's length that belongs to each node
SHARE = np.array([(1 - 1 / _ROOT) / 2, 1 / _ROOT, (1 - 1 / _ROOT) / 2])


@dataclass(frozen=True)
class FiniteVolume(RotationNodes):
    """Three-node finite-volume beam element in space, with six dofs a node.

    Use it to compare with MBDyn. Positions and Gibbs-Rodrigues vectors of the rotation since the
    step before are interpolated with parabolas. A section at an evaluation point keeps its rotation
    and curvature from step to step:
        R = R(g) R0, kappa = kappa0 + R^T G(g) g', G = (I + [g]/2) 4/(4 + g.g).
    The nodes before and after a point at p get the force F and the moment M + (p - x) x F, with
    opposite signs. Mass and inertia of each piece are lumped at its node.

    >>> import rbjax.flexible.reference as rf
    >>> from rbjax.flexible import section
    >>> flat = section([1.0, 1.0, 1.0, 1e9, 1e9, 1e9], 1.0, [0.0, 0.0, 0.0])
    >>> x = rf.cantilever(rf.FiniteVolume(), flat, 1.0, 8, force=(0, 1, 0), steps=4)
    >>> f"{x[1]:.4f}"
    '0.3017'
    """

    name = "finite volume"
    k = 3

    def build(self, curve: Curve, length: float, section: Section, elements: int) -> Mesh:
        check_elements(elements, length)
        C, rhoA, rhoI = principal(section)
        h = length / elements
        nodes = chain(elements, 3)
        q = nodes_on(curve, np.linspace(0, length, 2 * elements + 1))
        middle = (np.arange(elements) + 0.5)[:, None] * h
        at = nodes_on(curve, middle + np.array([-1, 1]) / _ROOT * h / 2)
        tangent = jnp.einsum("pk,eki->epi", SLOPE, q[nodes][..., :3]) * 2 / h
        fill = lambda x: jnp.broadcast_to(jnp.asarray(x, float), (elements, *np.shape(x)))  # noqa: E731
        data = {
            "length": fill(h),
            "stiffness": fill(np.tile(C * h / 2, 2)),
            "mass": fill(np.diag(rhoA * h * SHARE)),
            "inertia": fill(h * SHARE[:, None] * rhoI),
            "Gamma": quaternions.rotate(quaternions.conjugate(at[..., 3:]), tangent),
        }
        history = {"sections": at[..., 3:], "kappa": jnp.zeros((elements, 2, 3))}
        return Mesh(self, q, nodes, data, history)

    def strains(self, data: Any, history: Any, before: jax.Array, q: jax.Array) -> jax.Array:
        sections, kappa = self._sections(data, history, before, q)
        tangent = SLOPE @ q[:, :3] * 2 / data["length"]
        Gamma = quaternions.rotate(quaternions.conjugate(sections), tangent) - data["Gamma"]
        return jnp.concatenate([Gamma, kappa], -1).ravel()

    def resist(
        self, data: Any, history: Any, before: jax.Array, q: jax.Array, stress: jax.Array
    ) -> jax.Array:
        sections, _ = self._sections(data, history, before, q)
        p = SHAPE @ q[:, :3]
        local = stress.reshape(2, 2, 3) * 2 / data["length"]  # without the weight of the points
        F, M = (quaternions.rotate(sections, local[:, i]) for i in (0, 1))

        def on(node: int, point: int) -> jax.Array:
            lever = p[point] - q[node, :3]
            return jnp.concatenate([F[point], M[point] + quaternions.cross(lever, F[point])])

        return jnp.stack([-on(0, 0), on(1, 0) - on(1, 1), on(2, 1)])

    def advance(self, data: Any, history: Any, before: jax.Array, q: jax.Array) -> Any:
        sections, kappa = self._sections(data, history, before, q)
        return {"sections": quaternions.normalize(sections), "kappa": kappa}

    def _sections(self, data, history, before, q) -> tuple[jax.Array, jax.Array]:
        """Compute the quaternions (2, 4) at the evaluation points and the curvatures (2, 3)."""
        g = quaternions.to_gibbs(world_increment(before[:, 3:], q[:, 3:]))
        slope = jnp.asarray(SLOPE) @ g * 2 / data["length"]
        return with_curvature(
            quaternions.from_gibbs,
            jnp.asarray(SHAPE) @ g,
            slope,
            history["sections"],
            history["kappa"],
        )
