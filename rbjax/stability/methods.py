"""Conversion of the `solver` arguments of this package: a name, a solver or a tableau."""

from __future__ import annotations

from typing import Any

import diffrax
import equinox as eqx
import numpy as np

from rbjax import solvers
from rbjax.errors import InputError, UnknownName
from rbjax.solvers import Tableau
from rbjax.solvers.root_finding import very_chord

Solver = diffrax.AbstractSolver | str | Tableau


def solver_of(solver: Any) -> Any:
    """Return the solver of a name in `rb.solvers.all()` or of a tableau, or a given solver itself.

    Raises:
        UnknownName: an unknown name.
        InputError: a class instead of an instance, or an object that is not a solver.

    >>> solver_of("rk4")
    RK4()
    """
    if isinstance(solver, str):
        known = solvers.all()
        if solver not in known:
            raise UnknownName("solver", solver, known)
        return known[solver].make()
    if isinstance(solver, Tableau):
        explicit = not np.triu(solver.a).any()
        return solvers.MuntheKaas(solver) if explicit else solvers.ImplicitRungeKutta(solver)
    if isinstance(solver, diffrax.AbstractSolver):
        return solver
    expected = "a name of rb.solvers.all(), a solver of rbjax or diffrax, or an rb.solvers.Tableau"
    if isinstance(solver, type) and issubclass(solver, diffrax.AbstractSolver):
        name = solver.__name__
        raise InputError(f"solver: got the class {name}, call it: {name}(); expected {expected}")
    got = type(solver).__name__
    raise InputError(f"solver: got {got}, which does not step; expected {expected}")


def fixed_step_solver(solver: Any) -> Any:
    """Return a solver for equal steps, with a root finder that needs no tolerances of a controller.
    Diagonally implicit methods of diffrax have a root finder that needs them; it is replaced."""
    solver = solver_of(solver)
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        return solver
    own = isinstance(getattr(solver.root_finder, "rtol", 0.0), (int, float))
    return solver if own else eqx.tree_at(lambda s: s.root_finder, solver, very_chord())
