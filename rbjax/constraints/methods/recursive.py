"""Constrained motion by recursion over a tree of clusters: articulated bodies with loops.

A row acts on links and joints. Internal forces have no effect beyond the nearest common ancestor of
the links on which they act. The row reaches the joints between these links and the ancestor. Rows
that reach a common joint belong to one cluster. A cluster is a connected part of the tree with one
parent link, so clusters and the remaining joints form a tree again.

In a cluster the articulated-body algorithm eliminates the joints without rows. The result at the
parent is an inertia I_f and a force -p_f and, for the unit multiplier of each row, a force u_i at
each joint and a wrench w. With W = [w ...] the equations of the rows are

    A l = c - sum of u_i u_f,i / D_i - W^T a_p,     A_rs = sum of u_r,i u_s,i / D_i
(u_f: forces at the joints, a_p: acceleration of the parent). So the cluster acts on its parent as

    I = I_f + W A^-1 W^T,     p = p_f - W l_0,     l = l_0 - A^-1 W^T a_p
A contains the rows of one cluster only. If a loop is not exactly closed, W contains the sum of its
forces, so the equations stay exact.

Source: Jain 2012, *Multibody graph transformations and analysis, part II: constraint embedding*;
Chignoli, Adrian, Kim & Wensing 2023, *Recursive rigid-body dynamics algorithms for systems with
kinematic loops*; Carpentier, Budhiraja & Mansard 2021.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax

from rbjax.constraints.equations.constrained_motion import (
    ROWS_ON_LANES,
    LinearProblem,
    Solve,
    constrained_motion,
    delassus_triangle,
    eliminate_loads,
    factor_delassus,
    free_body_diagonal,
    joint_product,
    range_space_problem,
)
from rbjax.constraints.equations.model_rows import wrenches_by_link
from rbjax.constraints.methods.method import Method
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.aba import eliminate, factorize, rigid_mass, to_parent
from rbjax.dynamics.algorithms.factors import Factor
from rbjax.dynamics.algorithms.rnea import LinkForces, rnea, transmitted_forces
from rbjax.dynamics.drivers.choice import Driver
from rbjax.forces.context import Context
from rbjax.forces.element import Loads
from rbjax.lanes import Lane, add, fusion_barrier, is_zero, mul, sub
from rbjax.lanes.arrays import pack, unpack
from rbjax.lanes.factorization import LeastNorm
from rbjax.model import WORLD, Topology
from rbjax.spatial import ArticulatedInertia, Force, Motion, Transform


class Cluster(NamedTuple):
    """Joints that are coupled by rows.

    Fields:
        parent: index of the parent link, or WORLD.
        links: indices of the links that the cluster's joints move.
        rows: indices of the rows.
    """

    parent: int
    links: frozenset[int]
    rows: tuple[int, ...]


def find_clusters(topology: Topology, rows: Sequence[Row]) -> list[Cluster]:
    """Group rows into clusters. A row with a zero gradient forms a cluster without joints."""
    found: list[Cluster] = []
    for r, row in enumerate(rows):
        new = Cluster(*reached_links(topology, row.gradient), (r,))
        for met in [x for x in found if x.links & new.links]:
            found.remove(met)
            # both contain the chain from a common link to their parent: one parent is an ancestor
            parent = min(met.parent, new.parent)
            new = Cluster(parent, met.links | new.links, (*met.rows, *new.rows))
        found.append(new)
    return found


def reached_links(topology: Topology, gradient: Loads) -> tuple[int, frozenset[int]]:
    """Return the nearest common ancestor of a row's forces, and the links that the row reaches."""
    pushed = [i for i, f in wrenches_by_link(gradient).items() if not all(map(is_zero, f))]
    turned = [i for i, x in gradient.tau.items() if not is_zero(x)]
    tops = [topology.parents[i] for i in turned]
    tops += pushed if gradient.internal else [WORLD] * len(pushed)
    common = set.intersection(*(_chain(topology, i) for i in tops)) if tops else set()
    parent = max(common, default=WORLD)  # indices grow along a chain
    carrying = {j for i in pushed + turned for j in _chain(topology, i)}
    return parent, frozenset(carrying - _chain(topology, parent))


def _chain(topology: Topology, link: int) -> set[int]:
    """Return a link and its ancestors."""
    return set() if link == WORLD else set(topology.ancestors[link])


@dataclass(frozen=True)
class Recursive(Method):
    """Index 0, by recursion over clusters of joints in common loops:

        I = I_f + W A^-1 W^T,     A = G_c H_c^-1 G_c^T of one cluster
    The cost is that of the articulated-body algorithm plus the cube of the rows of each cluster.
    Use it for robots with separate loops, for example one in each leg. It requires an unrolled tree
    and clusters of at most 24 rows, and falls back to `Multipliers` otherwise. Both give the same
    accelerations, also with redundant rows. A row with user-defined forces counts as attached to
    the world, unless its `Loads` are `internal`.

    Source: Jain 2012; Chignoli, Adrian, Kim & Wensing 2023.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("four_bar")
        >>> start = model.default_state()
        >>> path = rb.rollout(model, start, None, 1e-3, steps=9, constraints="recursive")
        >>> path.success
        Array(True, dtype=bool)
    """

    name: ClassVar[str] = "recursive"
    family: ClassVar[str] = "minimal"
    index: ClassVar[int] = 0

    def __call__(self, model, t, state, tau, f_ext, alpha=0.0, beta=0.0):
        return constrained_motion(model, t, state, tau, f_ext, alpha, beta, method=cluster_problem)[
            0
        ]


def cluster_problem(
    d: Driver, context: Context, tau: jax.Array, f_ext: LinkForces
) -> LinearProblem:
    """Set up the equations by clusters, or by `range_space_problem` if the tree is not unrolled."""
    if not d.listed or d.topology.frames:
        return range_space_problem(d, context, tau, f_ext)
    joints, gravity = context.links.joints, d.prepared.gravity

    def factor(context: Context, rows: Sequence[Row]) -> Solve:
        found = find_clusters(d.topology, rows)
        if max((len(cluster.rows) for cluster in found), default=0) > ROWS_ON_LANES:
            delassus = factor_delassus(d, factorize(d, joints), context, rows)
            force = tau - d.pack(rnea(d, joints, d.lanes(None), gravity, f_ext), tau)
            return lambda f, c: delassus.solve(force if f is None else f, c)
        moved = d.whole(transmitted_forces(d, joints, d.lanes(None), gravity, f_ext))
        tree = ClusterTree(d, joints, [X for X, *_ in moved], rows, found, tau)
        own = {i: -f for i, (_, f, *_) in enumerate(moved)}
        return lambda f, c: tree.solve(tau, own, c) if f is None else tree.solve(f, {}, c)

    return LinearProblem(None, None, factor)


class EliminatedCluster(NamedTuple):
    """A cluster whose joints and multipliers have been eliminated.

    Fields:
        cluster: the cluster.
        u: force at each joint, for the unit multiplier of each row.
        e: u / D, with the joint-space inertia D of each joint.
        W: wrench at the parent, for the unit multiplier of each row.
        Y: A^-1 W; empty if the parent is the world.
        A: factors of the Delassus matrix of the rows.
    """

    cluster: Cluster
    u: Sequence[dict[int, Lane]]
    e: Sequence[dict[int, Lane]]
    W: Sequence[Force]
    Y: Sequence[Force]
    A: LeastNorm


class ClusterTree:
    """Factors of a robot's mass matrix, and of the rows that couple its joints."""

    def __init__(
        self,
        d: Driver,
        joints: Any,
        poses: Sequence[Transform],
        rows: Sequence[Row],
        found: Sequence[Cluster],
        like: jax.Array,
    ):
        self._d, self._parents = d, d.topology.parents
        self._rows, self._like = rows, like
        self._factors: dict[int, Factor] = {}
        self._found = found
        self._clusters: dict[int, list[EliminatedCluster]] = {}  # by parent link
        constants, joints = d.whole(d.constants), d.whole(joints)
        carried: dict[int, ArticulatedInertia] = {}
        for i in reversed(range(len(joints))):
            link, joint, X = constants[i], joints[i], poses[i]
            I_children = self._with_clusters(i, carried.pop(i, ArticulatedInertia.zero()))
            I_A = joint.inertia(link).articulated() + I_children
            I_a, factor, _ = eliminate(link, joint, X, I_A)
            message, parent = None, self._parents[i]
            if parent != WORLD:
                mass = rigid_mass(link, joint, I_children)
                message = to_parent(X, I_a, factor, mass)
            known = (link, joint, X, I_children)
            message, self._factors[i] = fusion_barrier((message, factor), known=known)
            if parent != WORLD:
                carried[parent] = carried[parent] + message if parent in carried else message
        self._with_clusters(WORLD, ArticulatedInertia.zero())

    def _with_clusters(self, link: int, I: ArticulatedInertia) -> ArticulatedInertia:
        """Eliminate the clusters whose parent is a link, and add their inertias W A^-1 W^T to its
        inertia I."""
        self._clusters[link] = [self._eliminate(x) for x in self._found if x.parent == link]
        more = [x for tied in self._clusters[link] for x in zip(tied.W, tied.Y, strict=False)]
        for w, y in more:
            I = I + ArticulatedInertia.outer(w, y)
        return fusion_barrier(I) if more else I

    def _eliminate(self, cluster: Cluster) -> EliminatedCluster:
        inward = sorted(cluster.links, reverse=True)
        loads = [self._rows[r].gradient for r in cluster.rows]
        units = [
            eliminate_loads(self._parents, self._factors, inward, x, cluster.parent) for x in loads
        ]
        u, e, W = zip(*units, strict=True)
        usual = [free_body_diagonal(self._d, self._rows[r]) for r in cluster.rows]
        A, Y = LeastNorm(delassus_triangle(u, e), usual, self._like.dtype), []
        if cluster.parent != WORLD:
            columns = [A.solve(column) for column in zip(*W, strict=True)]
            Y = [Force.from_lanes(lanes) for lanes in zip(*columns, strict=True)]
        return EliminatedCluster(cluster, u, e, W, Y, A)

    def solve(
        self, tau: jax.Array, forces: Mapping[int, Force], c: Sequence[Lane]
    ) -> tuple[jax.Array, jax.Array]:
        """Solve M a = tau + sum of J_i^T f_i + G^T l, G a = c for a (nv,) and l (rows,). `forces`
        are the f_i on links."""
        u = unpack(tau)
        l = self._inward(u, dict(forces), c)
        a = self._outward(u, l)
        return pack(a, self._like), pack(l, self._like)

    def _inward(self, u: list[Lane], pending: dict[int, Force], c: Sequence[Lane]) -> list[Lane]:
        """Compute the multipliers of the rows for clusters whose parents do not accelerate.

        Args:
            u: generalized forces, which are replaced by the forces at the joints.
            pending: forces on links.
            c: right-hand sides of the rows.
        """
        l: list[Lane] = [0.0] * len(self._rows)

        def solve_clusters(link: int) -> Force:
            """Compute the multipliers of the clusters below a link, and return the force on the
            link."""
            f = pending.pop(link, Force.zero())
            for tied in self._clusters[link]:
                rows, left = tied.cluster.rows, dict(enumerate(u))
                off = [sub(c[r], joint_product(left, e)) for r, e in zip(rows, tied.e, strict=True)]
                for r, x, w in zip(rows, tied.A.solve(off), tied.W, strict=True):
                    l[r], f = x, f + w * x
            return f

        for i in reversed(range(len(u))):
            f, x, parent = solve_clusters(i), self._factors[i], self._parents[i]
            left, message = add(u[i], x.S.dot(f)), None
            if parent != WORLD:
                message = x.X.T(f - x.U * mul(left, x.inverse_D))
                message = pending.get(parent, Force.zero()) + message
            u[i], message = fusion_barrier((left, message), known=(u[i], x))
            if parent != WORLD:
                pending[parent] = message
        solve_clusters(WORLD)
        return l

    def _outward(self, u: list[Lane], l: list[Lane]) -> list[Lane]:
        """Run the outward sweep. Return the accelerations of all dofs.

        u are the joint forces that the inward sweep leaves, l the multipliers of the clusters. l is
        corrected for the accelerations of the parents.
        """
        a, out = {WORLD: Motion.zero()}, []

        def correct_clusters(link: int) -> None:
            """Subtract from the multipliers of the clusters below a link the part that its
            acceleration a_link causes. Add their constraint forces to the joint forces u."""
            for tied in self._clusters[link]:
                rows = tied.cluster.rows
                for r, y in zip(rows, tied.Y, strict=False):
                    l[r] = fusion_barrier(sub(l[r], y.dot(a[link])))
                for r, own in zip(rows, tied.u, strict=True):
                    for i, x in own.items():
                        u[i] = add(u[i], mul(l[r], x))

        correct_clusters(WORLD)
        for i, parent in enumerate(self._parents):
            x = self._factors[i]
            carried = x.X(a[parent])
            qdd = mul(sub(u[i], x.U.dot(carried)), x.inverse_D)
            a[i], qdd = fusion_barrier((carried + x.S * qdd, qdd), known=(x, a[parent]))
            out.append(qdd)
            correct_clusters(i)
        return out
