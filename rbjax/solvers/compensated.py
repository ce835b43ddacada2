"""Compensated summation: the next step adds the rounding error of the last addition.

    d = z(h),  with z' = f(t, y0 + z), z(0) = e0
    y1 = y0 + d rounded,  e1 = y0 + d - y1 exactly

A step then has only the rounding errors of d and of h f, which are smaller than the rounding of y
by a factor h |df/dy|.

Source: Kahan 1965; Knuth, *The Art of Computer Programming* 2, 4.2.2; Hairer, Lubich & Wanner,
*Geometric Numerical Integration*, VIII.5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import diffrax
import jax
import jax.numpy as jnp

from rbjax.errors import InputError
from rbjax.solvers.groups import OnGroup, unwrap
from rbjax.solvers.multistep import Adams
from rbjax.solvers.rosenbrock import RosenbrockW
from rbjax.solvers.runge_kutta import ImplicitRungeKutta


class WrappedSolver(diffrax.AbstractWrappedSolver):
    """Base class of solvers that forward properties and methods to another solver."""

    solver: Any  # type: ignore[misc]

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # type: ignore[override]
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):
        return self.solver.term_compatible_contr_kwargs

    @property
    def scan_kind(self):  # diffrax sets scan_kind and root_finder on solvers that have them
        return self.solver.scan_kind

    @property
    def root_finder(self):
        return self.solver.root_finder

    def order(self, terms):
        return self.solver.order(terms)

    def strong_order(self, terms):
        return self.solver.strong_order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)


#: solvers that use the state only to evaluate rates
BY_RATES = (diffrax.AbstractRungeKutta, diffrax.Euler, ImplicitRungeKutta, RosenbrockW, Adams)


class Compensated(WrappedSolver, diffrax.AbstractAdaptiveSolver):
    """A solver that carries the rounding errors of its additions to the next step.

    Use it if rounding limits the accuracy: small steps, long chaotic motions, single precision.

    Fields:
        solver: an explicit or fully implicit Runge-Kutta solver (`diffrax.Dopri8`,
            `gauss_legendre`), or a Rosenbrock or Adams solver.

    Raises:
        InputError: the solver uses states in other ways than to evaluate rates (BDF), or the term
            is on a Lie group, where increments do not add.

    Source: Hairer, Lubich & Wanner, VIII.5.

    Example: ten thousand steps in single precision
        >>> import diffrax, jax.numpy as jnp, rbjax as rb
        >>> decay = diffrax.ODETerm(lambda t, y, args: -y)
        >>> one = jnp.float32(1)
        >>> for solver in (rb.solvers.RK4(), rb.solvers.Compensated(rb.solvers.RK4())):
        ...     y = diffrax.diffeqsolve(decay, solver, 0, one, 1e-4, one, max_steps=20_000).ys[0]
        ...     print(f"{abs(float(y) / 0.36787944117 - 1) < 1e-7}")
        False
        True
    """

    def __check_init__(self):
        if not isinstance(self.solver, BY_RATES):
            raise InputError(
                f"Compensated: {type(self.solver).__name__} does not use only rates, expected "
                f"a Runge-Kutta, Rosenbrock or Adams method"
            )

    @property
    def interpolation_cls(self):  # type: ignore[override]
        return _Interpolation(self.solver.interpolation_cls)

    def init(self, terms, t0, t1, y0, args):
        if isinstance(unwrap(terms), OnGroup):
            raise InputError(
                f"Compensated: the term moves its state on {type(unwrap(terms).group).__name__},"
                f" expected a vector field, whose increments add"
            )
        low = jax.tree.map(jnp.zeros_like, y0)
        return low, self.solver.init(_Increment(terms, y0), t0, t1, low, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        low, inner = solver_state
        d, error, dense, inner, result = self.solver.step(
            _Increment(terms, y0), t0, t1, low, args, inner, made_jump
        )
        y1 = jax.tree.map(jnp.add, y0, d)
        low = jax.tree.map(_rounding_error, y0, d, y1)
        return y1, error, {"y0": y0, "increment": dense}, (low, inner), result


def _rounding_error(y: jax.Array, d: jax.Array, total: jax.Array) -> jax.Array:
    """Return y + d - total without error, with total the rounded sum of any y and d (Knuth)."""
    added = total - y
    return (y - (total - added)) + (d - added)


class _Increment(diffrax.AbstractTerm):
    """The diffrax term of the increment z of y = y0 + z, with the same rate as y."""

    term: diffrax.AbstractTerm
    y0: Any

    def vf(self, t, y, args):
        return self.term.vf(t, jax.tree.map(jnp.add, self.y0, y), args)

    def contr(self, t0, t1, **kwargs):
        return self.term.contr(t0, t1, **kwargs)

    def prod(self, vf, control):
        return self.term.prod(vf, control)


class _Shifted(diffrax.AbstractLocalInterpolation):
    """The dense output y0 + z(t), from the dense output of the increment z."""

    t0: Any  # type: ignore[misc]
    t1: Any  # type: ignore[misc]
    y0: Any
    increment: diffrax.AbstractLocalInterpolation

    def evaluate(self, t0, t1=None, left=True):
        z = self.increment.evaluate(t0, t1, left)
        return jax.tree.map(jnp.add, self.y0, z) if t1 is None else z


@dataclass(frozen=True)
class _Interpolation:
    """Constructor of the dense output `_Shifted` from the arguments of the increment's dense
    output."""

    inner: Callable[..., diffrax.AbstractLocalInterpolation]

    def __call__(self, *, t0: Any, t1: Any, y0: Any, increment: dict) -> _Shifted:
        return _Shifted(t0, t1, y0, self.inner(t0=t0, t1=t1, **increment))
