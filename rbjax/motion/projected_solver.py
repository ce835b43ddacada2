"""A diffrax solver whose states a formulation of constraints projects after each step."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax

from rbjax.constraints.formulation import Formulation, differential_algebraic_method
from rbjax.errors import InputError
from rbjax.model import Model, State
from rbjax.motion.field import Dynamics, moves_stages
from rbjax.motion.implicit import StagesSolver, stepped_by
from rbjax.motion.implicit_multistep import BDFSolver
from rbjax.motion.term import VectorField
from rbjax.solvers import BDF
from rbjax.solvers.compensated import Wrapped


class ProjectedSolver(Wrapped):
    """A solver with the projections of a formulation: `stage_state` at the stages and at the end of
    each step, `project` after it.

    The estimate of the error is that of the step before it. A solver that keeps the slope at the
    end of a step for the next one keeps that of the state before it was projected, which differs by
    less than the error of the step.
    """

    formulation: Formulation = eqx.field(static=True)
    model: Callable[[Any], Model]
    start: Any

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        model, begun = self.model(args), (self.start + t0, y0)
        stages = moves_stages(self.formulation)
        y1, error, dense, solver_state, result = self.solver.step(
            _of_step(terms, begun) if stages else terms, t0, t1, y0, args, solver_state, made_jump
        )
        t = self.start + t1
        if stages:
            y1 = self.formulation.stage_state(model, t, y1, *begun)
        y1 = self.formulation.project(model, t, y1)
        return y1, error, dense | ({"y1": y1} if "y1" in dense else {}), solver_state, result


def solver_of(given: diffrax.AbstractSolver | None, dynamics: Dynamics) -> diffrax.AbstractSolver:
    """The solver of a dynamics: the caller's, the implicit solver of the equations of a formulation
    of index 2 or 3, or the default."""
    if given is not None:
        _check_solver("simulate", given)
    formulation = differential_algebraic_method(dynamics)
    if formulation is not None:
        if isinstance(given, BDF):
            return BDFSolver(formulation, given.formula_order)
        tableau = stepped_by("simulate", formulation, given, ", bdf1 to bdf6")
        return StagesSolver(formulation, tableau)
    return diffrax.Tsit5() if given is None else given


def _of_step(terms: Any, begun: tuple[Any, State]) -> Any:
    """The terms, with the time and state at which their step began."""

    def of(x: Any) -> Any:
        return dataclasses.replace(x, begun=begun) if is_field(x) else x

    def is_field(x: Any) -> bool:
        return isinstance(x, VectorField)

    return jax.tree.map(of, terms, is_leaf=is_field)


def project_after_steps(
    solver: diffrax.AbstractSolver, dynamics: Dynamics, model: Callable[[Any], Model], start: Any
) -> diffrax.AbstractSolver:
    """The solver, with the projection of the dynamics after each step if it has one."""
    if not isinstance(dynamics, Formulation) or dynamics.projection is None:
        return solver
    return ProjectedSolver(solver, dynamics, model, start)


def _check_solver(function: str, solver: Any) -> None:
    """`InputError` unless solver is an instance of a diffrax solver."""
    if isinstance(solver, diffrax.AbstractSolver):
        return
    got, fix = repr(solver), ""
    if isinstance(solver, str):
        fix = f": rb.solvers.all()[{solver!r}].make()"
    elif hasattr(solver, "make"):
        fix = ": the entry's make()"
    elif hasattr(solver, "__name__"):
        got = f"the {'class' if isinstance(solver, type) else 'function'} {solver.__name__}"
        fix = f": {solver.__name__}()"
    raise InputError(f"{function}: solver is {got}, expected a solver of diffrax{fix}")
