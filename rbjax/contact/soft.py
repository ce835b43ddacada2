"""Soft contact: the constraint model of MuJoCo as a dynamics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from rbjax.compiler import threads
from rbjax.contact.assemble import Assembly
from rbjax.contact.contact_forces import (
    ContactForces,
    geoms_of_rows,
    rows_of_candidates,
    rows_of_slots,
)
from rbjax.contact.newton import ITERATIONS, Solution, factorize_at, solve
from rbjax.contact.problem import Problem
from rbjax.contact.rows.equality_rows import check_soft
from rbjax.contact.solution import ContactSolution, SolutionArrays, sources_of_rows
from rbjax.dynamics.algorithms.rnea import LinkForces
from rbjax.dynamics.tracing.custom_rules import (
    jax_arrays,
    jvp_of,
    split_tracers,
    with_implicit_jvp,
    with_jvp,
)
from rbjax.errors import InputError
from rbjax.lanes import batch_first, pack
from rbjax.model import Model, State


def detected(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: LinkForces | None,
    dt: Any = None, t: Any = 0.0,
) -> Problem:  # fmt: skip
    """Return the contact problem of a model, with its active contacts. `dt` is the step, or None
    for the model's timestep."""
    problem = Assembly(model, q, v, dt, t).problem(tau, f_ext)
    return problem.detect()


def contact_acceleration(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: LinkForces | None,
    iterations: int = ITERATIONS, dt: Any = None, t: Any = 0.0,
) -> tuple[jax.Array, jax.Array, jax.Array]:  # fmt: skip
    """Compute the acceleration (nv,) with contacts, limits, friction loss and equalities. Return
    with it the number of Newton steps, as a real number, and the error of the solution.

    The derivative is implicit: da = H^-1 d(tau + J^T f - M a - b), with H and f at the solution.
    The features of geoms that touch are held constant.
    """
    given, rebuilt = split_tracers((model, f_ext, dt, t))

    def solved_at(changed, q, v, tau) -> tuple[Problem, Solution]:
        model, f_ext, dt, t = rebuilt(changed)
        problem = detected(model, q, v, tau, f_ext, dt, t)
        return problem, solve(problem, iterations=iterations)

    def plain(*at):
        return batch_first(_with_report(solved_at(*at)[1]), at)

    def solved(*at):
        problem, found = solved_at(*at)
        factors = factorize_at(problem, found)
        # a derivative that saves these values does not solve the problem again
        values = tuple(checkpoint_name(x, "acceleration") for x in _with_report(found))
        return values, [factors.solve], problem.in_use

    def residual(changed, q, v, tau, a, used):
        model, f_ext, dt, t = rebuilt(changed)
        assembly = Assembly(model, q, v, dt, t)
        problem, d = assembly.problem(tau, f_ext), assembly.d
        pushes = pack(problem.constraint_forces(a, used), tau)
        return tau + pushes - d.pack(assembly.inverse_dynamics(a, f_ext), tau)

    return with_implicit_jvp(plain, solved, residual)(*jax_arrays(given, q, v, tau))


def _with_report(found: Solution) -> tuple[jax.Array, jax.Array, jax.Array]:
    return found.x, found.iterations.astype(found.x.dtype), found.error


def solution_at(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: LinkForces | None,
    iterations: int = ITERATIONS, dt: Any = None, t: Any = 0.0,
) -> ContactSolution:  # fmt: skip
    """Solve the contact problem at a state under applied forces.

    The values share one narrow phase. The derivatives of the acceleration are implicit. Those of
    the forces follow from it through all candidates.
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

    def differentiable(changed: list, q: jax.Array, v: jax.Array, tau: jax.Array) -> SolutionArrays:
        model, f_ext, dt, t = rebuilt(changed)
        a, *report = contact_acceleration(model, q, v, tau, f_ext, iterations, dt, t)
        assembly = Assembly(model, q, v, dt, t)
        problem = assembly.problem(tau, f_ext)
        names[:] = geoms_of_rows(model, problem.sets), sources_of_rows(problem)
        contacts = rows_of_candidates(problem, a, assembly.origin)
        return SolutionArrays.of(problem, contacts, a, *report)

    def rule(primals: tuple, tangents: tuple) -> tuple:
        value, rate = jvp_of(differentiable, primals, tangents)
        return value, jax.tree.map(jnp.zeros_like, value) if rate is None else rate

    found = with_jvp(plain, rule)(given, q, v, tau)
    return found.solution(*names)


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
    step.

    Args:
        iterations: the largest number of Newton steps. A step that ends at this number returns the
            best acceleration that was found; `rb.contact.solve` reports its error.
        dt: s, the step; None for the step of `step` and `rollout`, and elsewhere for the model's
            timestep.

    Source: Todorov, *Convex and analytically-invertible dynamics with contacts and constraints*,
    2014; MuJoCo, *Computation*.

    Example:
        >>> import rbjax as rb
        >>> rb.contact.SoftContact(iterations=5).iterations
        5
    """

    iterations: int = ITERATIONS
    dt: Any = None

    def __call__(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces
    ) -> jax.Array:
        """Compute the acceleration (nv,)."""
        _, q, v, tau, *rest = self._arguments(model, t, state, tau, f_ext)

        def solved(q: jax.Array, v: jax.Array, tau: jax.Array) -> jax.Array:
            return contact_acceleration(model, q, v, tau, *rest)[0]

        return threads(solved)(q, v, tau)

    def solve(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces | None
    ) -> ContactSolution:
        """Compute the acceleration with all forces, and the report of the solver."""
        return solution_at(*self._arguments(model, t, state, tau, f_ext))

    def _arguments(self, model: Model, t: Any, state: State, tau: Any, f_ext: Any) -> tuple:
        t = t if model.constraints else 0.0  # only constraints depend on time
        return model, state.q, state.v, tau, f_ext, self.iterations, self.dt, t

    def contact_forces(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces
    ) -> ContactForces:
        """Compute the forces of all candidate contacts."""
        return self.solve(model, t, state, tau, f_ext).contacts

    def check(self, where: str, model: Model, name: str = "mujoco") -> None:
        """Raise InputError if the law of a name has no parameters for a model."""
        if model.solver is None or model.geoms is None:
            raise InputError(
                f"{where}: contact={name!r} needs the contact parameters of a file, and the model "
                "has none; load it by rb.load, or build it by rb.ModelBuilder"
            )
        check_soft(where, model)
