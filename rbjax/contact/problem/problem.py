"""The convex problem of soft contact at a state, with the tree's sparsity.

    min over x of  (x - a_s)^T M (x - a_s) / 2 + sum of s_i(J_i x - a_ref,i),    M a_s = tau - b

x is the joint acceleration, s_i the costs of contacts (`cones`) and of limits, friction loss and
equalities (`rows`). Its gradient is M x - (tau - b) - J^T f (MuJoCo, *Computation*).

The Hessian M + J^T H J has the pattern of M if all contacts are with the world: a contact adds the
6 by 6 matrix K = sum of b_k H_kl b_l^T to the composite inertia of its link. A contact of two links
couples the two paths from their nearest common ancestor.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from rbjax.contact.problem.contact_rows import ContactSet, Slots
from rbjax.contact.problem.in_use import InUse, wrenches_in_use
from rbjax.contact.problem.latched_disc import DiscSet
from rbjax.contact.problem.link_stiffness import LinkStiffness
from rbjax.contact.problem.world import World
from rbjax.contact.rows.limit_slots import JointLimits, LimitsInUse, LimitSlots
from rbjax.contact.rows.scalar_row import ScalarRow
from rbjax.dynamics.algorithms.factors import name_factors
from rbjax.lanes import Lane, add, fusion_barrier, mul, pack, sub, total, unpack
from rbjax.lanes.factorization import LDLT, ldlt
from rbjax.model import WORLD
from rbjax.spatial import Force, Motion

#: J (dof -> coefficient) and the Hessian s'' of a row with one force
Stiff = tuple[Mapping[int, Lane], Lane]


class Factors(NamedTuple):
    """The factors of the Hessian M + J^T H J of the contact problem, with the Hessians H of the
    contacts."""

    factors: LDLT

    def solve(self, b: jax.Array) -> jax.Array:
        """Solve for x (nv,) with the factored Hessian as matrix and b (nv,) as right side."""
        return pack(self.factors.solve(unpack(b)), b)

    def named(self) -> Factors:
        """Name the factors, so that derivatives save them."""
        L, inverse_D = name_factors((self.factors.L, self.factors.inverse_D))
        return Factors(self.factors._replace(L=L, inverse_D=inverse_D))


class Tree(NamedTuple):
    """The tree of a robot at a configuration, in world axes about one origin.

    Fields:
        parents: the parent of each link, or WORLD.
        ancestors: the path from the root to each link.
        axes: for each link, the dofs that move it relative to its parent, with their axes.
        order: the links, parents before children.
        M: rows of the lower triangle of the mass matrix.
        touching: the links that can touch, in the order of `World.twists`.
        link_pairs: pairs of links that can touch, as links of the tree or WORLD.
        weights: inverse inertia of each dof, which scales the error.
    """

    parents: Sequence[int]
    ancestors: Sequence[Sequence[int]]
    axes: list[list[tuple[int, Motion]]]
    order: Sequence[int]
    M: list[list[Lane]]
    touching: Sequence[int]
    link_pairs: Sequence[tuple[int, int]]
    weights: list[Lane]

    def saved(self) -> Tree:
        """Return the tree for factors that a derivative saves."""
        return self

    def twists(self, x: jax.Array, dtype: Any) -> jax.Array:
        """Compute the twists (n + 1, 6) of the links that can touch and of the world at joint
        velocities x (nv,)."""
        found: dict[int, Motion] = {}
        for link in self.touching:
            for i in self.ancestors[link]:
                if i not in found:
                    parent = self.parents[i]
                    own = [S * x[n] for n, S in self.axes[i]]
                    own += [] if parent == WORLD else [found[parent]]
                    found[i] = functools.reduce(operator.add, own) if own else Motion.zero()
        lanes = [list(found[i]) for i in self.touching]
        return stacked([*lanes, [0.0] * 6], dtype)

    def generalized(self, wrenches: jax.Array) -> list[Lane]:
        """Compute the joint forces J^T f from wrenches (n + 1, 6) on the links that can touch."""
        sums: dict[int, Force] = {}
        for k, link in enumerate(self.touching):
            sums[link] = Force.from_lanes([wrenches[k, c] for c in range(6)])
        sums = self._subtree_sums(sums)
        out: list[Lane] = [0.0] * len(self.M)
        for i, f in sums.items():
            for n, S in self.axes[i]:
                out[n] = add(out[n], S.dot(f))
        return out

    def _subtree_sums(self, values: dict[int, Any]) -> dict[int, Any]:
        """Sum the values of links over the subtree of each link. Links without a value are left
        out."""
        out = dict(values)
        for i in reversed(self.order):
            parent = self.parents[i]
            if i in out and parent != WORLD:
                out[parent] = out[parent] + out[i] if parent in out else out[i]
        return out

    def step(self, factors: Factors, b: jax.Array, dtype: Any) -> tuple[jax.Array, jax.Array]:
        """Solve as `Factors.solve`. Return x (nv,) and the link twists (n + 1, 6) at x, as `twists`
        does."""
        x = factors.solve(b)
        return x, self.twists(x, dtype)

    def factorize(self, stiffness: LinkStiffness, rows: Sequence[Stiff]) -> Factors:
        """Factorize the Hessian of the contact problem.

        stiffness: of the contacts of each pair of links.
        rows: of the rows with one force.
        """
        A = [list(row) for row in self.M]
        K = [stiffness.at(k) for k in range(len(self.link_pairs))]
        fixed: dict[int, Any] = {}
        for (a, b), k in zip(self.link_pairs, K, strict=True):
            if WORLD in (a, b):
                link = b if a == WORLD else a
                fixed[link] = fixed[link] + k if link in fixed else k
                continue
            S = relative_axes(self.axes, self.ancestors[a], self.ancestors[b])
            _add_products(A, k, S, sorted(S))
        for i, k in self._subtree_sums(fixed).items():
            for n, S_n in self.axes[i]:
                F = fusion_barrier(k(S_n))
                path = [x for j in self.ancestors[i] for x in self.axes[j] if j != i or x[0] <= n]
                for m, S_m in path:
                    row, column = max(n, m), min(n, m)
                    A[row][column] = add(A[row][column], S_m.dot(F))
        for J, h in rows:
            for i, x in J.items():
                for j, y in J.items():
                    if j <= i:
                        A[i][j] = add(A[i][j], mul(mul(h, x), y))
        return Factors(ldlt(A))


def relative_axes(
    axes: Sequence[Sequence[tuple[int, Motion]]], a: Iterable[int], b: Iterable[int]
) -> dict[int, Motion]:
    """Return the axis of each dof for the motion of one link relative to another.

    a, b: the paths of links from the root to the other link and to the one.
    """
    one, other = set(a), set(b)
    out: dict[int, Motion] = {}
    for i in sorted(one ^ other):
        for n, S in axes[i]:
            own = S if i in other else S * -1.0
            out[n] = out[n] + own if n in out else own
    return out


def _add_products(A: list, K: Any, S: dict[int, Motion], order: list[int]) -> None:
    """Add S_i^T K S_j to the lower triangle of A, for each pair of dofs of `order`."""
    for at, i in enumerate(order):
        F = fusion_barrier(K(S[i]))
        for j in order[: at + 1]:
            A[i][j] = add(A[i][j], S[j].dot(F))


def stacked(rows: Sequence[Sequence[Lane]], dtype: Any) -> jax.Array:
    """Stack equally long rows of lanes to an array (rows, lanes)."""
    flat = [jnp.asarray(x, dtype) for row in rows for x in row]
    return jnp.stack(fusion_barrier(flat)).reshape(len(rows), -1)


class RowsInUse(NamedTuple):
    """The contacts in use of each set, and the limits of hinges and slides that act."""

    contacts: list[InUse]
    limits: LimitsInUse


@dataclass(frozen=True)
class Problem:
    """The convex problem at a state.

    Fields:
        tree: `Tree` or `ArticulatedTree`.
        rhs: tau - b of each dof.
        sets: contacts by their number of rows.
        loose: limits of balls and tendons, friction loss and equalities.
        limits: limits of hinges and slides.
        world: geoms and twists, for the narrow phase.
        dtype: of all arrays.
        slots: the active contacts of each set; empty before `detect`.
        active_limits: the limits that act; None before `detect`.
    """

    tree: Any
    rhs: list[Lane]
    sets: list[ContactSet]
    loose: list[ScalarRow]
    limits: JointLimits
    world: World | None
    dtype: Any
    slots: Sequence[Slots] = ()
    active_limits: LimitSlots | None = None

    @property
    def rows(self) -> list[ScalarRow]:
        """The rows with one force: all limits, friction loss and equalities."""
        return [*self.limits.rows, *self.loose]

    def detect(self, *, gap: bool = False) -> Problem:
        """Return the problem with its active contacts and limits.

        gap: whether to include the contacts in the gap, which have no force.
        """
        slots = [Slots.collect(x, self.touching, gap=gap) for x in self.sets]
        return replace(self, slots=slots, active_limits=self.limits.active())

    @property
    def at_limits(self) -> LimitSlots:
        """The limits that act, of a problem after `detect`."""
        assert self.active_limits is not None
        return self.active_limits

    @property
    def is_constrained(self) -> Any:
        """Whether a contact or another row acts, of a problem after `detect`."""
        if self.loose:
            return True
        return total([x.found.length for x in self.slots] + [self.at_limits.length]) > 0

    @property
    def latched(self) -> bool:
        """Whether the friction of a set of contacts has a latched normal force."""
        return any(isinstance(x, DiscSet) for x in self.sets)

    def bounded(self, short: jax.Array) -> Problem:
        """Return the problem with the curvature of a bound of latched friction, if `short`."""
        sets = [replace(x, bounded=short) if isinstance(x, DiscSet) else x for x in self.sets]
        return replace(self, sets=sets)

    @property
    def touching(self) -> World:
        """The geoms and links that can touch, of a problem with contacts."""
        assert self.world is not None
        return self.world

    def constraint_forces(self, x: jax.Array, used: RowsInUse) -> list[Lane]:
        """Compute J^T f at x (nv,) from the rows in use, with derivatives."""
        twists = self.tree.twists(x, self.dtype)
        wrenches = jnp.zeros_like(twists)
        for contacts, own in zip(self.sets, used.contacts, strict=True):
            wrenches = wrenches + wrenches_in_use(contacts, self.touching, twists, own)[0]
        out = self.tree.generalized(wrenches) if self.tree.touching else [0.0] * len(x)
        lanes, limits = unpack(x), unpack(self.limits.forces(x, used.limits))
        out = [add(f, g) for f, g in zip(out, limits, strict=True)]
        for row in self.loose:
            f, _ = row.response(sub(row.along(lanes), row.reference))
            out = add_row(out, row, f)
        return out

    @property
    def in_use(self) -> RowsInUse:
        """The rows in use, after `detect`. Derivatives save them."""
        found = RowsInUse([InUse.of(slots.found) for slots in self.slots], self.at_limits.in_use)
        return jax.tree.map(lambda x: checkpoint_name(x, "contacts"), found)


def add_row(out: list[Lane], row: ScalarRow, f: Lane) -> list[Lane]:
    """Add the joint forces J^T f of a scalar row with the force f to `out`."""
    out = list(out)
    for i, x in row.J.items():
        out[i] = add(out[i], mul(x, f))
    return out
