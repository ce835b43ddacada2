"""The contact problem of a tree by articulated-body sweeps.

If the contacts of a link are with the world, K = sum of b_k H_kl b_l^T adds to its inertia, and the
Hessian of the problem is the mass matrix of a tree with these inertias. One sweep of ABA factorizes
it in O(n), without the matrix. Vectors and rows are in the axes of their link, at its origin.
Contacts of two links that move are left to `conjugate_gradients`.

Source: Featherstone, *Rigid Body Dynamics Algorithms*, ch. 7; Sathya & Carpentier, *Constrained
articulated body dynamics algorithms*, 2024.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.contact.problem.link_stiffness import LinkStiffness
from rbjax.contact.problem.problem import Stiff, stacked
from rbjax.dynamics.algorithms.aba import (
    factorize,
    solve,
    solve_inward,
    solve_outward,
    transforms,
)
from rbjax.dynamics.algorithms.factors import name_link_factors
from rbjax.dynamics.drivers.contract import Driver
from rbjax.joints.joint import Block
from rbjax.lanes import Lane, add, is_literal, mul, unpack
from rbjax.spatial import ArticulatedInertia, Force, Motion


class Factors(NamedTuple):
    """The factors of the Hessian M + J^T H J of the contact problem, with the Hessians H of the
    limits and of the contacts with the world."""

    d: Driver
    factors: Any

    def solve(self, b: jax.Array) -> jax.Array:
        """Solve for x (nv,) with the factored Hessian as matrix and b (nv,) as right side."""
        return self.d.pack(solve(self.d, self.factors, self.d.lanes(b)), b)

    def named(self) -> Factors:
        """Name the factors, so that derivatives save them."""
        return self._replace(factors=name_link_factors(self.factors))


class ArticulatedTree(NamedTuple):
    """The tree of a robot at a configuration.

    Fields:
        d: driver whose whole form is a list.
        joints: joint motions, per link.
        touching: the links that can touch the world.
        link_pairs: (WORLD, link) for each link that can touch the world.
        weights: inverse inertia of each dof, which scales the error.
        poses: of each link in its parent, if a derivative saves the factors; else None.
    """

    d: Driver
    joints: Any
    touching: Sequence[int]
    link_pairs: Sequence[tuple[int, int]]
    weights: list[Lane]
    poses: Any = None

    def saved(self) -> ArticulatedTree:
        """Return the tree for factors that a derivative saves."""
        return self._replace(poses=transforms(self.d, self.joints))

    def twists(self, x: jax.Array, dtype: Any) -> jax.Array:
        """Compute the twists (n + 1, 6) of the links that can touch and of the world, at velocities
        x (nv,)."""

        def outward(at: Any, parent: tuple[Motion, Block]) -> tuple[tuple[Motion, Block], Motion]:
            link, joint, qdd = at
            relative, block = joint.accelerate(qdd, parent[1])
            a = joint.transform(link)(parent[0]) + relative
            return (a, block), a

        xs = self.d.zip(self.d.constants, self.joints, self.d.lanes(x))
        return self._of_touching(self.d.outward(outward, (Motion.zero(), ()), xs), dtype)

    def _of_touching(self, twists: Any, dtype: Any) -> jax.Array:
        found = self.d.whole(twists)
        return stacked([*(list(found[i]) for i in self.touching), [0.0] * 6], dtype)

    def generalized(self, wrenches: jax.Array) -> list[Lane]:
        """Compute the joint forces J^T f from wrenches (n + 1, 6) on the links that can touch."""
        d, zero = self.d, Force.zero()
        given = {i: Force.from_lanes(unpack(wrenches[k])) for k, i in enumerate(self.touching)}

        def inward(at: Any, children: tuple[Force, Block]) -> tuple[tuple[Force, Block], Lane]:
            link, joint, f = at
            f = f + children[0]
            tau, block = joint.project(f, children[1])
            return (joint.transform(link).T(f), block), tau

        xs = d.zip(d.constants, self.joints, d.scattered(given, zero))
        like = jnp.zeros(d.topology.nv, wrenches.dtype)
        return unpack(d.pack(d.inward(inward, (zero, ()), xs), like))

    def factorize(self, stiffness: LinkStiffness, rows: Sequence[Stiff]) -> Factors:
        """Factorize the Hessian of the contact problem, without contacts between two links.

        stiffness: of the contacts of each link with the world.
        rows: of the rows with one force; each row acts on one dof.
        """
        d = self.d
        place = {i: float(k) for k, (_, i) in enumerate(self.link_pairs)}
        extra: dict[int, Lane] = {}
        for J, h in rows:
            for i, x in J.items():
                extra[i] = add(extra.get(i, 0.0), mul(h, mul(x, x)))

        def inertia(k: Lane) -> ArticulatedInertia:
            """Return the stiffness of the link with the index k, or zero if k is -1."""
            if is_literal(k):
                return stiffness.at(int(k)) if k >= 0 else ArticulatedInertia.zero()
            return stiffness.at(jnp.asarray(k).astype(jnp.int32))

        given = d.scattered(extra, 0.0), (d.scattered(place, -1.0), inertia)
        return Factors(d, factorize(d, self.joints, *given, self.poses))

    def step(
        self, found: Factors, b: jax.Array, dtype: Any, wrenches: jax.Array | None = None
    ) -> tuple[jax.Array, jax.Array]:
        """Solve as `Factors.solve`. Return x (nv,) and the link twists (n + 1, 6) at x, as `twists`
        does.

        wrenches: (n + 1, 6) on the links that can touch, whose joint forces add to b.
        """
        d, bias = self.d, None
        if wrenches is not None:
            given = {i: -Force.from_lanes(unpack(wrenches[k])) for k, i in enumerate(self.touching)}
            bias = d.scattered(given, Force.zero())
        left = solve_inward(d, found.factors, d.lanes(b), bias)
        x, twists = d.unzip(solve_outward(d, left, twists=True), 2)
        return d.pack(x, b), self._of_touching(twists, dtype)
