"""Linear multistep methods of variable step: Adams-Bashforth, Adams-Moulton, PECE and BDF.

    Adams:  y1 = y0 + int_t0^t1 P(t) dt,     P through the rates at past times (and t1: Moulton)
    BDF:    Q'(t1) = f(t1, y1),              Q through y1 and the past values
The interpolation uses the actual times, so the step size may vary at every order. For
zero-stability a step may grow by at most 1 + sqrt(2) at order 2, and less at higher orders
(`diffrax.PIDController(factormax=...)`). Adams methods start with RK4, BDF with Radau IIA. The
error estimate is the difference from the method of one order less (Adams), or from the
extrapolation of past values (BDF). The dense output is the polynomial.

Source: Hairer, Norsett & Wanner, *Solving Ordinary Differential Equations I*, III.1 and III.5.
"""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree

from rbjax._jax_compat import any_of_batch
from rbjax.arguments import integer
from rbjax.errors import InputError
from rbjax.lanes.arrays import select
from rbjax.solvers import tableau as tables
from rbjax.solvers.field import SolverField, flatten
from rbjax.solvers.root_finding import MAX_STEPS, chord, mark_failed, step_result
from rbjax.solvers.runge_kutta import ImplicitRungeKutta, Start, solve, start
from rbjax.solvers.steps import (
    AbstractPolynomialSolver,
    combine,
    explicit_stages,
    hermite_coefficients,
    weighted_sums,
)


def basis(nodes: jax.Array) -> jax.Array:
    """Return the coefficients (n, n) of the Lagrange polynomials of distinct nodes (n,). Row j
    contains l_j(x) = prod_m (x - x_m) / (x_j - x_m), constant first."""
    n = nodes.shape[0]
    own = jnp.eye(n, dtype=bool)
    out = jnp.zeros((n, n), nodes.dtype).at[:, 0].set(1.0)
    for m in range(n):
        times_x = jnp.pad(out, ((0, 0), (1, 0)))[:, :-1]
        gap = jnp.where(own[m], 1.0, nodes - nodes[m])[:, None]
        out = jnp.where(own[m][:, None], out, (times_x - nodes[m] * out) / gap)
    return out


def integrals(nodes: jax.Array) -> jax.Array:
    """Return the coefficients (n, n) of x, x^2, ... in int_0^x l_j, one row per node."""
    return basis(nodes) / jnp.arange(1, nodes.shape[0] + 1, dtype=nodes.dtype)


def slopes_at_one(nodes: jax.Array) -> jax.Array:
    """Return the derivatives l_j'(1) (n,) of the Lagrange polynomials."""
    return (basis(nodes) * jnp.arange(nodes.shape[0], dtype=nodes.dtype)).sum(1)


class StepHistory(NamedTuple):
    """Entries before the current state, latest first, and the number of filled entries."""

    ts: jax.Array  # (n,)
    values: jax.Array  # (n, size of the state): rates (Adams) or states (BDF)
    filled: jax.Array


class MultistepResult(NamedTuple):
    """Result of a step on vectors."""

    u: jax.Array  # (n,) y1 - y0
    error: jax.Array | None
    coefficients: jax.Array  # (degree, n) of the dense output
    ok: Any


class BackwardDifference(NamedTuple):
    """The formula h Q'(t1) = slope u + known of BDF, for the increment u of the state in a step."""

    nodes: jax.Array  # (n,) times of the interpolated states in steps, 1 and 0 first
    past: jax.Array  # (n - 2, size) increments of the past states
    predicted: jax.Array  # (size,) their extrapolation
    slope: jax.Array
    known: jax.Array  # (size,)
    share: jax.Array  # weight of u - predicted in the error estimate

    @classmethod
    def of(cls, times: jax.Array, past: jax.Array) -> BackwardDifference:
        """times: (n,) times of the past states in units of the step, with its start at 0."""
        nodes = jnp.concatenate([jnp.array([1.0, 0.0], times.dtype), times])
        weights = basis(nodes[1:])  # row 0 is the current state, whose increment is zero
        predicted = weighted_sums(weights[1:].sum(1), past)  # polynomials evaluated at 1
        nodes, past = nodes[:-1], past[:-1]  # the extrapolation has one state more
        slopes = slopes_at_one(nodes).astype(past.dtype)
        share = (1 / (1 - times[-1])).astype(past.dtype)
        known = weighted_sums(slopes[2:], past)
        return cls(nodes, past, predicted, slopes[0], known, share)

    def result(self, k: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return u, its error and the coefficients of the dense output, from k = h f(t1, y1)."""
        u = (k - self.known) / self.slope
        rows = jnp.delete(basis(self.nodes), 1, axis=0)[:, 1:]
        coefficients = weighted_sums(rows.T, jnp.concatenate([u[None], self.past]))
        return u, self.share * (u - self.predicted), coefficients


class AbstractMultistep(AbstractPolynomialSolver, diffrax.AbstractAdaptiveSolver):
    """Base class of multistep methods: history, and a one-step method until the history is full."""

    @property
    @abc.abstractmethod
    def degree(self) -> int:
        """Degree of the dense output."""

    @property
    @abc.abstractmethod
    def past(self) -> int:
        """Number of past entries that the formula needs in the history."""

    @abc.abstractmethod
    def start(self, f: SolverField, t0: Any, y0: jax.Array) -> Start:
        """Evaluate rate and, if necessary, Jacobian at the current state, for `begin` and
        `formula`."""

    @abc.abstractmethod
    def begin(self, f: SolverField, h: Any, here: Start) -> MultistepResult:
        """Compute a step without history, by a one-step method."""

    @abc.abstractmethod
    def formula(self, f: SolverField, h: Any, here: Start, history: StepHistory) -> MultistepResult:
        """Compute a step with the multistep formula."""

    @abc.abstractmethod
    def history_entry(self, here: Start) -> jax.Array:
        """Return the history entry of the current state."""

    def init(self, terms, t0, t1, y0, args):
        # Distinct times keep the formula finite while the history is not full.
        ts = t0 - (t1 - t0) * jnp.arange(1, self.past + 1, dtype=t0.dtype)
        vector, _ = ravel_pytree(y0)
        values = jnp.broadcast_to(vector, (self.past, vector.size))
        return StepHistory(ts, values, jnp.array(0))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        f, y = flatten(terms, args, t0, y0)
        h, here = t1 - t0, self.start(f, t0, y)
        ts, values, filled = solver_state
        filled = jnp.where(made_jump, 0, filled)
        out = self._padded(self.formula(f, h, here, StepHistory(ts, values, filled)))
        if self.past:
            starting = filled < self.past
            first = jax.lax.cond(
                any_of_batch(starting),
                lambda: self._padded(self.begin(f, h, here)),
                lambda: out,
            )
            out = select(starting, first, out)
            ts = jnp.concatenate([t0[None], ts[:-1]])
            values = jnp.concatenate([self.history_entry(here)[None], values[:-1]])
        dense = {"y0": y0, "coefficients": jax.vmap(f.unravel)(out.coefficients)}
        state = StepHistory(ts, values, jnp.minimum(filled + 1, self.past))
        error = None if out.error is None else f.unravel(out.error)
        return f.unravel(y + out.u), error, dense, state, step_result(out.ok)

    def _padded(self, step: MultistepResult) -> MultistepResult:
        """Pad the dense-output coefficients of a step with zeros to the degree of the method."""
        missing = self.degree - step.coefficients.shape[0]
        padded = jnp.pad(step.coefficients, ((0, missing), (0, 0)))
        return step._replace(coefficients=padded, ok=jnp.asarray(step.ok))

    def _nodes(self, t0: Any, h: Any, history: StepHistory) -> jax.Array:
        """Return the past times in units of the step, with t0 at 0 and t1 at 1."""
        return (history.ts - t0) / jnp.where(h == 0, 1.0, h)


ADAMS = {"none": ("Adams-Bashforth", 1), "once": ("PECE", 2), "root": ("Adams-Moulton", 2)}


class Adams(AbstractMultistep):
    """Adams methods up to order 5, started by RK4.

    Fields:
        formula_order: order, from 1 without corrector and from 2 with a corrector.
        corrector: "none" (Adams-Bashforth), "once" (PECE: predict, evaluate, correct, evaluate) or
            "root" (Adams-Moulton).
        root_finder, root_find_max_steps: used by "root".
    """

    formula_order: int = eqx.field(static=True)
    corrector: str = eqx.field(static=True, default="none")
    root_finder: optx.AbstractRootFinder = eqx.field(default_factory=chord)
    root_find_max_steps: int = MAX_STEPS

    def __check_init__(self):
        integer("Adams", "root_find_max_steps", self.root_find_max_steps, least=1)
        if not isinstance(self.corrector, str) or self.corrector not in ADAMS:
            expected = ", ".join(map(repr, ADAMS))
            raise InputError(f"Adams: corrector {self.corrector!r}, expected {expected}")
        name, least = ADAMS[self.corrector]
        why = ", the order of its start; backward Euler is bdf(1)"
        integer(name, "order", self.formula_order, least=least, most=5, why=why)

    @property
    def past(self) -> int:
        return max(self.formula_order - (1 if self.corrector == "none" else 2), 0)

    @property
    def degree(self) -> int:
        return max(self.formula_order, 3)

    def order(self, terms):
        return self.formula_order

    def start(self, f, t0, y0):
        if self.corrector == "root":
            return start(f, t0, y0, self.root_finder)
        return Start(t0, y0, f(t0, y0), None)

    def history_entry(self, here):
        return here.rate

    def begin(self, f, h, here):
        def rate(t, u):
            return f(t, here.y + u)

        k = explicit_stages(rate, tables.RK4, here.t, h)(jnp.zeros_like(here.y))
        u, error = (h * combine(weights, k) for weights in (tables.RK4.b, tables.RK4.error[1:]))
        return MultistepResult(u, error, hermite_coefficients(u, h * k[0], h * k[-1]), True)

    def formula(self, f, h, here, history):
        nodes = jnp.concatenate([jnp.zeros(1, here.t.dtype), self._nodes(here.t, h, history)])
        rates = jnp.concatenate([here.rate[None], history.values])

        def polynomial(nodes, rates):
            """Return the coefficients of the increment whose rate interpolates rates at nodes."""
            return weighted_sums(integrals(nodes).T, h * rates)

        coefficients = polynomial(nodes, rates)
        u = coefficients.sum(0)
        if self.corrector == "none":
            if self.formula_order == 1:
                return MultistepResult(u, None, coefficients, True)
            less = polynomial(nodes[:-1], rates[:-1]).sum(0)
            return MultistepResult(u, u - less, coefficients, True)

        predicted, t1 = u, here.t + h
        nodes = jnp.concatenate([jnp.ones(1, here.t.dtype), nodes])
        shares = integrals(nodes).T  # weights of k = h f(t1, y1) and of the earlier rates
        if self.corrector == "once":
            ok: Any = True
            k = h * f(t1, here.y + predicted)
        else:
            weights = shares.sum(0).astype(here.y.dtype)
            base = here.y + weighted_sums(weights[1:], h * rates)
            found, ok = solve(
                f, h, t1[None], base, weights[None, :1], here, h * here.rate[None],
                self.root_finder, self.root_find_max_steps,
            )  # fmt: skip
            k = found[0]
        coefficients = weighted_sums(shares, jnp.concatenate([k[None], h * rates]))
        u = coefficients.sum(0)
        return MultistepResult(u, mark_failed(jnp.asarray(ok), u - predicted), coefficients, ok)


class BDF(AbstractMultistep):
    """Backward differentiation formulas of order 1 to 6 for stiff equations.

    They are A-stable up to order 2, and A(alpha)-stable above.

    Fields: formula_order; root_finder, root_find_max_steps.
    """

    formula_order: int = eqx.field(static=True)
    root_finder: optx.AbstractRootFinder = eqx.field(default_factory=chord)
    root_find_max_steps: int = MAX_STEPS

    def __check_init__(self):
        integer("BDF", "root_find_max_steps", self.root_find_max_steps, least=1)
        integer(
            "BDF", "order", self.formula_order, least=1, most=6, why=", where it is zero-stable"
        )

    @property
    def past(self) -> int:
        return self.formula_order  # one more than the formula needs, for the extrapolation

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

    def start(self, f, t0, y0):
        return start(f, t0, y0, self.root_finder)

    def history_entry(self, here):
        return here.y

    def begin(self, f, h, here):
        u, k, ok = self._starter.solve(f, h, here)
        error = mark_failed(ok, self._starter.estimate(f, h, here, k))
        return MultistepResult(u, error, self._starter.polynomial(k), ok)

    def formula(self, f, h, here, history):
        q = BackwardDifference.of(self._nodes(here.t, h, history), history.values - here.y)
        found, ok = solve(
            f, h, (here.t + h)[None], here.y - q.known / q.slope, 1 / q.slope[None, None], here,
            (q.slope * q.predicted + q.known)[None], self.root_finder, self.root_find_max_steps,
        )  # fmt: skip
        u, error, coefficients = q.result(found[0])
        return MultistepResult(u, mark_failed(ok, error), coefficients, ok)


def adams_bashforth(order: int) -> Adams:
    """Return the explicit Adams method of order 1 to 5, with one evaluation per step.

    Args:
        order: 1 to 5.

    Raises:
        InputError: another order.

    Example:
        >>> import rbjax as rb
        >>> rb.solvers.adams_bashforth(3).order(None)
        3
    """
    return Adams(order)


def adams_moulton(order: int, **options: Any) -> Adams:
    """Return the implicit Adams method of order 2 (the trapezoidal rule) to 5.

    Args:
        order: 2 to 5.
        options: fields of `Adams`.

    Raises:
        InputError: another order.

    See `adams_bashforth` for an example.
    """
    return Adams(order, "root", **options)


def pece(order: int) -> Adams:
    """Return the PECE method of order 2 to 5: Adams-Bashforth predicts, Adams-Moulton corrects.

    Args:
        order: 2 to 5.

    Raises:
        InputError: another order.

    See `adams_bashforth` for an example.
    """
    return Adams(order, "once")


def bdf(order: int, **options: Any) -> BDF:
    """Return the BDF of order 1 (backward Euler) to 6.

    Args:
        order: 1 to 6.
        options: fields of `BDF`.

    Raises:
        InputError: another order.

    See `adams_bashforth` for an example.
    """
    return BDF(order, **options)
