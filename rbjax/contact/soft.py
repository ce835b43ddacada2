"""Soft contact: the constraint model of MuJoCo as a dynamics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.contact.assemble import Assembly
from rbjax.contact.contact_forces import ContactForces, contact_forces
from rbjax.contact.newton import ITERATIONS, Solution, factorize_at, solve
from rbjax.contact.problem import Problem
from rbjax.dynamics.algorithms.rnea import LinkForces
from rbjax.dynamics.tracing.custom_rules import jax_arrays, split_tracers, with_implicit_jvp
from rbjax.errors import InputError
from rbjax.lanes import batch_first
from rbjax.model import Model, State


def detected(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: LinkForces | None
) -> Problem:
    """Return the contact problem of a model, with its active contacts."""
    problem = Assembly(model, q, v).problem(tau, f_ext)
    problem.detect()
    return problem


def contact_acceleration(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: LinkForces | None,
    iterations: int = ITERATIONS,
) -> jax.Array:  # fmt: skip
    """Compute the acceleration (nv,) with contacts, limits and friction loss.

    The derivative is implicit: da = H^-1 d(tau + J^T f - M a - b), with H and f at the solution.
    The features of geoms that touch are held constant.
    """
    given, rebuilt = split_tracers((model, f_ext))

    def solved_at(changed, q, v, tau) -> tuple[Problem, Solution]:
        model, f_ext = rebuilt(changed)
        problem = detected(model, q, v, tau, f_ext)
        return problem, solve(problem, iterations=iterations)

    def plain(*at):
        return batch_first((solved_at(*at)[1].x,), at)

    def solved(*at):
        problem, found = solved_at(*at)
        factors = factorize_at(problem, found.x)

        def change(b):
            return jnp.stack([jnp.asarray(y, b.dtype) for y in factors.solve(list(b))])

        return (found.x,), [change]

    def residual(changed, q, v, tau, a):
        model, f_ext = rebuilt(changed)
        assembly = Assembly(model, q, v)
        problem, d = assembly.problem(tau, f_ext), assembly.d
        pushes = d.pack(problem.constraint_forces(d.lanes(a)), tau)
        return tau + pushes - d.pack(assembly.inverse_dynamics(a, f_ext), tau)

    return with_implicit_jvp(plain, solved, residual)(*jax_arrays(given, q, v, tau))[0]


@dataclass(frozen=True)
class SoftContact:
    """MuJoCo's law of contact, limits and friction loss, as a `Dynamics`.

    The acceleration minimises Gauss' principle with soft constraints. Results equal those of MuJoCo
    with Newton's method at tolerance 0. The least time constant of a contact is two of
    `model.timestep`.

    Args:
        iterations: the largest number of Newton steps. A step that ends at this number returns the
            best acceleration that was found; `rb.contact.solve` reports its error.

    Source: Todorov, *Convex and analytically-invertible dynamics with contacts and constraints*,
    2014; MuJoCo, *Computation*.

    Example:
        >>> import rbjax as rb
        >>> rb.contact.SoftContact(iterations=5).iterations
        5
    """

    iterations: int = ITERATIONS

    def __call__(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces
    ) -> jax.Array:
        """Compute the acceleration (nv,)."""
        return contact_acceleration(model, state.q, state.v, tau, f_ext, self.iterations)

    def contact_forces(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces
    ) -> ContactForces:
        """Compute the forces of all candidate contacts."""
        a = self(model, t, state, tau, f_ext)
        return contact_forces(model, state.q, state.v, tau, f_ext, a)

    def check(self, where: str, model: Model, name: str = "mujoco") -> None:
        """Raise InputError if the law of a name has no parameters for a model."""
        if model.solver is None or model.geoms is None:
            raise InputError(
                f"{where}: contact={name!r} needs the contact parameters of a file, and the model "
                "has none; load it by rb.load, or build it by rb.ModelBuilder"
            )
        if model.constraints:
            raise InputError(
                f"{where}: contact={name!r} and the constraints of the model "
                f"({len(model.constraints)}) are not solved together; load(constraints=False), or "
                "model.replace(constraints=())"
            )
