"""Linear multistep methods of variable step: Adams-Bashforth, Adams-Moulton, PECE and BDF.

    Adams:  y1 = y0 + int_t0^t1 P(t) dt,     P through the rates at past times (and t1: Moulton)
    BDF:    Q'(t1) = f(t1, y1),              Q through y1 and the past values
The interpolation is through the times as they were (`lagrange`), so the step may vary from one
step to the next at every order; zero-stability wants a growth of at most 1 + sqrt(2) a step at
order 2 and less above (`diffrax.PIDController(factormax=...)`).

Start, and after each jump: a one-step method of sufficient order, classical RK4 for Adams, Radau
IIA of two or three stages for BDF. Error: the difference to the method of one order less (Adams),
or to the extrapolation of the past, scaled (BDF). Dense output: the polynomial itself.
(Hairer, Norsett & Wanner, *Solving ODEs I*, III.1, III.5.)
"""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx

from rbjax.solvers import tableau as tables
from rbjax.solvers.implicit_rk import ImplicitRungeKutta
from rbjax.solvers.lagrange import basis, integrals, slopes_at_one
from rbjax.solvers.newton import MAX_STEPS, chord, refused, root, verdict
from rbjax.solvers.steps import (
    AbstractPolynomialSolver,
    Field,
    combine,
    explicit_stages,
    field,
    hermite,
    mixed,
    scaled,
    select,
)


class History(NamedTuple):
    """What was before the current state, latest first, and how much of it has been filled."""

    ts: jax.Array  # (n,)
    values: Any  # leaves (n, ...): rates (Adams) or states (BDF)
    filled: jax.Array


class Step(NamedTuple):
    y1: Any
    error: Any
    coefficients: Any  # of the dense output
    ok: Any


class AbstractMultistep(AbstractPolynomialSolver, diffrax.AbstractAdaptiveSolver):
    """The start, the history, and the choice between a one-step method and the formula."""

    @property
    @abc.abstractmethod
    def degree(self) -> int:
        """Of the dense polynomial of any step."""

    @property
    @abc.abstractmethod
    def past(self) -> int:
        """Entries of the history that the formula needs."""

    @abc.abstractmethod
    def begin(self, f: Field, t0: Any, h: Any, y0: Any) -> Step:
        """A step without history."""

    @abc.abstractmethod
    def formula(self, f: Field, t0: Any, h: Any, y0: Any, now: Any, history: History) -> Step:
        """A step with it; `now` is what is remembered of the current state."""

    @abc.abstractmethod
    def remembered(self, f: Field, t0: Any, y0: Any) -> Any:
        """What the history keeps of the current state."""

    def init(self, terms, t0, t1, y0, args):
        # Distinct times, so that the formula stays finite where it is not used yet.
        ts = t0 - (t1 - t0) * jnp.arange(1, self.past + 1, dtype=t0.dtype)
        values = jax.tree.map(lambda x: jnp.broadcast_to(x, (self.past, *x.shape)), y0)
        return History(ts, values, jnp.array(0))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        f, h = field(terms, args), t1 - t0
        now = self.remembered(f, t0, y0)
        ts, values, filled = solver_state
        filled = jnp.where(made_jump, 0, filled)
        history = History(ts, values, filled)

        def formula():
            return self._padded(self.formula(f, t0, h, y0, now, history))

        if self.past:
            starting = filled < self.past

            def begin():
                first = self._padded(self.begin(f, t0, h, y0))
                return select(starting, first, formula())

            out = jax.lax.cond(eqxi.unvmap_any(starting), begin, formula)
        else:
            out = formula()
        dense = {"y0": y0, "coefficients": out.coefficients}
        if self.past:
            ts = jnp.concatenate([t0[None], ts[:-1]])
            values = jax.tree.map(
                lambda new, old: jnp.concatenate([new[None], old[:-1]]), now, values
            )
        state = History(ts, values, jnp.minimum(filled + 1, self.past))
        return out.y1, out.error, dense, state, verdict(out.ok)

    def _padded(self, step: Step) -> Step:
        """The same, with as many coefficients as any step of the method has."""

        def pad(c):
            return jnp.pad(c, [(0, self.degree - c.shape[0])] + [(0, 0)] * (c.ndim - 1))

        ok = jnp.asarray(step.ok)
        return Step(step.y1, step.error, jax.tree.map(pad, step.coefficients), ok)

    def _nodes(self, t0: Any, h: Any, history: History) -> jax.Array:
        """Past times in steps from t0: t0 is 0, t1 is 1."""
        return (history.ts - t0) / jnp.where(h == 0, 1.0, h)


class Adams(AbstractMultistep):
    """Adams methods of order 1 to 6.

    Fields: formula_order; corrector, "none" (Adams-Bashforth), "once" (PECE: predicted, evaluated,
    corrected, evaluated) or "root" (Adams-Moulton); root_finder, root_find_max_steps for the last.
    """

    formula_order: int = eqx.field(static=True)
    corrector: str = eqx.field(static=True, default="none")
    root_finder: optx.AbstractRootFinder = eqx.field(default_factory=chord)
    root_find_max_steps: int = MAX_STEPS

    @property
    def past(self) -> int:
        return max(self.formula_order - (1 if self.corrector == "none" else 2), 0)

    @property
    def degree(self) -> int:
        return max(self.formula_order, 3)

    def order(self, terms):
        return self.formula_order

    def remembered(self, f, t0, y0):
        return f(t0, y0)

    def begin(self, f, t0, h, y0):
        def rate(t, u):
            return f(t, combine((1.0, 1.0), (y0, u)))

        k = explicit_stages(rate, tables.RK4, t0, h)(jax.tree.map(jnp.zeros_like, y0))
        u, error = mixed(tables.RK4.b, k), mixed(tables.RK4.error[1:], k)
        first, last = (jax.tree.map(lambda x, i=i: x[i], k) for i in (0, -1))
        return Step(combine((1.0, 1.0), (y0, u)), error, hermite(u, first, last), True)

    def formula(self, f, t0, h, y0, now, history):
        nodes = jnp.concatenate([jnp.zeros(1, t0.dtype), self._nodes(t0, h, history)])
        rates = jax.tree.map(lambda x, old: jnp.concatenate([x[None], old]), now, history.values)

        def polynomial(nodes, rates):
            """Coefficients of the increment that interpolates h rates at nodes."""
            return mixed(integrals(nodes).T, scaled(h, rates))

        def ahead(nodes, rates):
            return jax.tree.map(lambda c: c.sum(0), polynomial(nodes, rates))

        coefficients = polynomial(nodes, rates)
        u = jax.tree.map(lambda c: c.sum(0), coefficients)
        if self.corrector == "none":
            y1 = combine((1.0, 1.0), (y0, u))
            if self.formula_order == 1:
                return Step(y1, None, coefficients, True)
            less = ahead(nodes[:-1], jax.tree.map(lambda x: x[:-1], rates))
            return Step(y1, combine((1.0, -1.0), (u, less)), coefficients, True)

        predicted, t1 = u, t0 + h
        nodes = jnp.concatenate([jnp.ones(1, t0.dtype), nodes])

        def corrected(k):
            """The polynomial with the increment k = h f(t1, y1) at its new end."""
            new = jax.tree.map(lambda k, x: jnp.concatenate([k[None], h * x]), k, rates)
            return mixed(integrals(nodes).T, new)

        def arrived(k):
            return jax.tree.map(lambda y, c: y + c.sum(0), y0, corrected(k))

        def residual(k):
            return combine((1.0, -h), (k, f(t1, arrived(k))))

        if self.corrector == "once":
            ok: Any = True
            k = scaled(h, f(t1, combine((1.0, 1.0), (y0, predicted))))
        else:
            k, ok = root(residual, self.root_finder, scaled(h, now), y0, self.root_find_max_steps)
        coefficients = corrected(k)
        u = jax.tree.map(lambda c: c.sum(0), coefficients)
        error = refused(jnp.asarray(ok), combine((1.0, -1.0), (u, predicted)))
        return Step(combine((1.0, 1.0), (y0, u)), error, coefficients, ok)


class BDF(AbstractMultistep):
    """Backward differentiation of order 1 to 6: A-stable to 2, A(alpha) above, for stiff equations.

    Fields: formula_order; root_finder, root_find_max_steps.
    """

    formula_order: int = eqx.field(static=True)
    root_finder: optx.AbstractRootFinder = eqx.field(default_factory=chord)
    root_find_max_steps: int = MAX_STEPS

    def __check_init__(self):
        if not 1 <= self.formula_order <= 6:
            raise ValueError(f"BDF of order {self.formula_order}: zero-stable from 1 to 6 alone")

    @property
    def past(self) -> int:
        return self.formula_order  # one more than the formula needs: for the extrapolation

    @property
    def degree(self) -> int:
        return max(self.formula_order, self._starter.tableau.stages)

    @property
    def _starter(self) -> ImplicitRungeKutta:
        stages = 2 if self.formula_order <= 3 else 3
        return ImplicitRungeKutta(
            tables.radau_iia(stages), self.root_finder, self.root_find_max_steps
        )

    def order(self, terms):
        return self.formula_order

    def error_order(self, terms):
        return self.formula_order + 1

    def remembered(self, f, t0, y0):
        return y0

    def begin(self, f, t0, h, y0):
        starter, first = self._starter, scaled(h, f(t0, y0))
        y1, k, ok = starter.solve(f, t0, h, y0, first)
        error = refused(ok, starter.estimate(f, t0, h, y0, first, k))
        return Step(y1, error, starter.polynomial(k), ok)

    def formula(self, f, t0, h, y0, now, history):
        nodes = jnp.concatenate([jnp.array([1.0, 0.0], t0.dtype), self._nodes(t0, h, history)])
        from_y0 = jax.tree.map(lambda old, y: old - y, history.values, y0)
        weights = basis(nodes[1:])  # of y0, whose increment is zero, and the past
        predicted = mixed(weights[1:].sum(1), from_y0)  # the polynomials at 1
        nodes = nodes[:-1]
        from_y0 = jax.tree.map(lambda x: x[:-1], from_y0)
        slopes = slopes_at_one(nodes)
        slope = mixed(slopes[2:], from_y0)

        def residual(k):
            rate = f(t0 + h, combine((1.0, 1.0), (y0, k)))
            # divided by the weight of k, so that the residual is an increment too
            return combine((1.0, 1 / slopes[0], -h / slopes[0]), (k, slope, rate))

        k, ok = root(residual, self.root_finder, predicted, y0, self.root_find_max_steps)
        increments = jax.tree.map(lambda k, old: jnp.concatenate([k[None], old]), k, from_y0)
        rows = jnp.delete(basis(nodes), 1, axis=0)[:, 1:]
        share = 1 / (1 - (history.ts[-1] - t0) / jnp.where(h == 0, 1.0, h))
        error = refused(ok, combine((share, -share), (k, predicted)))
        return Step(combine((1.0, 1.0), (y0, k)), error, mixed(rows.T, increments), ok)


def adams_bashforth(order: int) -> Adams:
    """Explicit, `order` rates, the new one among them, one evaluation a step."""
    return Adams(order)


def adams_moulton(order: int, **options) -> Adams:
    """Implicit; order 2 is the trapezoidal rule."""
    return Adams(order, "root", **options)


def pece(order: int) -> Adams:
    """Adams-Bashforth of order - 1, evaluated, corrected by Adams-Moulton, evaluated."""
    return Adams(order, "once")


def bdf(order: int, **options) -> BDF:
    """BDF of a given order; order 1 is backward Euler."""
    return BDF(order, **options)
