"""BDF for constrained motion as differential-algebraic equations: a diffrax solver of `simulate`.

    f(t1, u1, Q'(t1), w) = 0,      Q through u1 and the past increments u_k, q_k = q0 (+) u_k
The increments are those from the state at the start of the step, whose chart moves along with the
motion. Radau IIA of three stages starts it (of one, BDF 1), and again after a jump.
(Hairer & Wanner, *Solving Ordinary Differential Equations II*, VII.3: orders 1 to 6 keep their
order for index 2; Lotstedt & Petzold, *Mathematics of Computation* 46, 1986, for index 3.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.constraints.methods.differential_algebraic import DifferentialAlgebraic
from rbjax.model import State
from rbjax.motion.implicit import begun, error_of, increment, seen, stages
from rbjax.solvers import radau_iia
from rbjax.solvers.constrained.differential_algebraic import solve
from rbjax.solvers.constrained.simplified import weight
from rbjax.solvers.groups import unwrap
from rbjax.solvers.multistep import basis, slopes_at_one
from rbjax.solvers.root_finding import mark_failed, step_result
from rbjax.solvers.steps import AbstractGroupSolver, weighted_sums


class History(NamedTuple):
    """The states before the current one, latest first, and how many have been filled."""

    ts: jax.Array  # (n,)
    states: State  # a leading axis n
    filled: jax.Array


class Step(NamedTuple):
    u: jax.Array  # (2 nv + nx,)
    error: jax.Array
    coefficients: jax.Array  # (degree, 2 nv + nx) of the dense output
    ok: jax.Array


class BDFSolver(AbstractGroupSolver, diffrax.AbstractAdaptiveSolver):
    """BDF of an order from 1 to 6 for formulations of index 2 and 3."""

    formulation: DifferentialAlgebraic = eqx.field(static=True)
    formula_order: int = eqx.field(static=True)

    def order(self, terms):
        return self.formula_order

    def error_order(self, terms):
        return self.formula_order + 1

    def init(self, terms, t0, t1, y0, args):
        n = self.formula_order  # one more than the formula needs, for the extrapolation
        # distinct times, so that the formula stays finite where it is not used yet
        ts = t0 - (t1 - t0) * jnp.arange(1, n + 1, dtype=t0.dtype)
        same = jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *x.shape)), y0)
        return History(ts, same, jnp.array(0))

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
        beside = term.group.retract(y1, increment(model, out.error))
        error = mark_failed(out.ok, jax.tree.map(jnp.subtract, beside, y1))
        ts = jnp.concatenate([t0[None], ts[:-1]])
        states = jax.tree.map(lambda x, past: jnp.concatenate([x[None], past[:-1]]), y0, states)
        after = History(ts, states, jnp.minimum(filled + 1, self.formula_order))
        coefficients = increment(model, out.coefficients)
        dense = {"y0": y0, "coefficients": coefficients, "group": term.group}
        return y1, error, dense, after, step_result(out.ok)

    @property
    def _degree(self) -> int:
        return max(self.formula_order, 3)

    def _padded(self, coefficients: jax.Array) -> jax.Array:
        return jnp.pad(coefficients, ((0, self._degree - len(coefficients)), (0, 0)))

    def _begin(self, term: Any, args: Any, t0: Any, h: Any, y0: State) -> Step:
        (model, forces, start), dynamics = seen(term.vector_field, args), self.formulation
        tableau = radau_iia(1 if self.formula_order == 1 else 3).tableau
        found = stages(dynamics, tableau, model, forces, start + t0, y0, h)
        return Step(
            weighted_sums(tableau.b, found.k),
            error_of(found, dynamics, tableau, model, forces, y0, h),
            self._padded(found.polynomial(tableau, h)),
            found.ok,
        )

    def _formula(
        self, term: Any, args: Any, t0: Any, h: Any, y0: State, ts: Any, states: State
    ) -> Step:
        (model, forces, first), dynamics = seen(term.vector_field, args), self.formulation
        equations, start = begun(dynamics, model, forces, first + t0, y0)
        past = jax.vmap(lambda y: term.group.difference(y0, y))(states)
        past = jnp.concatenate([past.q, past.v, *([] if past.x is None else [past.x])], -1)
        nodes = jnp.concatenate([jnp.array([1.0, 0.0], ts.dtype), (ts - t0) / h])
        weights = basis(nodes[1:])  # of y0, whose increment is zero, and the past
        predicted = weighted_sums(weights[1:].sum(1), past)  # the polynomials at 1
        nodes, past = nodes[:-1], past[:-1]
        slopes = slopes_at_one(nodes).astype(past.dtype)
        known = weighted_sums(slopes[2:], past)
        # h Q'(t1) = slopes_0 u1 + known
        one = weight(1 / slopes[0])
        base = start.y - known / slopes[0]
        found = solve(equations, h, (first + t0 + h)[None], base[None], one, start)
        u = (h * found.rates[0] - known) / slopes[0]
        rows = jnp.delete(basis(nodes), 1, axis=0)[:, 1:]
        share = (1 / (1 - (ts[-1] - t0) / h)).astype(u.dtype)
        coefficients = weighted_sums(rows.T, jnp.concatenate([u[None], past]))
        return Step(u, share * (u - predicted), self._padded(coefficients), found.ok)
