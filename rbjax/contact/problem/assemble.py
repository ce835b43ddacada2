"""Assembly of the contact problem of a model at a state."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiler import kernels_available
from rbjax.contact.geometry.candidates import PairKind
from rbjax.contact.geometry.shapes import geom_shape
from rbjax.contact.parameters import pair_parameters
from rbjax.contact.problem.articulated import ArticulatedTree
from rbjax.contact.problem.contact_rows import ContactSet
from rbjax.contact.problem.problem import Problem, Tree, relative_axes, stacked
from rbjax.contact.problem.world import World
from rbjax.contact.rows.dof_rows import friction_rows, limit_rows
from rbjax.contact.rows.equality_rows import equality_rows
from rbjax.contact.rows.limit_slots import JointLimits
from rbjax.contact.rows.options import Options
from rbjax.contact.rows.scalar_row import ScalarRow
from rbjax.contact.rows.tendon_rows import tendon_rows
from rbjax.dynamics.algorithms.crba import mass_matrix_rows
from rbjax.dynamics.algorithms.energy import Entries, product
from rbjax.dynamics.algorithms.kinematics import POSE, TWIST, dof_axes, sweep
from rbjax.dynamics.algorithms.rnea import LinkForces, rnea
from rbjax.dynamics.drivers.choice import Driver, driver, on_threads
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.dynamics.tracing.custom_rules import is_traced
from rbjax.forces.context import Context
from rbjax.forces.tendons.tendon_weights import (
    has_tendon_rows,
    tendon_weights,
    weights_with_tendons,
)
from rbjax.lanes import Lane, Mat3, Vec3, add, sub, unpack
from rbjax.model import WORLD, Model, State, prepare
from rbjax.model.links import lane
from rbjax.spatial import ArticulatedInertia, Force, Motion, Transform


class Touching(NamedTuple):
    """The links and geoms of a model that can touch.

    Fields:
        geoms: the geoms of all pairs.
        links: the links that carry them, without the world.
        of_geom: geom -> link, or WORLD.
        link_pairs: the different pairs of links, the smaller index first.
        pair_of: the index in `link_pairs` of each pair of geoms.
    """

    geoms: list[int]
    links: list[int]
    of_geom: dict[int, int]
    link_pairs: list[tuple[int, int]]
    pair_of: list[int]

    @classmethod
    def of(cls, model: Model) -> Touching:
        """Find the links and geoms of the pairs of a model."""
        own: Any = model.geoms
        links = model.topology.body_links
        pairs = () if own is None else own.pairs
        geoms = sorted({g for pair in pairs for g in pair})
        bodies = {g: own.bodies[g] for g in geoms}
        of_geom = {g: WORLD if b == WORLD else links[b] for g, b in bodies.items()}
        ends = [(of_geom[a], of_geom[b]) for a, b in pairs]
        both = [(min(pair), max(pair)) for pair in ends]
        link_pairs = sorted(set(both))
        touching = sorted(set(of_geom.values()) - {WORLD})
        return cls(geoms, touching, of_geom, link_pairs, [link_pairs.index(x) for x in both])


class Assembly:
    """The parts of the contact problem of a model at (q, v), in world axes about one origin.

    The origin is the last link of the first body that moves. `dt` is the step in s, None for the
    model's timestep, and `t` the time in s, which constraints read. `added` is the matrix h D +
    h^2 K of the `discrete` integrator by entry, which adds to the mass matrix; None for others.
    `iterative`: whether contacts inside a tree are left to conjugate gradients.
    """

    def __init__(
        self, model: Model, q: jax.Array, v: jax.Array, dt: Any = None, t: Any = 0.0,
        added: Entries | None = None, *, iterative: bool = False,
    ):  # fmt: skip
        model = _in_dtype(model, q.dtype)
        self.model, self.q, self.v, self.t, self.top = model, q, v, t, model.topology
        self.dt, self.added = model.timestep if dt is None else dt, added
        self.touching, self.iterative = Touching.of(model), iterative
        self.d = self._driver()
        self.joints = self.d.joints(q, v)
        poses, self._twists = map(self.d.whole, sweep(self.d, self.joints, POSE, TWIST))
        self.origin = poses[min(self.top.last_links.values())].p
        self._poses = [Transform(x.R, x.p - self.origin) for x in poses]

    def problem(self, tau: jax.Array, f_ext: LinkForces | None) -> Problem:
        """Return the problem for applied forces. Contacts are not yet detected."""
        d, dtype = self.d, self.q.dtype
        bias = rnea(d, self.joints, d.lanes(None), d.prepared.gravity, f_ext)
        own = d.whole(bias)[: self.top.nv]
        rhs = [sub(t, b) for t, b in zip(unpack(tau), own, strict=True)]
        world = self._world() if self.touching.geoms else None
        return Problem(self._tree(), rhs, self._sets(), self._rows, self._limits, world, dtype)

    def inverse_dynamics(self, a: jax.Array, f_ext: LinkForces | None) -> jax.Array:
        """Compute M a + b - J^T f_ext (nv,), where M includes the added matrix."""
        d = self.d
        out = d.pack(rnea(d, self.joints, d.lanes(a), d.prepared.gravity, f_ext), a)
        return out + product(self.added, a) if self.added else out

    def _driver(self) -> Driver:
        """Return a driver whose whole form is a list."""
        model, dtype = self.model, self.q.dtype
        if self._articulated and kernels_available():
            d = driver(on_threads(model, dtype), dtype)
            if d.listed:
                return d
        return Unrolled(model, prepare(model, dtype))

    @cached_property
    def _articulated(self) -> bool:
        """Whether articulated-body sweeps solve the problem: other rows are on single dofs, and
        contacts are with the world or, if `iterative`, inside one tree.

        A contact inside a tree, as of a hand with a thigh, is rare and costs iterations of
        conjugate gradients. A contact of two trees, as of a hand with an object, lasts, so a
        factorization in joint space is faster.
        """
        roots = [path[0] for path in self.top.ancestors]
        apart = [pair for pair in self.touching.link_pairs if WORLD not in pair]
        inside = all(roots[a] == roots[b] for a, b in apart) if self.iterative else not apart
        return self.added is None and not self._rows_of_several_dofs and inside

    @property
    def _rows_of_several_dofs(self) -> bool:
        own, kinds = self.model.solver, self.top.joints
        assert own is not None
        balls = any(kinds[j].quaternion for j in own.limited)
        return balls or has_tendon_rows(self.model) or bool(self.model.constraints)

    def _tree(self) -> Tree | ArticulatedTree:
        moving, pairs = self.touching.links, self.touching.link_pairs
        weights = [lane(self._weights[1], i) for i in range(self.top.nv)]
        if self._articulated:
            world = [pair for pair in pairs if WORLD in pair]  # the first ones
            return ArticulatedTree(self.d, self.joints, moving, world, weights)
        M = [list(row) for row in self._mass_matrix]
        for (i, j), x in (self.added or {}).items():
            if j <= i:
                M[i][j] = add(M[i][j], x)
        top = self.top
        return Tree(
            top.parents, top.ancestors, self._axes, top.order, M, moving, pairs, weights
        )  # fmt: skip

    @cached_property
    def _axes(self) -> list[list[tuple[int, Motion]]]:
        """The dofs that move each link relative to its parent, with their axes in world axes."""
        both = enumerate(zip(self._poses, self.joints, strict=True))
        return [
            [(n, pose.motion_to_parent(S)) for n, S in dof_axes(self.top, i, joint)]
            for i, (pose, joint) in both
        ]

    @cached_property
    def _mass_matrix(self) -> list[list[Lane]]:
        """The rows of the lower triangle of the mass matrix."""
        return [row[: i + 1] for i, row in enumerate(mass_matrix_rows(self.d, self.joints))]

    def _inverse_diagonals(self) -> tuple[list[Lane], list[Lane]]:
        """Compute the inverse diagonal entries 1 / m_j of the mass matrix, and of the solver's
        matrix."""
        own = [row[-1] for row in self._mass_matrix]
        solver = [add(m, (self.added or {}).get((i, i), 0.0)) for i, m in enumerate(own)]
        return [1.0 / m for m in own], [1.0 / m for m in solver]

    def _responses(self) -> jax.Array | None:
        """Compute the field `responses` of `World`; None unless matrix terms are added."""
        if self.added is None:
            return None
        tables = []
        for inverse in self._inverse_diagonals():
            rows = []
            for pair in self.touching.link_pairs:
                one, other = (() if i == WORLD else self.top.ancestors[i] for i in pair)
                K = ArticulatedInertia.zero()
                for j, S in sorted(relative_axes(self._axes, one, other).items()):
                    F = Force(S.ang, S.lin)
                    K = K + ArticulatedInertia.outer(F * inverse[j], F)
                rows.append([*K.J, *K.H, *K.M])
            tables.append(stacked(rows, self.q.dtype))
        return jnp.stack(tables)

    def _world(self) -> World:
        own: Any = self.model.geoms
        rows = []
        for g, link in self.touching.of_geom.items():
            fixed = Transform(Mat3.identity(), Vec3.zero())
            weld = fixed if own.bodies[g] == WORLD else self.d.prepared.weld(own.bodies[g])
            shape = geom_shape(self.model, g, weld, self.q.dtype)
            if link == WORLD:
                placed = Transform(shape.R, shape.p - self.origin)
            else:
                placed = self._poses[link].then(Transform(shape.R, shape.p))
            rows.append([*placed.R, *placed.p, *shape.size])
        moving, dtype = self.touching.links, self.q.dtype
        poses = None
        if self._articulated:
            twists = [[*self._twists[i]] for i in moving]
            lanes = [[*self._poses[i].R, *self._poses[i].p] for i in moving]
            poses = stacked([*lanes, [*Mat3.identity(), 0.0, 0.0, 0.0]], dtype)
        else:
            twists = [[*self._poses[i].motion_to_parent(self._twists[i])] for i in moving]
        moved = stacked([*twists, [0.0] * 6], dtype)
        return World(stacked(rows, dtype), moved, poses, own.heights, self._responses())

    @cached_property
    def _weights(self) -> tuple[Any, Any]:
        return weights_with_tendons(self.model, self.q.dtype)

    def _sets(self) -> list[ContactSet]:
        geoms: Any = self.model.geoms
        touching = self.touching
        if not touching.geoms:
            return []
        given = pair_parameters(geoms, geoms.pairs)
        body, _ = self._weights
        zero = jnp.zeros(1, body.dtype) if is_traced(body) else np.zeros(1)
        of_body = (jnp if is_traced(body) else np).concatenate([body[:, 0], zero])
        weights = of_body[np.array([[geoms.bodies[g] for g in pair] for pair in geoms.pairs])]
        links = {link: k for k, link in enumerate(touching.links)} | {WORLD: len(touching.links)}
        place = {g: k for k, g in enumerate(touching.geoms)}
        pairs = geoms.pairs
        tables = (
            np.array([[place[g] for g in pair] for pair in pairs], np.int32),
            np.array([[links[touching.of_geom[g]] for g in pair] for pair in pairs], np.int32),
            np.array(touching.pair_of, np.int32),
            given, weights.sum(-1), self._options, self.q.dtype,
        )  # fmt: skip
        sets = []
        apart = [
            self._articulated and WORLD not in touching.link_pairs[k] for k in touching.pair_of
        ]
        sorts = list(zip(given.condim, apart, strict=True))
        for dim, coupled in sorted(set(sorts)):
            kinds: dict[PairKind, list[int]] = {}
            for n, pair in enumerate(pairs):
                if sorts[n] == (dim, coupled):
                    kinds.setdefault(PairKind.of(geoms, pair), []).append(n)
            own = [touching.link_pairs[touching.pair_of[n]] for x in kinds.values() for n in x]
            grounded = all(WORLD in ends for ends in own)
            sets.append(ContactSet(dim, kinds, *tables, coupled, grounded))
        return sets

    @property
    def _options(self) -> Options:
        own: Any = self.model.solver
        impratio = own.impratio if is_traced(own.impratio) else float(own.impratio)
        discrete = self.added is not None
        return Options(own.cone == "elliptic", impratio, self.dt, own.refsafe, discrete)

    @cached_property
    def _limited(self) -> list[int]:
        """The joints whose limits are found in a loop: hinges and slides, if no matrix terms are
        added."""
        own, kinds = self.model.solver, self.top.joints
        assert own is not None
        return [j for j in own.limited if not kinds[j].quaternion and self.added is None]

    @property
    def _limits(self) -> JointLimits:
        given = self.q, self.v, self._weights[1], self._options
        return JointLimits(self.model, self._limited, *given)

    @cached_property
    def _rows(self) -> list[ScalarRow]:
        """The constraint rows of other limits, friction loss and equalities."""
        model, options = self.model, self._options
        given = model, self.q, self.v, self._weights[1], options
        own: Any = model.solver
        rows = limit_rows(*given, [j for j in own.limited if j not in self._limited])
        rows += friction_rows(*given)
        if has_tendon_rows(model) or model.constraints:
            context = Context.of(model, self.t, State(self.q, self.v), None, d=self.d)
            if has_tendon_rows(model):
                rows += tendon_rows(context, tendon_weights(model), options)
            rows += equality_rows(context, options)
        if self.added is None:
            return rows
        inverses = self._inverse_diagonals()
        return [row.stretched(*inverses) for row in rows]


def _in_dtype(model: Model, dtype: Any) -> Model:
    """Convert the traced parameters of contacts and limits to a dtype."""

    def converted(tree: Any) -> Any:
        return jax.tree.map(lambda x: x.astype(dtype) if is_traced(x) else x, tree)

    kept = {"constants": model.execution.constants, "weights": model.execution.weights}
    parts = {name: converted(getattr(model, name)) for name in ("geoms", "solver", "joints")}
    return model.replace(**parts, **kept)
