"""Options and result of the methods of `solve`, and the public `Solution`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.control.optimal.objective import PENALTY
from rbjax.control.optimal.problem import Knot, Problem, take
from rbjax.control.status import ADVICE, BUDGET, CONVERGED, INFEASIBLE
from rbjax.display import Display, field_rows, host, number, shape
from rbjax.errors import InputError
from rbjax.model.record import Record
from rbjax.status import Status
from rbjax.svg import curves


class StoppingRule(NamedTuple):
    """Limits at which a search ends, each ().

    tolerance: expected decrease of the cost, relative to max(|cost|, scale).
    violation: largest accepted constraint violation.
    iterations: maximum number of iterations.
    scale: scale of the cost; None for min(|cost of the first guess|, 1).
    """

    tolerance: jax.Array  # expected decrease of the cost, relative to max(|cost|, scale)
    violation: jax.Array  # largest accepted constraint violation
    iterations: jax.Array  # maximum number
    scale: jax.Array | None = None  # None: min(|cost of the first guess|, 1)


class SolveOptions(Record):
    """Options of every method. `report` is called after each iteration."""

    rule: StoppingRule  # when the search ends
    seed: jax.Array | int = 0  # seed of random numbers
    multipliers: Any = None  # first multipliers of the constraints; None for zeros
    report: Callable[[Any, Any, Any], None] | None = eqx.field(static=True, default=None)


class StageValues(NamedTuple):
    """The stages of a collocation.

    c: positions of the stages in a step, from 0 to 1, (s,).
    states: with leading axes N and s.
    ctrl: (N, s, m).
    """

    c: jax.Array
    states: Any
    ctrl: jax.Array


class SearchResult(NamedTuple):
    """The result of a method, without the problem: a pytree of arrays."""

    knots: Knot  # (N + 1, ...)
    ctrl: jax.Array  # (N, m)
    cost: jax.Array  # (), without penalties
    status: jax.Array  # (), of `rbjax.control.status`
    iterations: jax.Array  # ()
    expected_decrease: jax.Array  # (), of the cost, by the last step
    gap: jax.Array  # (), the largest between a step and the next state
    violation: jax.Array  # (), the largest of a constraint
    costs: jax.Array  # (history,) of the iterations, nan after the last
    K: jax.Array  # (N, m, n), gains of du = +K dx
    path: jax.Array  # multipliers of the constraints (N, c)
    end: jax.Array  # (e,)
    stages: StageValues | None = None  # stages of a collocation
    violations: jax.Array | None = None  # largest violation of each constraint
    penalty: jax.Array | None = None  # () of the augmented Lagrangian; None for methods without one


class Solution(Record):
    """A motion, its controls and its feedback gains.

    Fields:
        problem: the `Problem`.
        ts: (N + 1,) s.
        states: with a leading axis N + 1.
        ctrl: (N, nu); for a collocation the means over the steps.
        parameters: (p,), the optimised design parameters and, last, the final time.
        cost: (), without penalties.
        status: (), a `rb.control.Status`; `summary()` explains it.
        iterations: ().
        expected_decrease: (), expected decrease of the cost by the last iteration.
        gap: (), largest entry of a step minus the next state, on the tangent space.
        violation: (), largest constraint violation.
        violations: largest violation of each constraint.
        costs: (history,), cost after each iteration.
        K: (N, nu, n), gains of the feedback u = ctrl - K (x (-) states).
        multipliers: of the constraints, a pair (N, c), (e,).
        penalty: (), of the augmented Lagrangian.
        stages: `StageValues` of a collocation, else None.
        method: name of the method.
    """

    problem: Problem
    ts: jax.Array
    states: Any
    ctrl: jax.Array
    parameters: jax.Array
    cost: jax.Array
    status: jax.Array
    iterations: jax.Array
    expected_decrease: jax.Array
    gap: jax.Array
    violation: jax.Array
    violations: jax.Array
    costs: jax.Array
    K: jax.Array
    multipliers: tuple[jax.Array, jax.Array]
    penalty: jax.Array
    stages: StageValues | None
    method: str = eqx.field(static=True)

    @property
    def success(self) -> jax.Array:
        """True if the search converged to an optimum. It is false for sampling methods."""
        return self.status == CONVERGED

    def summary(self) -> str:
        """Describe how the search of one problem ended, with the most violated constraint.

        Raises:
            InputError: a batch of solutions.
        """
        if jnp.ndim(self.status):
            raise InputError("summary: the solution is a batch, expected one; read `status`")
        status = int(self.status)
        text = ": ".join([Status(status).text, *filter(None, [ADVICE.get(status)])])
        if status == CONVERGED and self.problem.system.touches and not jnp.any(self.ctrl):
            text += (
                ", but no control acts. The cost has no derivative by a contact that the motion "
                "never makes: give controls that make it (ctrl=), or a cost that leads to it"
            )
        names = [c.name for c in self.problem.constraints]
        if status == INFEASIBLE or (status == BUDGET and names and self.violations.max() > 1e-6):
            worst = int(jnp.argmax(self.violations))
            off = float(self.violations[worst])
            text += f"; the constraint {names[worst]!r} has the largest violation, {off:.3g}"
        return text

    def _display_(self) -> Display:
        status, cost = host(self.status), host(self.cost)
        title = f"Solution by {self.method}: {self.problem.horizon} steps"
        if status is not None and status.ndim:
            title += f", {int((status == CONVERGED).sum())} of {status.size} converged"
        elif status is not None and cost is not None:
            how = Status(int(status)).text.partition(":")[0]
            title += f", {how}, cost {number(cost)}"
        names = ["iterations", "ts", "states", "ctrl", "parameters", "gap", "violation", "K"]
        return Display(title, field_rows(self, names), picture=self._chart)

    def _chart(self) -> str:
        """Draw the controls."""
        ts, ctrl = host(self.ts), host(self.ctrl)
        known = ts is not None and ctrl is not None and ts.ndim == 1 and shape(ctrl)[-1:] != (0,)
        return curves(ts[:-1], ctrl[:, :8], "ctrl") if known else ""  # type: ignore[index]

    @property
    def model(self) -> Any:
        """The model with the optimised design parameters."""
        return self.problem.at(self.parameters)[0].model

    @property
    def duration(self) -> jax.Array:
        """The final time, s."""
        return self.ts[..., -1]

    def state(self, k: int | jax.Array) -> Any:
        """Return the state at knot k."""
        return take(self.states, k)

    def policy(self) -> Callable[[Any, Any], jax.Array]:
        """Return the feedback (t, state) -> ctrl about the motion, for `rb.rollout`."""
        dt = self.ts[1] - self.ts[0]
        problem, system = self.problem, self.problem.at(self.parameters)[0]
        N, n = problem.horizon, system.n

        def act(t: Any, state: Any) -> jax.Array:
            k = jnp.clip(jnp.floor((t - self.ts[0]) / dt + 1e-6).astype(int), 0, N - 1)
            dx = system.minus(state, self.state(k))
            return problem.within_bounds(self.ctrl[k] - (self.K[k, :, :n] * dx).sum(-1))

        return act


def solution_of(
    problem: Problem, result: SearchResult, violations: jax.Array, ts: jax.Array,
    parameters: jax.Array, method: str,
) -> Solution:  # fmt: skip
    """Convert a result to the public `Solution`."""
    penalty = result.penalty
    if penalty is None:
        penalty = jnp.full_like(result.cost, PENALTY)
    return Solution(
        problem, ts, result.knots.state, result.ctrl, parameters, result.cost, result.status,
        result.iterations, result.expected_decrease, result.gap, result.violation, violations,
        result.costs, -result.K, (result.path, result.end), penalty, result.stages, method,
    )  # fmt: skip
