"""The contact problem of a tree that touches only the world, by articulated-body sweeps.

If the contacts of a link are with the world, K = sum of b_k H_kl b_l^T adds to its inertia, and the
Hessian of the problem is the mass matrix of a tree with these inertias. One sweep of ABA factorizes
it in O(n), without the matrix. Vectors and rows are in the axes of their link, at its origin.

Source: Featherstone, *Rigid Body Dynamics Algorithms*, ch. 7; Sathya & Carpentier, *Constrained
articulated body dynamics algorithms*, 2024.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax

from rbjax.contact.problem import inertia_of_row, stacked
from rbjax.contact.rows.scalar_row import ScalarRow
from rbjax.dynamics.algorithms.aba import factorize, solve
from rbjax.dynamics.drivers.contract import Driver
from rbjax.lanes import Lane, add, mul, unpack
from rbjax.spatial import ArticulatedInertia, Force, Motion


class Factors(NamedTuple):
    """The factors of the Hessian."""

    d: Driver
    factors: Any

    def solve(self, b: list[Lane]) -> list[Lane]:
        """Solve H x = b."""
        return solve(self.d, self.factors, b)


class ArticulatedTree(NamedTuple):
    """The tree of a robot at a configuration.

    Fields:
        d: driver, with lists of links.
        joints: joint motions.
        transforms: pose of each link in its parent.
        touching: the links that can touch the world.
        link_pairs: (WORLD, link) for each of them.
        weights: inverse inertia of each dof, which scales the error.
    """

    d: Any
    joints: list
    transforms: list
    touching: Sequence[int]
    link_pairs: Sequence[tuple[int, int]]
    weights: list[Lane]

    def times_M(self, x: list[Lane]) -> list[Lane]:
        """Compute M x."""

        def outward(at: Any, parent: Motion) -> tuple[Motion, Force]:
            link, joint, X, qdd = at
            a = X(parent) + joint.S * qdd
            return a, link.inertia(a)

        def inward(at: Any, children: Force) -> tuple[Force, Lane]:
            (link, joint, X, qdd), f = at
            f = f + children
            return X.T(f), add(joint.S.dot(f), mul(link.armature, qdd))

        xs = list(zip(self.d.constants, self.joints, self.transforms, x, strict=True))
        return self.d.out_and_in(outward, Motion.zero(), inward, Force.zero(), xs)

    def twists(self, x: list[Lane], dtype: Any) -> jax.Array:
        """Compute the twists (n + 1, 6) of the links that can touch and of the world."""

        def outward(at: Any, parent: Motion) -> tuple[Motion, Motion]:
            joint, X, qdd = at
            a = X(parent) + joint.S * qdd
            return a, a

        xs = list(zip(self.joints, self.transforms, x, strict=True))
        found = self.d.outward(outward, Motion.zero(), xs)
        return stacked([*(list(found[i]) for i in self.touching), [0.0] * 6], dtype)

    def generalized(self, wrenches: jax.Array) -> list[Lane]:
        """Compute J^T f from the wrenches (n + 1, 6) on the links that can touch."""
        zero = Force.zero()
        given = {i: Force.from_lanes(unpack(wrenches[k])) for k, i in enumerate(self.touching)}

        def inward(at: Any, children: Force) -> tuple[Force, Lane]:
            joint, X, f = at
            f = f + children
            return X.T(f), joint.S.dot(f)

        xs = list(zip(self.joints, self.transforms, self.d.scattered(given, zero), strict=True))
        return self.d.inward(inward, zero, xs)

    def factorize(self, stiffness: jax.Array, rows: Sequence[tuple[ScalarRow, Lane]]) -> Factors:
        """Factorize M + J^T H J. stiffness: (n, 21) K of each link. rows: rows of single dofs."""
        d, zero = self.d, ArticulatedInertia.zero()
        K = {link: inertia_of_row(stiffness[k]) for k, (_, link) in enumerate(self.link_pairs)}
        extra: list[Lane] = [0.0] * len(self.joints)
        for row, h in rows:
            for i, x in row.J.items():
                extra[i] = add(extra[i], mul(h, mul(x, x)))
        return Factors(d, factorize(d, self.joints, extra, d.scattered(K, zero)))
