"""Coulomb's law on MuJoCo's soft normal contact: no creep, no lift by friction, no direction.

    v+ = v + h a,   a the solution of the contact problem with latched friction (`latched_disc`)
The normal rows are those of MuJoCo's law. Friction is implicit in the velocity after the step and
limited by the normal force, which friction does not change directly. The latched forces F follow by
the fixed-point iteration F <- f_0(a(F)) with Anderson's acceleration, from the forces of the last
step. Without acceleration it converges at the rate mu |A_nt| / A_nn of the inverse inertias at the
contacts, and fails as Painleve's paradox does.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer, real_number
from rbjax.contact.geometry.candidates import PairKind
from rbjax.contact.geometry.narrow_phase import COUNTS
from rbjax.contact.parameters import pair_parameters
from rbjax.contact.problem.assemble import Assembly
from rbjax.contact.problem.contact_rows import Slots
from rbjax.contact.problem.in_use import wrenches_in_use
from rbjax.contact.problem.latched_disc import DiscSet, memory_width
from rbjax.contact.problem.problem import Problem, RowsInUse
from rbjax.contact.soft import SoftContact
from rbjax.contact.solver.contact_forces import geoms_of_rows, rows_in_use, rows_of_slots
from rbjax.contact.solver.newton import ITERATIONS, Solution, check_iterations, factorize_at, solve
from rbjax.contact.solver.solution import (
    ContactSolution,
    SolutionArrays,
    sources_of_rows,
    with_rule_of,
)
from rbjax.dynamics.algorithms.rnea import LinkForces
from rbjax.dynamics.tracing.custom_rules import jax_arrays, split_tracers, with_implicit_jvp
from rbjax.lanes import batch_first, pack
from rbjax.model import Model, State
from rbjax.solvers.anderson import History, accelerate

#: bytes of a number -> the relative change of the latched forces at which the iteration ends
LATCHED = {4: 1e-5, 8: 1e-11}


class _Found(NamedTuple):
    """The result of the iteration on the normal forces: the solution, the normal forces that bound
    the friction in each set, their relative change in the last round, the number of rounds, and
    the history that accelerates them, None without friction."""

    solution: Solution
    latches: list[jax.Array]
    error: jax.Array
    rounds: jax.Array
    history: History | None


@dataclass(frozen=True)
class CoulombContact:
    """Dynamics of a step with soft normal contact, Coulomb's friction and true sticking.

    Use it instead of MuJoCo's law if creep matters (a robot that stands on a slope, a grasp), for
    long slides, and for friction of equal size in all directions. Pass it as `contact=` to `step`
    and `rollout`. `contact="coulomb"` has the default arguments. Contacts of condim 4 and 6 have
    the ellipsoid sum (f_k / mu_k)^2 <= f_n^2. Friction loss, limits and the parameters of the
    normal direction are those of the file. Other forces are those at the start of the step:
    a joint with damping d and inertia m needs h d < 2 m.

    The memory contains the normal force and the bristle of each candidate, and at its end the error
    of the step: the relative change of the normal forces in the last iteration, or the error of
    its solution if it is larger.

    Args:
        share: share of the displacement of a sticking contact that a step removes, 0 to 1.
        stiffness: impedance of friction that sticks, at most 0.9999.
        rounds: largest number of iterations of the normal forces in a step.
        iterations: largest number of Newton steps of each iteration.

    Raises:
        InputError: numbers outside their ranges.

    Source: De Saxce & Feng 1998; Hayward & Armstrong 2000.

    Example:
        >>> import rbjax as rb
        >>> rb.contact.CoulombContact(rounds=10).rounds
        10
    """

    share: float = 0.2
    stiffness: float = 0.999
    rounds: int = 30
    iterations: int = ITERATIONS

    def __post_init__(self) -> None:
        at = "CoulombContact"
        real_number(at, "share", self.share, least=0.0, most=1.0)
        real_number(at, "stiffness", self.stiffness, above=0.0, most=0.9999)
        integer(at, "rounds", self.rounds, least=1)
        check_iterations(at, self.iterations)

    def check(self, where: str, model: Model) -> None:
        """Raise InputError if the law has no parameters for a model."""
        SoftContact().check(where, model, "coulomb")

    def initial_memory(self, model: Model) -> jax.Array:
        """Return the memory of bristles at rest, all zeros."""
        size = sum(n * memory_width(dim) for dim, n in _candidates(model).items())
        return jnp.zeros(size + 1, model.gravity.dtype)

    def solver_tolerance(self, dtype: Any) -> float:
        """Return the largest error of a converged step, in a dtype: ten times the error at which
        the iteration ends, since rounding may leave more."""
        return 10 * LATCHED[jnp.dtype(dtype).itemsize]

    def solver_error(self, memory: jax.Array) -> jax.Array:
        """Return the error of the step that returned a memory (m,)."""
        return memory[..., -1]

    def advance_velocity(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces, dt: Any
    ) -> tuple[jax.Array, jax.Array]:
        """Compute the velocity (nv,) and the memory after a step dt."""
        a, memory, _ = self._accelerated(model, t, state, tau, f_ext, dt)
        return state.v + dt * a, memory

    def solve(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces | None,
        dt: Any = None,
    ) -> ContactSolution:  # fmt: skip
        """Compute the mean acceleration of a step with all forces, and the report of the solver.

        dt: step in s; None for the model's timestep. Without `State.memory` bristles are at rest.
        """
        dt = model.timestep if dt is None else dt
        memory = self.initial_memory(model) if state.memory is None else state.memory
        given, rebuilt = split_tracers((model, f_ext, dt, t if model.constraints else 0.0))
        names: list[tuple] = []  # of the rows, which are known after tracing

        def problem_at(changed: Any, q: Any, v: Any, tau: Any, memory: Any) -> tuple[Any, Problem]:
            model, f_ext, dt, t = rebuilt(changed)
            assembly = Assembly(model, q, v, dt, t)
            problem = self._with_bristles(assembly.problem(tau, f_ext), memory, dt)
            names[:] = geoms_of_rows(model, problem.sets), sources_of_rows(problem)
            return assembly.origin, problem

        def plain(*at: Any) -> SolutionArrays:
            origin, problem = problem_at(*at)
            problem = _detected(problem, gap=True)
            found = _iterate(problem, self.rounds, self.iterations)
            problem = _latched(problem, found.latches)
            x, report = found.solution.x, (found.rounds, found.error)
            contacts = rows_of_slots(problem, found.solution, origin)
            return SolutionArrays.of(problem, contacts, x, *(y.astype(x.dtype) for y in report))

        def differentiable(changed: Any, q: Any, v: Any, tau: Any, memory: Any) -> SolutionArrays:
            model, f_ext, dt, t = rebuilt(changed)
            at = State(q, v, memory=memory)
            a, after, rounds = self._accelerated(model, t, at, tau, f_ext, dt)
            origin, problem = problem_at(changed, q, v, tau, memory)
            still = problem_at(*jax.lax.stop_gradient((changed, q, v, tau, memory)))[1]
            used = _detected(still, gap=True).in_use
            contacts = rows_in_use(problem, used, a, origin)
            return SolutionArrays.of(problem, contacts, a, rounds, self.solver_error(after))

        run = with_rule_of(plain, differentiable)
        found = run(given, state.q, state.v, tau, memory.astype(state.q.dtype))
        return found.solution(*names, self.solver_tolerance(state.q.dtype))

    def _accelerated(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces | None, dt: Any
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Compute the acceleration (nv,), the memory after a step dt, and the number of rounds, as
        a real number."""
        assert state.memory is not None
        given, rebuilt = split_tracers((model, f_ext, dt, t if model.constraints else 0.0))

        def problem_at(changed: Any, q: Any, v: Any, tau: Any, memory: Any) -> tuple[Any, Problem]:
            model, f_ext, dt, t = rebuilt(changed)
            assembly = Assembly(model, q, v, dt, t)
            return assembly, self._with_bristles(assembly.problem(tau, f_ext), memory, dt)

        def solved_at(*at: Any) -> tuple[Problem, _Found]:
            problem = _detected(problem_at(*at)[1])
            found = _iterate(problem, self.rounds, self.iterations)
            return _latched(problem, found.latches), found

        def results(problem: Problem, found: _Found) -> tuple:
            x = found.solution.x
            return x, _memory_of_slots(problem, found), found.rounds.astype(x.dtype)

        def plain(*at: Any) -> Any:
            return batch_first(results(*solved_at(*at)), at)

        def solved(*at: Any) -> tuple[Any, ...]:
            problem, found = solved_at(*at)
            change = _linear_solver(problem, found.solution)
            return results(problem, found), [change, lambda b: b], problem.in_use

        def equation(*at_and_a: Any) -> jax.Array:
            *at, a, used = at_and_a
            assembly, problem = problem_at(*at)
            _, f_ext, *_ = rebuilt(at[0])
            tau = at[3]
            pushes = pack(problem.constraint_forces(a, used), tau)
            return tau + pushes - assembly.inverse_dynamics(a, f_ext)

        def remembered(*at_and_after: Any) -> jax.Array:
            *at, a, memory, used = at_and_after
            _, problem = problem_at(*at)
            return _memory_in_use(problem, a, memory, used) - memory

        run = with_implicit_jvp(plain, solved, equation, remembered)
        return run(*jax_arrays(given, state.q, state.v, tau, state.memory))

    def _with_bristles(self, problem: Problem, memory: jax.Array, dt: Any) -> Problem:
        """Return the problem with sets of contacts whose friction has bristles.

        memory: bristles of the last step. dt: step, s.
        """
        dtype, sets, start = problem.dtype, list[Any](), 0
        for contacts in problem.sets:
            n, width = contacts.candidates, memory_width(contacts.dim)
            if width:
                own = memory[start : start + n * width].reshape(n, width)
                start += n * width
                contacts = DiscSet.of(
                    contacts, own, jnp.asarray(dt, dtype), self.share, self.stiffness
                )
            sets.append(contacts)
        return dataclasses.replace(problem, sets=sets)


def _candidates(model: Model) -> dict[int, int]:
    """Count the candidate contacts of a model by their number of rows (condim)."""
    geoms, out = model.geoms, dict[int, int]()
    if geoms is None or not geoms.pairs:
        return out
    condim = pair_parameters(geoms, geoms.pairs).condim
    for pair, dim in zip(geoms.pairs, condim, strict=True):
        out[dim] = out.get(dim, 0) + COUNTS[PairKind.of(geoms, pair).kinds]
    return dict(sorted(out.items()))


def _detected(problem: Problem, *, gap: bool = False) -> Problem:
    """Return the problem with its active limits, and the contacts that the narrow phase finds.

    gap: whether to include the contacts in the gap, which have no force.
    """
    slots = list[Any]()
    for contacts in problem.sets:
        if isinstance(contacts, DiscSet):
            slots.append(contacts.collect(problem.touching, gap=gap))
        else:
            slots.append(Slots.collect(contacts, problem.touching, gap=gap))
    return dataclasses.replace(problem, slots=slots, active_limits=problem.limits.active())


def _discs(problem: Problem, *others: Any) -> list[tuple]:
    """Return (set, active contacts, further values) of each set with friction.

    others: lists with one value per set.
    """
    every = zip(problem.sets, problem.slots, *others, strict=True)
    return [x for x in every if isinstance(x[0], DiscSet)]


def _residual(r: jax.Array, k: Any) -> list[Any]:
    return [r[k, i] for i in range(r.shape[1])]


def _latched(problem: Problem, latches: list[jax.Array]) -> Problem:
    """Return the problem with the normal forces `latches` as bounds of the friction of its sets."""
    given, old = iter(latches), list[Any](problem.slots)
    slots = [
        s._replace(latches=next(given)) if isinstance(x, DiscSet) else s
        for x, s in zip(problem.sets, old, strict=True)
    ]
    return dataclasses.replace(problem, slots=slots)


def _iterate(problem: Problem, rounds: int, iterations: int) -> _Found:
    """Iterate the normal forces that bound friction, until they are the normal forces of the
    solution: F <- f(F), with Anderson's acceleration."""
    dtype = problem.dtype
    tiny, bound = jnp.finfo(dtype).tiny, LATCHED[jnp.dtype(dtype).itemsize]

    def step(at: _Found) -> _Found:
        latched = _latched(problem, at.latches)
        found = solve(latched, iterations=iterations)
        new, change, size = list[Any](), jnp.zeros((), dtype), jnp.full((), tiny, dtype)
        sets = _discs(latched, found.residuals)
        for (contacts, slots, r), old in zip(sets, at.latches, strict=True):

            def normal(k: Any, out: Any, of: Any = contacts, slots: Any = slots, r: Any = r) -> Any:
                return out.at[k].set(of.cone(slots.row(k, of.dim)).normal(r[k, 0]))

            f = slots.fold(normal, jnp.zeros_like(old))
            change = jnp.maximum(change, jnp.abs(f - old).max(initial=0.0))
            size = jnp.maximum(size, f.max(initial=0.0))
            new.append(f)
        error = change / size
        latches, history = new, at.history
        if history is not None:
            f = jnp.concatenate(new)
            ahead, history = accelerate(history, jnp.concatenate(at.latches), f, error)
            ahead = jnp.where(error <= bound, f, jnp.maximum(ahead, 0.0))
            latches = jnp.split(ahead, np.cumsum([len(x) for x in new])[:-1])
        return _Found(found, latches, error, at.rounds + 1, history)

    def unfinished(at: _Found) -> jax.Array:
        return (at.error > bound) & (at.rounds < rounds)

    infinite = jnp.full((), jnp.inf, dtype)
    residuals = [jnp.zeros((s.rows.shape[0], x.dim), dtype) for x, s in
                 zip(problem.sets, problem.slots, strict=True)]  # fmt: skip
    none = Solution(jnp.zeros(len(problem.rhs), dtype), jnp.int32(0), infinite, residuals)
    latches = [slots.latches for _, slots in _discs(problem)]
    history = History.start(jnp.concatenate(latches)) if latches else None
    start = _Found(none, latches, infinite, jnp.int32(0), history)
    return jax.lax.while_loop(unfinished, step, start)


def _linear_solver(problem: Problem, solution: Solution) -> Any:
    """Return the function b -> (-d equation / dx)^-1 b, if friction f depends on normal forces F.

    It solves H y = b + J^T (df / dF) dF(y), with H the matrix at constant normal forces.
    """
    factors = factorize_at(problem, solution)
    tree, dtype = problem.tree, problem.dtype

    def coupled(y: jax.Array) -> jax.Array:
        moving = tree.twists(y, dtype)
        wrenches = jnp.zeros((len(tree.touching) + 1, 6), dtype)
        for contacts, slots, residuals in _discs(problem, solution.residuals):
            r = slots.used(residuals)

            def push(k: Any, out: Any, of: Any = contacts, slots: Any = slots, r: Any = r) -> Any:
                row = slots.row(k, of.dim)
                cone = of.cone(row)
                sticks, _, t = cone.slip(_residual(r, k))
                rate = of.rates(row, moving)[0]
                change = jnp.where(sticks | (r[k, 0] >= 0), 0.0, -row.D * rate)
                f = [0.0, *(-change * m * u for m, u in zip(cone.mu, t, strict=True))]
                return of.add_forces(row, out, f)

            wrenches = slots.scan(push, wrenches)
        return pack(tree.generalized(wrenches), y)

    if not _discs(problem):
        return factors.solve
    unit = jnp.eye(len(problem.rhs), dtype=dtype)
    columns = jax.lax.map(lambda y: y - factors.solve(coupled(y)), unit)
    return lambda b: jnp.linalg.solve(columns.T, factors.solve(b))


def _memory_of_slots(problem: Problem, found: _Found) -> jax.Array:
    """Compute the memory (bristles and normal forces) after a step from the active contacts."""
    parts = list[Any]()
    for contacts, slots, r in _discs(problem, found.solution.residuals):

        def store(k: Any, out: Any, of: Any = contacts, slots: Any = slots, r: Any = r) -> Any:
            row = slots.row(k, of.dim)
            return out.at[row.candidate].set(of.next_memory(row, _residual(r, k), True))

        parts.append(slots.fold(store, jnp.zeros_like(contacts.memory)).reshape(-1))
    error = jnp.maximum(found.error, found.solution.error)
    return jnp.concatenate([*parts, error[None]])


def _memory_in_use(problem: Problem, a: jax.Array, memory: jax.Array, used: RowsInUse) -> jax.Array:
    """Compute the memory after a step from the contacts in use, with derivatives."""
    twists, parts = problem.tree.twists(a, problem.dtype), list[Any]()
    for contacts, own in zip(problem.sets, used.contacts, strict=True):
        if isinstance(contacts, DiscSet):
            new = lambda of, row, f, r: of.next_memory(row, r, True)  # noqa: E731
            given = contacts, problem.touching, twists, own
            parts.append(wrenches_in_use(*given, new, contacts.memory.shape[1])[1].reshape(-1))
    return jnp.concatenate([*parts, memory[-1:]])
