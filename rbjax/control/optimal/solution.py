"""What a method found, and how well it is an optimum."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.control.optimal.problem import Knot, Problem
from rbjax.control.optimal.shooting.augmented_lagrangian import PENALTY
from rbjax.control.status import BUDGET, CONVERGED, INFEASIBLE, SENTENCES
from rbjax.errors import InputError
from rbjax.model.record import Record


class Between(NamedTuple):
    """What a collocation found within the steps: c (s,), where, from 0 to 1; states with leading
    axes N and s; ctrls (N, s, m)."""

    c: jax.Array
    states: Any
    ctrls: jax.Array


class Found(NamedTuple):
    """What every method returns: knots (N + 1, ...), ctrls (N, m), cost (), outcome (),
    iterations (); stop (), the change of the cost that was still foreseen; gap (), the largest
    between a step and the next state; violation (), the largest of a constraint; costs
    (history,) of the iterations, nan after the last; K (N, m, n), gains of the feedback; and the
    multipliers of the constraints at the knots with controls (N, c) and at the end (e,). between:
    a collocation's stages; violations of each constraint, from methods whose controls are not held
    over a step; penalty () of the augmented Lagrangian, None for methods without one."""

    knots: Knot
    ctrls: jax.Array
    cost: jax.Array
    outcome: jax.Array
    iterations: jax.Array
    stop: jax.Array
    gap: jax.Array
    violation: jax.Array
    costs: jax.Array
    K: jax.Array
    path: jax.Array
    end: jax.Array
    between: Between | None = None
    violations: jax.Array | None = None
    penalty: jax.Array | None = None


class Solution(Record):
    """A motion and its controls.

    Fields: problem; ts (N + 1,) s; states, with a leading axis N + 1; ctrls (N, nu); numbers (p,),
    what was found of the design and the final time; cost (), without penalties; outcome (), 1 if
    it converged; iterations (); stop (), the change of the cost that the last iteration foresaw;
    gap (), the largest between a step and the next state, on the tangent space; violation () of
    constraints, and violations (number of constraints,) of each; costs (history,) of the
    iterations; K (N, nu, n), gains of the feedback u = ctrls + K (x (-) states); multipliers, a
    pair; penalty () of the augmented Lagrangian; between, the stages of a collocation, whose
    `ctrls` are means over the steps.
    """

    problem: Problem
    ts: jax.Array
    states: Any
    ctrls: jax.Array
    numbers: jax.Array
    cost: jax.Array
    outcome: jax.Array
    iterations: jax.Array
    stop: jax.Array
    gap: jax.Array
    violation: jax.Array
    violations: jax.Array
    costs: jax.Array
    K: jax.Array
    multipliers: tuple[jax.Array, jax.Array]
    penalty: jax.Array
    between: Between | None
    method: str = eqx.field(static=True)

    @property
    def converged(self) -> jax.Array:
        """Whether an optimum was found. Methods without derivatives cannot know it."""
        return self.outcome == CONVERGED

    @property
    def status(self) -> str:
        """How the search ended, in words; of one problem, not of a batch."""
        if jnp.ndim(self.outcome):
            raise InputError("status: the solution is a batch, expected one; look at `outcome`")
        outcome = int(self.outcome)
        said = SENTENCES[outcome]
        names = [c.name for c in self.problem.constraints]
        if outcome == INFEASIBLE or (outcome == BUDGET and names and self.violations.max() > 1e-6):
            worst = int(jnp.argmax(self.violations))
            off = float(self.violations[worst])
            said += f"; the constraint worst held is {names[worst]!r}, by {off:.3g}"
        return said

    @property
    def model(self) -> Any:
        """The model with the numbers that were found."""
        return self.problem.at(self.numbers)[0].model

    @property
    def duration(self) -> jax.Array:
        """The final time, s."""
        return self.ts[..., -1]

    def state(self, k: int) -> Any:
        """The state at knot k."""
        return jax.tree.map(lambda x: x[k], self.states)

    def policy(self) -> Callable[[Any, Any], jax.Array]:
        """The feedback (t, state) -> ctrl about the motion, within the bounds: for `rb.rollout`."""
        dt = self.ts[1] - self.ts[0]
        problem, system = self.problem, self.problem.at(self.numbers)[0]
        N = problem.horizon
        n = system.n

        def act(t: Any, state: Any) -> jax.Array:
            k = jnp.clip(jnp.floor((t - self.ts[0]) / dt + 1e-6).astype(int), 0, N - 1)
            here = jax.tree.map(lambda x: x[k], self.states)
            dx = system.minus(state, here)
            u = self.ctrls[k] + (self.K[k, :, :n] * dx).sum(-1)
            return jnp.clip(u, problem.low.astype(u.dtype), problem.high.astype(u.dtype))

        return act


def solution_of(
    problem: Problem, found: Found, off: jax.Array, ts: jax.Array, numbers: jax.Array, method: str
) -> Solution:
    """The public form of what a method found."""
    penalty = found.penalty
    if penalty is None:
        penalty = jnp.full_like(found.cost, PENALTY)
    return Solution(
        problem, ts, found.knots.state, found.ctrls, numbers, found.cost, found.outcome,
        found.iterations, found.stop, found.gap, found.violation,
        off, found.costs, found.K,
        (found.path, found.end), penalty, found.between, method,
    )  # fmt: skip
