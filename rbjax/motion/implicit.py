"""Implicit steps of constrained motion as a differential-algebraic equation (DAE).

The unknowns of a step are u', v', x' and the multipliers of its stages, with increments u of the
configuration, q = q0 (+) u, relative to the state at the start of the step. `rollout` uses
`ByStages`, which has no memory between steps. `simulate` uses the diffrax solvers `StagesSolver`
(Runge-Kutta) and `BDFSolver`:

    f(t1, u1, Q'(t1), w) = 0,      Q through u1 and the past increments u_k, q_k = q0 (+) u_k
Radau IIA with three stages (one stage for BDF 1) starts BDF, and restarts it after a jump.
`rbjax.constraints.methods.differential_algebraic` has the equations, `rbjax.solvers` the methods.

Source: Hairer & Wanner, *Solving Ordinary Differential Equations II*, VII.3 (BDF of orders 1 to 6
keeps its order for index 2); Lotstedt & Petzold, *Math. Comp.* 46, 1986 (index 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints.equations.constrained_motion import constrained_motion
from rbjax.constraints.methods.differential_algebraic import DifferentialAlgebraic, Forces
from rbjax.errors import InputError
from rbjax.forces.inputs import Inputs, evaluated
from rbjax.model import Model, State
from rbjax.motion.field import Field
from rbjax.solvers import all as solvers
from rbjax.solvers import radau_iia
from rbjax.solvers.constrained.differential_algebraic import DAE, StepStart, damp_error, solve
from rbjax.solvers.constrained.simplified import weight, weights
from rbjax.solvers.groups import unwrap
from rbjax.solvers.multistep import BackwardDifference
from rbjax.solvers.root_finding import mark_failed, step_result
from rbjax.solvers.runge_kutta import ImplicitRungeKutta
from rbjax.solvers.steps import AbstractGroupSolver, weighted_sums
from rbjax.solvers.tableau import Tableau

#: names in rbjax.solvers.all() of the methods that support these formulations
FITTING = (
    "radau_iia2", "radau_iia3", "gauss_legendre2", "gauss_legendre3", "implicit_midpoint",
    "lobatto_iiic2", "lobatto_iiic3",
)  # fmt: skip


class ImplicitStages(NamedTuple):
    """The stages of an implicit Runge-Kutta step.

    k: (s, 2 nv + nx) rates of the stages, times h.
    w: (s, rows) multipliers of the stages.
    ok: whether the iteration converged.
    start: initial point.
    """

    k: jax.Array
    w: jax.Array
    ok: jax.Array
    start: StepStart

    def polynomial(self, tableau: Tableau, h: Any) -> jax.Array:
        """Return the coefficients of theta, theta^2, ... of the dense output of the increment."""
        if tableau.dense:
            return weighted_sums(tuple(zip(*tableau.dense, strict=True)), self.k)
        first = h * self.start.rate
        return jnp.stack([first, weighted_sums(tableau.b, self.k) - first])


def stages(
    dynamics: DifferentialAlgebraic,
    tableau: Tableau,
    model: Model,
    forces: Forces,
    t: Any,
    state: State,
    h: Any,
) -> ImplicitStages:
    """Solve the equations of the stages of a Runge-Kutta step."""
    dtype = state.q.dtype
    equations, start = initial_equations(dynamics, model, forces, t, state)
    c = jnp.asarray(tableau.c, jnp.result_type(h))
    base = jnp.broadcast_to(start.y, (tableau.stages, start.y.size))
    found = solve(equations, h, t + c * h, base, weights(np.array(tableau.a), dtype), start)
    return ImplicitStages(h * found.rates, found.w, found.ok, start)


def error_of(
    found: ImplicitStages,
    dynamics: DifferentialAlgebraic,
    tableau: Tableau,
    model: Model,
    forces: Forces,
    state: State,
    h: Any,
) -> jax.Array:
    """Compute the damped error estimate of a step by the embedded weights of the tableau."""
    dynamics, start = dynamics.damping, found.start
    at_start, *others = tableau.error
    raw = weighted_sums(others, found.k) + at_start * h * start.rate
    equations = equations_of(dynamics, model, forces, start.t, state)
    w = _padded(start.w, len(equations.depth))
    return damp_error(equations, tableau.filter * h, start._replace(w=w), raw)


def _padded(w: jax.Array, size: int) -> jax.Array:
    """Pad multipliers with zeros to a size."""
    return jnp.concatenate([w, jnp.zeros(size - len(w), w.dtype)])


def initial_equations(
    dynamics: DifferentialAlgebraic, model: Model, forces: Forces, t: Any, state: State
) -> tuple[DAE, StepStart]:
    """Return the DAE relative to a state, and its initial rates and multipliers by the index-1
    formulation."""
    tau, f_ext, dx = forces(t, state)
    a, l = constrained_motion(model, t, state, tau, f_ext)
    equations = equations_of(dynamics, model, forces, t, state)
    w = _padded(l, len(equations.depth))
    still = jnp.zeros_like(state.v)
    y = jnp.concatenate([still, state.v, *([] if state.x is None else [state.x])])
    rate = jnp.concatenate([state.v, a, *([] if dx is None else [dx])])
    return equations, StepStart(t, y, rate, w)


def equations_of(
    dynamics: DifferentialAlgebraic, model: Model, forces: Forces, t: Any, state: State
) -> DAE:
    """Return the DAE in increments relative to a state."""
    f = dynamics.equations(model, state.q, forces)
    depth, usual, again = dynamics.algebraic(model, t, state)
    return DAE(f, depth, usual, model.nv, again)


def increment(model: Model, u: jax.Array) -> State:
    """Split (..., 2 nv + nx) into the tangent vectors of q, v and x."""
    q, v, x = jnp.split(u, (model.nv, 2 * model.nv), -1)
    return State(q, v, x if model.nx else None)


@dataclass(frozen=True)
class ByStages:
    """Implicit Runge-Kutta integrator of `rollout` for formulations of index 2 and 3. A step that
    does not converge is nan, and `Trajectory.success` is False."""

    formulation: DifferentialAlgebraic
    tableau: Tableau

    def __call__(self, field: Field, t: Any, state: State, u: Inputs, dt: Any) -> State:
        def forces(t: Any, state: State) -> tuple:
            return field.applied(t, state, u)

        model = field.precomputed
        found = stages(self.formulation, self.tableau, model, forces, t, state, dt)
        du = increment(model, weighted_sums(self.tableau.b, found.k))
        x = None if state.x is None or du.x is None else state.x + du.x
        after = State(field.retract(state.q, du.q), state.v + du.v, x)
        return jax.tree.map(lambda x: jnp.where(found.ok, x, jnp.nan), after)


class StagesSolver(AbstractGroupSolver, diffrax.AbstractAdaptiveSolver):
    """Diffrax solver for formulations of index 2 and 3 by an implicit Runge-Kutta tableau."""

    formulation: DifferentialAlgebraic = eqx.field(static=True)
    tableau: Tableau = eqx.field(static=True)

    def order(self, terms):
        return self.tableau.order

    def error_order(self, terms):
        return self.tableau.error_order or None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        term, h = unwrap(terms), t1 - t0
        h = jnp.where(h == 0, 1.0, h)
        (model, forces, start), dynamics = parts_of_field(term.vector_field, args), self.formulation
        found = stages(dynamics, self.tableau, model, forces, start + t0, y0, h)
        y1 = term.group.retract(y0, increment(model, weighted_sums(self.tableau.b, found.k)))
        error = None
        if self.tableau.error:
            off = error_of(found, dynamics, self.tableau, model, forces, y0, h)
            nearby = term.group.retract(y1, increment(model, off))
            error = mark_failed(found.ok, jax.tree.map(jnp.subtract, nearby, y1))
        coefficients = increment(model, found.polynomial(self.tableau, h))
        dense = {"y0": y0, "coefficients": coefficients, "group": term.group}
        return y1, error, dense, solver_state, step_result(found.ok)


def parts_of_field(vector_field: Any, args: Any) -> tuple[Model, Forces, Any]:
    """Return the model, the forces and the initial time of the vector field of `simulate`."""
    model = vector_field.model(args)

    def forces(t: Any, state: State) -> tuple:
        inputs = evaluated("simulate", model, vector_field.inputs, t, state)
        return Field(model).applied(t, state, inputs)

    return model, forces, vector_field.start


def tableau_of(where: str, dynamics: DifferentialAlgebraic, given: Any, also: str = "") -> Tableau:
    """Return the tableau of the implicit method for a formulation.

    given: a name, a solver, or None for the default.
    also: names of further methods that the caller accepts, for the error message.
    """
    if given is None:
        return radau_iia(3).tableau
    solver = solvers()[given].make() if isinstance(given, str) and given in FITTING else given
    if isinstance(solver, ImplicitRungeKutta) and np.linalg.cond(solver.tableau.a) < 1e8:
        return solver.tableau
    got = given if isinstance(given, str) else type(given).__name__
    raise InputError(
        f"{where}: constraints={dynamics.name!r} with {got}, expected an implicit method "
        f"whose stages are all implicit, of rb.solvers.all(): {', '.join(FITTING)}{also}; "
        "rb.solvers.radau_iia(1) (backward Euler); or None for radau_iia3. Other methods are for "
        "other formulations, as 'projected'"
    )


class StateHistory(NamedTuple):
    """Past states of BDF, latest first, and the number of valid ones."""

    ts: jax.Array  # (n,)
    states: State  # a leading axis n
    filled: jax.Array


class BDFStep(NamedTuple):
    u: jax.Array  # (2 nv + nx,)
    error: jax.Array
    coefficients: jax.Array  # (degree, 2 nv + nx) of the dense output
    ok: jax.Array


class BDFSolver(AbstractGroupSolver, diffrax.AbstractAdaptiveSolver):
    """Diffrax solver for formulations of index 2 and 3 by BDF of a fixed order from 1 to 6."""

    formulation: DifferentialAlgebraic = eqx.field(static=True)
    formula_order: int = eqx.field(static=True)

    def order(self, terms):
        return self.formula_order

    def error_order(self, terms):
        return self.formula_order + 1

    def init(self, terms, t0, t1, y0, args):
        n = self.formula_order  # one more than the formula needs, for the extrapolation
        # distinct times keep the formula finite before it is used
        ts = t0 - (t1 - t0) * jnp.arange(1, n + 1, dtype=t0.dtype)
        same = jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *x.shape)), y0)
        return StateHistory(ts, same, jnp.array(0))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        term, h = unwrap(terms), t1 - t0
        h = jnp.where(h == 0, 1.0, h)
        ts, states, filled = solver_state
        filled = jnp.where(made_jump, 0, filled)
        starting = filled < self.formula_order
        given = term, args, t0, h, y0
        out = jax.lax.cond(
            starting, lambda: self._begin(*given), lambda: self._formula(*given, ts, states)
        )
        model = term.vector_field.model(args)
        y1 = term.group.retract(y0, increment(model, out.u))
        nearby = term.group.retract(y1, increment(model, out.error))
        error = mark_failed(out.ok, jax.tree.map(jnp.subtract, nearby, y1))
        ts = jnp.concatenate([t0[None], ts[:-1]])
        states = jax.tree.map(lambda x, past: jnp.concatenate([x[None], past[:-1]]), y0, states)
        after = StateHistory(ts, states, jnp.minimum(filled + 1, self.formula_order))
        coefficients = increment(model, out.coefficients)
        dense = {"y0": y0, "coefficients": coefficients, "group": term.group}
        return y1, error, dense, after, step_result(out.ok)

    @property
    def _degree(self) -> int:
        return max(self.formula_order, 3)

    def _padded(self, coefficients: jax.Array) -> jax.Array:
        return jnp.pad(coefficients, ((0, self._degree - len(coefficients)), (0, 0)))

    def _begin(self, term: Any, args: Any, t0: Any, h: Any, y0: State) -> BDFStep:
        (model, forces, start), dynamics = parts_of_field(term.vector_field, args), self.formulation
        tableau = radau_iia(1 if self.formula_order == 1 else 3).tableau
        found = stages(dynamics, tableau, model, forces, start + t0, y0, h)
        return BDFStep(
            weighted_sums(tableau.b, found.k),
            error_of(found, dynamics, tableau, model, forces, y0, h),
            self._padded(found.polynomial(tableau, h)),
            found.ok,
        )

    def _formula(
        self, term: Any, args: Any, t0: Any, h: Any, y0: State, ts: Any, states: State
    ) -> BDFStep:
        (model, forces, first), dynamics = parts_of_field(term.vector_field, args), self.formulation
        equations, start = initial_equations(dynamics, model, forces, first + t0, y0)
        past = jax.vmap(lambda y: term.group.difference(y0, y))(states)
        past = jnp.concatenate([past.q, past.v, *([] if past.x is None else [past.x])], -1)
        q = BackwardDifference.of((ts - t0) / h, past)
        base = start.y - q.known / q.slope
        found = solve(equations, h, (first + t0 + h)[None], base[None], weight(1 / q.slope), start)
        u, error, coefficients = q.result(h * found.rates[0])
        return BDFStep(u, error, self._padded(coefficients), found.ok)
