"""Soft contact: the constraint model of MuJoCo as a dynamics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.contact.contact_rows import ContactSet, Options, World
from rbjax.contact.impedance import impedance, reference, regularisation
from rbjax.contact.inverse_weights import inverse_weights
from rbjax.contact.newton import ITERATIONS, factorize_at, solve
from rbjax.contact.parameters import pair_parameters
from rbjax.contact.problem import Problem, Tree, stacked
from rbjax.contact.scalar_rows import FRICTION, LIMIT, ScalarRow
from rbjax.dynamics.algorithms.crba import mass_matrix_rows
from rbjax.dynamics.algorithms.kinematics import POSE, TWIST, sweep
from rbjax.dynamics.algorithms.rnea import rnea
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.dynamics.tracing.custom_rules import (
    is_traced,
    jax_arrays,
    split_tracers,
    with_implicit_jvp,
)
from rbjax.lanes import Lane, Mat3, Vec3, batch_first, mul, neg, quaternion_matrix, sub
from rbjax.model import WORLD, Model, State, prepare
from rbjax.model.links import lane
from rbjax.spatial import Motion, Transform


def columns(tree: Any) -> Any:
    """Convert concrete leaves to numpy arrays, whose entries are literals."""
    return jax.tree.map(lambda x: x if is_traced(x) else np.asarray(x, np.float64), tree)


class _Builder:
    """The parts of the problem of a model at (q, v)."""

    def __init__(self, model: Model, q: jax.Array, v: jax.Array, dt: Any):
        self.model, self.dtype, self.dt = model, q.dtype, dt
        self.q, self.v = q, v
        self.top = model.topology
        self.d = Unrolled(model, prepare(model, q.dtype))
        self.joints = self.d.joints(q, v)
        poses, self._twists = sweep(self.d, self.joints, POSE, TWIST)
        root = poses[self._root()].p
        self.poses = [Transform(x.R, x.p - root) for x in poses]
        self.root = root

    def _root(self) -> int:
        """Return the last link of the first body that moves; the origin is at it."""
        return min(self.top.last_links.values())

    def tree(self, touching: list[int], link_pairs: list[tuple[int, int]]) -> Tree:
        d, top = self.d, self.top
        S = [X.motion_to_parent(j.S) for X, j in zip(self.poses, self.joints, strict=True)]
        M = [row[: i + 1] for i, row in enumerate(mass_matrix_rows(d, self.joints))]
        return Tree(top.parents, top.ancestors, S, M, touching, link_pairs)

    def world(self, geoms: list[int], touching: list[int]) -> World:
        own = columns(self.model.geoms)
        rows = []
        for g in geoms:
            body = own.bodies[g]
            quat, p, size = (
                [lane(column, k) for k in range(column.shape[1])]
                for column in (own.orientation, own.position, own.size)
                for column in (column[g : g + 1],)
                for column in (column.T,)
            ) if False else _geom_lanes(own, g)
            placed = Transform(quaternion_matrix(*quat), Vec3(*p))
            if body != WORLD:
                placed = self.d.prepared.weld(body).then(placed)
            link = WORLD if body == WORLD else self.top.body_links[body]
            if link != WORLD:
                placed = self.poses[link].then(placed)
            else:
                placed = Transform(placed.R, placed.p - self.root)
            rows.append([*placed.R, *placed.p, *size])
        twists = [list(self.poses[i].motion_to_parent(self._twists[i])) for i in touching]
        return World(
            stacked(rows, self.dtype), stacked([*twists, [0.0] * 6], self.dtype)
        )  # fmt: skip

    def bias(self, f_ext: Any) -> list[Lane]:
        d = self.d
        return rnea(d, self.joints, d.lanes(None), d.prepared.gravity, f_ext)

    def contact_sets(self) -> tuple[list[ContactSet], list[int], list[int], list[tuple[int, int]]]:
        """Return the sets, the geoms and links that can touch, and the pairs of links."""
        geoms = self.model.geoms
        if geoms is None or not geoms.pairs:
            return [], [], [], []
        pairs = geoms.pairs
        used = sorted({g for pair in pairs for g in pair})
        link_of = {g: WORLD if geoms.bodies[g] == WORLD else self.top.body_links[geoms.bodies[g]]
                   for g in used}  # fmt: skip
        touching = sorted({link for link in link_of.values() if link != WORLD})
        place = {link: k for k, link in enumerate(touching)} | {WORLD: len(touching)}
        of_pair = [tuple(sorted((link_of[a], link_of[b]))) for a, b in pairs]
        link_pairs = sorted(set(of_pair))
        given = pair_parameters(geoms, pairs)
        body, _ = columns(inverse_weights(self.model))
        own = [[geoms.bodies[g] for g in pair] for pair in pairs]
        xp = jnp if is_traced(body) else np
        tran = xp.concatenate([body[:, 0], xp.zeros(1)])
        weights = tran[np.array(own)].sum(-1)
        solver = self.model.solver
        options = Options(
            solver.cone == "elliptic", lane(columns(solver.impratio).reshape(1), 0), self.dt,
            solver.refsafe,
        )  # fmt: skip
        sets = []
        condim = given.condim
        tables = columns(given._replace(condim=()))
        for dim in sorted(set(condim)):
            kinds: dict[tuple[str, str], list[int]] = {}
            for n, (a, b) in enumerate(pairs):
                if condim[n] == dim:
                    kinds.setdefault((geoms.types[a], geoms.types[b]), []).append(n)
            sets.append(
                ContactSet(
                    dim, kinds,
                    np.array([[used.index(g) for g in pair] for pair in pairs], np.int32),
                    np.array([[place[link_of[g]] for g in pair] for pair in pairs], np.int32),
                    np.array([link_pairs.index(x) for x in of_pair], np.int32),
                    tables, weights, options, self.dtype,
                )
            )  # fmt: skip
        return sets, used, touching, link_pairs

    def scalar_rows(self) -> list[ScalarRow]:
        solver = self.model.solver
        if not (solver.limited or solver.rubbing):
            return []
        own, range_ = columns(solver), columns(self.model.joints.range)
        _, weights = columns(inverse_weights(self.model))
        rows = [row for j in solver.limited for row in self._limits(j, own, range_, weights)]
        for i in solver.rubbing:
            solref, solimp = _row(own.friction_solref, i), _row(own.friction_solimp, i)
            d = impedance(0.0, solimp)
            a = reference(0.0, self.v[i], d, solref, solimp, self.dt, solver.refsafe)
            D = 1.0 / regularisation(d, lane(weights, i))
            rows.append(ScalarRow(FRICTION, {i: 1.0}, D, a, lane(own.frictionloss, i)))
        return rows

    def _limits(self, j: int, own: Any, range_: Any, weights: Any) -> list[ScalarRow]:
        at, i = self.top.joint_q[j], self.top.joint_v[j]
        low, high = lane(range_[j], 0), lane(range_[j], 1)
        margin = lane(own.limit_margin, j)
        if self.top.joints[j].quaternion:
            angle, axis = _rotation(*(self.q[at + k] for k in range(4)))
            ends = [(high - angle, {i + k: neg(x) for k, x in enumerate(axis)})]
        else:
            x = self.q[at]
            ends = [(x - low, {i: 1.0}), (high - x, {i: -1.0})]
        solref, solimp = _row(own.limit_solref, j), _row(own.limit_solimp, j)
        rows = []
        for distance, J in ends:
            active = distance < margin
            r = jnp.where(active, distance - margin, 0.0)
            d = impedance(r, solimp)
            v = sum(mul(x, self.v[k]) for k, x in J.items())
            a = reference(r, v, d, solref, solimp, self.dt, own.refsafe)
            D = jnp.where(active, 1.0 / regularisation(d, lane(weights, i)), 0.0)
            rows.append(ScalarRow(LIMIT, J, D, a))
        return rows


def _geom_lanes(own: Any, g: int) -> tuple[list, list, list]:
    return _row(own.orientation, g), _row(own.position, g), _row(own.size, g)


def _row(table: Any, i: int) -> list[Lane]:
    return [lane(table[i], k) for k in range(table.shape[1])]


def _rotation(w: Lane, x: Lane, y: Lane, z: Lane) -> tuple[Lane, Vec3]:
    """Return angle in [0, pi] and axis of a unit quaternion."""
    sign = jnp.where(w < 0, -1.0, 1.0)
    u = Vec3(x, y, z) * sign
    square = u.dot(u)
    small = square < 1e-24
    s = jnp.sqrt(jnp.where(small, 1.0, square))
    axis = Vec3(*(jnp.where(small, e, a / s) for a, e in zip(u, (1.0, 0.0, 0.0), strict=True)))
    return jnp.where(small, 0.0, 2.0 * jnp.arctan2(s, w * sign)), axis


def problem_at(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: Any, dt: Any
) -> tuple[Problem, _Builder]:
    """Build the problem of a model at a state. Contacts are not yet detected."""
    at = _Builder(model, q, v, dt)
    sets, geoms, touching, link_pairs = at.contact_sets()
    tree = at.tree(touching, link_pairs)
    rhs = [sub(t, b) for t, b in zip(at.d.lanes(tau), at.bias(f_ext), strict=True)]
    world = at.world(geoms, touching) if geoms else None
    return Problem(tree, rhs, sets, at.scalar_rows(), world, q.dtype), at


def contact_acceleration(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: Any, dt: Any,
    start: jax.Array | None = None, iterations: int = ITERATIONS,
) -> tuple[jax.Array, jax.Array, jax.Array]:  # fmt: skip
    """Compute the acceleration with contacts, limits and friction loss, iterations and error.

    The derivative is implicit, by the factors of the Hessian at the solution.
    """
    start = jnp.zeros_like(v) if start is None else jax.lax.stop_gradient(start)
    given, rebuilt = split_tracers((model, f_ext, dt))

    def solved_at(at: tuple) -> tuple[Problem, Any]:
        changed, q, v, tau, start = at
        model, f_ext, dt = rebuilt(changed)
        problem, _ = problem_at(model, q, v, tau, f_ext, dt)
        problem.detect()
        return problem, solve(problem, start, iterations=iterations)

    def plain(*at):
        _, found = solved_at(at)
        return batch_first((found.x,), at)

    def solved(*at):
        problem, found = solved_at(at)
        factors = factorize_at(problem, found.x)

        def change(b):
            return jnp.stack([jnp.asarray(y, b.dtype) for y in factors.solve(list(b))])

        return (found.x,), [change]

    def residual(changed, q, v, tau, start, x):
        model, f_ext, dt = rebuilt(changed)
        problem, at = problem_at(model, q, v, tau, f_ext, dt)
        d = at.d
        lanes = d.lanes(x)
        needed = rnea(d, at.joints, lanes, d.prepared.gravity, f_ext)
        forces = problem.constraint_forces(lanes)
        return tau + d.pack(forces, tau) - d.pack(needed, tau)

    return with_implicit_jvp(plain, solved, residual)(*jax_arrays(given, q, v, tau, start))[0]


@dataclass(frozen=True)
class SoftContact:
    """MuJoCo's law of contact, as a `Dynamics` and `VelocityDynamics`.

    iterations: the largest number of Newton steps.
    """

    iterations: int = ITERATIONS

    def __call__(self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: Any) -> Any:
        """Compute the acceleration (nv,)."""
        return contact_acceleration(
            model, state.q, state.v, tau, f_ext, model.timestep, iterations=self.iterations
        )

    def initial_memory(self, model: Model) -> jax.Array:
        """Return the acceleration from which the first solve starts."""
        return jnp.zeros(model.nv)

    def advance_velocity(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: Any, dt: Any
    ) -> tuple[jax.Array, jax.Array]:
        """Compute the velocity after a step, and the acceleration as the next start."""
        a = contact_acceleration(
            model, state.q, state.v, tau, f_ext, dt, state.memory, self.iterations
        )
        return state.v + dt * a, a


def twist_of(m: Motion, R: Mat3) -> Motion:
    """Rotate a motion."""
    return Motion(R @ m.ang, R @ m.lin)
