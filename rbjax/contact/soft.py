"""Soft contact: the constraint model of MuJoCo as a dynamics."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from rbjax.arguments import real_number
from rbjax.compiler import threads
from rbjax.contact.problem.assemble import Assembly
from rbjax.contact.problem.problem import Problem, RowsInUse
from rbjax.contact.rows.equality_rows import check_soft
from rbjax.contact.solver.contact_forces import (
    geoms_of_rows,
    rows_in_use,
    rows_of_slots,
)
from rbjax.contact.solver.linear_solution import linear_solver
from rbjax.contact.solver.newton import (
    ITERATIONS,
    Solution,
    check_iterations,
    solve,
    tolerance_of,
)
from rbjax.contact.solver.solution import (
    ContactSolution,
    SolutionArrays,
    sources_of_rows,
    with_rule_of,
)
from rbjax.dynamics.algorithms.energy import Entries, product, velocity_of
from rbjax.dynamics.algorithms.rnea import LinkForces
from rbjax.dynamics.tracing.custom_rules import (
    jax_arrays,
    split_tracers,
    with_implicit_jvp,
)
from rbjax.errors import InputError
from rbjax.lanes import batch_first, pack
from rbjax.model import Model, State


def detected(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: LinkForces | None,
    dt: Any = None, t: Any = 0.0, added: Entries | None = None,
) -> Problem:  # fmt: skip
    """Return the contact problem of a model, with its active contacts.

    `dt` is the step, or None for the model's timestep. `added` is as in `Assembly`.
    """
    problem = Assembly(model, q, v, dt, t, added, iterative=True).problem(tau, f_ext)
    return problem.detect()


def contact_acceleration(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: LinkForces | None,
    iterations: int = ITERATIONS, dt: Any = None, t: Any = 0.0, added: Entries | None = None,
) -> tuple[jax.Array, ...]:  # fmt: skip
    """Compute the acceleration (nv,) with contacts, limits, friction loss and equalities. Return
    with it the number of Newton steps, as a real number, and the error of the solution; in the
    `discrete` integrator also the number of rows that act on each link (nv,).

    The derivative is implicit: da = H^-1 d(tau + J^T f - M a - b), with H and f at the solution.
    The features of geoms that touch are held constant. `added` is as in `Assembly`.
    """
    given, rebuilt = split_tracers((model, f_ext, dt, t, added))

    def solved_at(changed, q, v, tau) -> tuple[Problem, Solution]:
        model, f_ext, *rest = rebuilt(changed)
        problem = detected(model, q, v, tau, f_ext, *rest)
        return problem, solve(problem, iterations=iterations)

    def results(problem, found):
        counts = () if added is None else (_rows_of_links(problem, found.x),)
        return *_with_report(found), *counts

    def plain(*at):
        return batch_first(results(*solved_at(*at)), at)

    def solved(*at):
        problem, found = solved_at(*at)
        # a derivative that saves these values does not solve the problem again
        solve_linear = linear_solver(problem, found)
        values = tuple(checkpoint_name(x, "acceleration") for x in results(problem, found))
        return values, [solve_linear], problem.in_use

    def residual(changed, q, v, tau, a, used):
        model, f_ext, *rest = rebuilt(changed)
        assembly = Assembly(model, q, v, *rest, iterative=True)
        problem = assembly.problem(tau, f_ext)
        pushes = pack(problem.constraint_forces(a, used), tau)
        return tau + pushes - assembly.inverse_dynamics(a, f_ext)

    return with_implicit_jvp(plain, solved, residual)(*jax_arrays(given, q, v, tau))


def damped_acceleration(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: LinkForces | None,
    iterations: int, dt: Any, t: Any, damping: Entries,
) -> tuple[jax.Array, ...]:  # fmt: skip
    """Compute (M + A)^-1 M a (nv,) of the acceleration a of `contact_acceleration`, with the same
    report. damping: entries of the diagonal matrix A.

    The solver factorizes M + A by the code of its steps, which keeps the program short.
    """
    given, rebuilt = split_tracers((model, f_ext, dt, t, damping))

    def plain(changed, q, v, tau):
        model, f_ext, dt, t, damping = rebuilt(changed)
        problem = detected(model, q, v, tau, f_ext, dt, t)
        diagonal = {i: x for (i, _), x in damping.items()}
        found = solve(problem, iterations=iterations, added=diagonal)
        _, *report = _with_report(found)
        return batch_first((found.damped, *report), (changed, q, v, tau))

    def differentiable(changed, q, v, tau):
        model, f_ext, dt, t, damping = rebuilt(changed)
        a, *report = contact_acceleration(model, q, v, tau, f_ext, iterations, dt, t)
        return a - velocity_of(model, q, product(damping, a), damping), *report

    return with_rule_of(plain, differentiable)(given, q, v, tau)


def _with_report(found: Solution) -> tuple[jax.Array, jax.Array, jax.Array]:
    return found.x, found.iterations.astype(found.x.dtype), found.error


def _rows_of_links(problem: Problem, like: jax.Array) -> jax.Array:
    """Count the contacts on each link and the active rows on each dof, (nv,)."""
    counts: list[Any] = [0.0] * len(like)
    for row in problem.rows:
        for i in row.J:
            counts[i] = counts[i] + jnp.where(row.D > 0, 1.0, 0.0)
    touching = problem.tree.touching
    found = jnp.zeros(len(touching) + 1, like.dtype)
    for contacts, slots in zip(problem.sets, problem.slots, strict=True):

        def count(k: Any, n: jax.Array, of: Any = contacts, slots: Any = slots) -> jax.Array:
            return n.at[jnp.asarray(of.links)[slots.found.pairs[k]]].add(1.0)

        found = slots.fold(count, found)
    for k, link in enumerate(touching):
        if link < len(counts):  # frames of flexible links have no dof
            counts[link] = counts[link] + found[k]
    return pack(counts, like)


def solution_at(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: LinkForces | None,
    iterations: int = ITERATIONS, dt: Any = None, t: Any = 0.0,
) -> ContactSolution:  # fmt: skip
    """Solve the contact problem at a state under applied forces.

    The values share one narrow phase. The derivatives of the acceleration are implicit. Those of
    the forces follow from it through the contacts in use.
    """
    given, rebuilt = split_tracers((model, f_ext, dt, t))
    names: list[tuple] = []  # of the rows, which are known after tracing

    def plain(changed: list, q: jax.Array, v: jax.Array, tau: jax.Array) -> SolutionArrays:
        model, f_ext, dt, t = rebuilt(changed)
        assembly = Assembly(model, q, v, dt, t)
        problem = assembly.problem(tau, f_ext).detect(gap=True)
        names[:] = geoms_of_rows(model, problem.sets), sources_of_rows(problem)
        found = solve(problem, iterations=iterations)
        contacts = rows_of_slots(problem, found, assembly.origin)
        return SolutionArrays.of(problem, contacts, *_with_report(found))

    def in_use(changed: list, q: jax.Array, v: jax.Array, tau: jax.Array) -> RowsInUse:
        model, f_ext, dt, t = rebuilt(changed)
        return Assembly(model, q, v, dt, t).problem(tau, f_ext).detect(gap=True).in_use

    def differentiable(changed: list, q: jax.Array, v: jax.Array, tau: jax.Array) -> SolutionArrays:
        used = in_use(*jax.lax.stop_gradient((changed, q, v, tau)))
        model, f_ext, dt, t = rebuilt(changed)
        a, *report = contact_acceleration(model, q, v, tau, f_ext, iterations, dt, t)
        assembly = Assembly(model, q, v, dt, t)
        problem = assembly.problem(tau, f_ext)
        names[:] = geoms_of_rows(model, problem.sets), sources_of_rows(problem)
        contacts = rows_in_use(problem, used, a, assembly.origin)
        return SolutionArrays.of(problem, contacts, a, *report)

    found = with_rule_of(plain, differentiable)(given, q, v, tau)
    return found.solution(*names, tolerance_of(q.dtype))


@dataclass(frozen=True)
class SoftContact:
    """MuJoCo's law of contact, limits, friction loss and equalities, as a `Dynamics`.

    The acceleration minimises Gauss' principle with soft constraints. Results equal those of MuJoCo
    with Newton's method at tolerance 0. The least time constant of a row is two steps. The
    constraints of the model must be soft (`rbjax.constraints.Soft`), as `rb.load(contacts=True)`
    makes the equalities of a file.

    Derivatives are exact within a phase of contact. Through an impact they are biased at any step
    size, because the damping of a contact acts in full from the first step in touch: a bounce with
    restitution e and damping c per mass has dz/dh = -e - c e (T - t_touch - t_c - c/k) in place of
    -e. Use `contact="impulse"` or `CompliantContact` for derivatives through impacts, or an
    impedance that begins near zero (solimp="0.0001 0.95 0.02 0.5 2"), whose bias vanishes with the
    step. `rollout`, `simulate` and `step` warn of biased derivatives.

    Args:
        iterations: the largest number of Newton steps. A step that ends at this number returns the
            best acceleration that was found; `State.report`, `Trajectory.report` and
            `rb.contact.solve` report its error.
        dt: s, the step; None for the step of `step` and `rollout`, and elsewhere for the model's
            timestep.

    Raises:
        InputError: numbers outside their ranges.

    Source: Todorov, *Convex and analytically-invertible dynamics with contacts and constraints*,
    2014; MuJoCo, *Computation*.

    Example:
        >>> import rbjax as rb
        >>> rb.contact.SoftContact(iterations=5).iterations
        5
    """

    iterations: int = ITERATIONS
    dt: Any = None

    def __post_init__(self) -> None:
        check_iterations("SoftContact", self.iterations)
        if self.dt is not None:
            real_number("SoftContact", "dt", self.dt, above=0.0, traced=True)

    def __call__(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces
    ) -> jax.Array:
        """Compute the acceleration (nv,)."""
        return self._accelerated(slice(1), model, t, state, tau, f_ext)[0]

    def acceleration_and_error(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces
    ) -> tuple[jax.Array, jax.Array]:
        """Compute the acceleration (nv,) and the error of the solver, which has no derivative."""
        a, error = self._accelerated(slice(0, 3, 2), model, t, state, tau, f_ext)
        return a, error

    def damped_acceleration(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces,
        damping: Entries,
    ) -> tuple[jax.Array, jax.Array]:  # fmt: skip
        """Compute (M + A)^-1 M a (nv,) of the acceleration a, and the error of the solver.

        damping: entries of the diagonal matrix A.
        """
        of = functools.partial(damped_acceleration, damping=damping)
        a, error = self._accelerated(slice(0, 3, 2), model, t, state, tau, f_ext, of=of)
        return a, error

    def solver_tolerance(self, dtype: Any) -> float:
        """Return the largest error of a converged step, in a dtype: ten times the error at which
        the iteration ends, since rounding may leave more."""
        return 10 * tolerance_of(dtype)

    def _accelerated(
        self, which: slice, *given: Any, of: Callable = contact_acceleration
    ) -> list[jax.Array]:
        """Compute the results of a function `of` that the slice `which` selects."""
        model, q, v, tau, *rest = self._arguments(*given)

        def solved(q: jax.Array, v: jax.Array, tau: jax.Array) -> list[jax.Array]:
            return list(of(model, q, v, tau, *rest)[which])

        return threads(solved)(q, v, tau)

    def step_map(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces, dt: Any,
        added: Entries,
    ) -> list[jax.Array]:  # fmt: skip
        """Compute (v+ - v) / h (nv,) of the `discrete` integrator, the error of the solver, and the
        number of rows that act on each link (nv,).

        tau: generalized forces with -h K v. added: h D + h^2 K by entry.
        """
        *_, t = self._arguments(model, t, state, tau, f_ext)

        def solved(q: jax.Array, v: jax.Array, tau: jax.Array) -> list[jax.Array]:
            given = model, q, v, tau, f_ext, self.iterations, dt, t, added
            a, _, *others = contact_acceleration(*given)
            return [a, *others]

        return threads(solved)(state.q, state.v, tau)

    def solve(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces | None,
        dt: Any = None,
    ) -> ContactSolution:  # fmt: skip
        """Compute the acceleration with all forces, and the report of the solver.

        dt: step in s, if the law has none of its own; None for the model's timestep.
        """
        *_, own, t = self._arguments(model, t, state, tau, f_ext)
        dt = dt if own is None else own
        return solution_at(model, state.q, state.v, tau, f_ext, self.iterations, dt, t)

    def _arguments(self, model: Model, t: Any, state: State, tau: Any, f_ext: Any) -> tuple:
        t = t if model.constraints else 0.0  # only constraints depend on time
        return model, state.q, state.v, tau, f_ext, self.iterations, self.dt, t

    def check(self, where: str, model: Model, name: str = "mujoco") -> None:
        """Raise InputError if a model lacks the parameters of contact. name: the law, for the
        message."""
        if model.solver is None or model.geoms is None:
            raise InputError(
                f"{where}: contact={name!r} needs the contact parameters of a file, and the model "
                "has none; load it by rb.load, or build it by rb.ModelBuilder"
            )
        check_soft(where, model)
