"""Model predictive control: a new plan at every tick, and a fallback policy if planning fails.

With a delay of d ticks (the computing time), the next d controls are already fixed at tick k. The
state is predicted over them, and the plan begins at the predicted state:

    x' = f(... f(f(x_k, u_k), u_{k+1}) ...),    (us, xs) = a few iterations from the last plan,
    shifted by a tick,    u_{k+d} = us_0 + K_0 (x_{k+d} (-) xs_0)    at tick k + d

Each plan starts from the multipliers and the penalty of the last. A plan that is not finite, or
whose constraints are infeasible, is rejected. Then the last plan is continued for at most
`patience` ticks, then a fallback policy acts. Source: Diehl, Bock & Schloder 2005; Mayne 2000.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import choice, flag, integer, real_number
from rbjax.compiler import threads
from rbjax.control.optimal.first_guess import first_guess
from rbjax.control.optimal.objective import ConstraintMultipliers, knot_violation, shift_multipliers
from rbjax.control.optimal.problem import NEXT, Knot, Problem, append, take
from rbjax.control.optimal.registry import METHODS
from rbjax.control.optimal.solution import SolveOptions, StoppingRule
from rbjax.control.optimal.system import system_of
from rbjax.control.optimal.ticks import (
    FALLBACK,
    KEPT,
    PLANNED,
    VIOLATED,
    ClosedLoop,
    Memory,
    PlannedControl,
)
from rbjax.control.products import product
from rbjax.control.status import INFEASIBLE, NOT_FINITE
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_takes
from rbjax.errors import InputError
from rbjax.lanes.arrays import select

HARDEST = 1e4  # upper bound of the penalty at the beginning of a tick
WITH_CONSTRAINTS = 10  # iterations of a tick by default; 1 without


@displayed
@dataclasses.dataclass(frozen=True, eq=False)
class PredictiveController:
    """A model predictive controller, made by `mpc`.

    `begin(state)` returns the memory. `tick(memory, t, state)` returns the control of a tick and
    the next memory. Both are pure functions, for jit and vmap. `closed_loop` simulates the
    controller with a plant. `policy` returns a policy for `rb.rollout`.
    """

    problem_at: Callable[[Any], Problem]
    problem: Problem
    method: str
    iterations: int
    delay: int
    feedback: bool
    patience: int
    fallback: Callable[[Any, Any], Any]
    tolerance: float
    violation: float
    first: int

    @property
    def dt(self) -> jax.Array:
        """The length of a tick, s."""
        return self.problem.dt

    def begin(self, state: Any, ctrl: Any = None) -> Memory:
        """Return the first memory: a plan from the state, with `first` iterations.

        Args:
            state: of the system.
            ctrl: a first guess (N, nu) of the controls; zeros if None.
        """
        problem = self.problem
        x = problem.system.checked("mpc", state)
        knots, us = first_guess(problem, x, ctrl=ctrl)
        found = self._search(problem, x, knots, us, None, self.first)
        whole = _finite((found.knots, found.ctrl, found.K)) & (found.status != NOT_FINITE)
        knots, us = select(whole, (found.knots, found.ctrl), (knots, us))
        K = jnp.where(whole, found.K, 0.0)
        memory = Memory(
            knots, us, K, self._multipliers(found), None, jnp.where(whole, 0, self.patience),
            found.status, found.cost, found.violation, self._gap(found),
        )  # fmt: skip
        each = [self._entry(memory, k) for k in range(self.delay)]
        pending = jax.tree.map(lambda *x: jnp.stack(x), *each) if each else None
        for _ in range(self.delay):
            memory = self._shifted(problem, memory)
        return memory._replace(pending=pending)

    def tick(self, memory: Memory, t: Any, state: Any) -> tuple[jax.Array, Memory, jax.Array]:
        """Return the control (nu,) of the tick at t, the next memory, and a `TickStatus` ().
        t: s. state: measured at t."""
        problem = self.problem_at(t)
        x = problem.system.checked("mpc", state)
        if not self.delay:
            memory = self._planned(problem, memory, x)
            entry = self._entry(memory, 0)
            u = self._acted(problem, entry, t, x)
            return u, self._shifted(problem, memory), entry.status
        now: PlannedControl = take(memory.pending, 0)
        coming: PlannedControl = take(memory.pending, NEXT)
        u = self._acted(problem, now, t, x)
        step = threads(problem.system.step)
        ahead = step(problem.time(0, problem.dt), x, u, problem.dt)
        for k in range(self.delay - 1):
            entry = take(coming, k)
            ahead = step(problem.time(k + 1, problem.dt), ahead, entry.u, problem.dt)
        problem = self.problem_at(t + self.delay * problem.dt)
        memory = self._planned(problem, memory, ahead)
        new = self._entry(memory, 0)
        pending = append(coming, new)
        memory = self._shifted(problem, memory)
        return u, memory._replace(pending=pending), now.status

    def closed_loop(self, state: Any, steps: int, plant: Any = None) -> ClosedLoop:
        """Simulate the closed loop, as one program.

        Args:
            state: at the beginning.
            steps: the number of ticks.
            plant: the controlled system: an `rb.Model`, a `System`, or a function (t, state, ctrl,
                dt) -> state; the system of the problem if None.
        """
        integer("closed_loop", "steps", steps, least=1)
        if plant is None:
            move = self.problem.system.step
        elif callable(plant) and not hasattr(plant, "nq"):
            check_takes("closed_loop", "plant", plant, "t", "state", "ctrl", "dt")
            move = plant
        else:
            move = system_of("closed_loop", plant).step
        x = self.problem.system.checked("closed_loop", state)
        dt = self.dt
        memory = self.begin(x)

        def one(carry: tuple, k: jax.Array) -> tuple:
            memory, x = carry
            t = self.problem.time(k, dt)
            u, memory, status = self.tick(memory, t, x)
            after = move(t, x, u, dt)
            return (memory, after), (x, u, status, memory.search_status, memory.cost)

        ks = jnp.arange(steps, dtype=dt.dtype)
        run: tuple = jax.lax.scan(one, (memory, x), ks)
        (_, last), (xs, us, statuses, search_statuses, costs) = run
        states = append(xs, last)
        ts = self.problem.time(jnp.arange(steps + 1, dtype=dt.dtype), dt)
        return ClosedLoop(ts, states, us, statuses, search_statuses, costs)

    def policy(self, memory: Memory) -> Callable[[Any, Any], jax.Array]:
        """Return a policy (t, state) -> ctrl for `rb.rollout`, without memory between its calls.
        Each call plans from the plan of `memory`, shifted to the time t. There is no delay."""
        N = self.problem.horizon

        def act(t: Any, state: Any) -> jax.Array:
            problem = self.problem_at(t)
            x = problem.system.checked("mpc", state)
            k = jnp.floor((t - self.problem.start_time) / problem.dt + 1e-6).astype(int)
            late = jnp.clip(jnp.arange(N + 1) + k, 0, N)
            knots = take(memory.knots, late)
            ctrls = memory.ctrl[jnp.minimum(late[:-1], N - 1)]
            multipliers = shift_multipliers(memory.multipliers, late[:-1])
            shifted = memory._replace(knots=knots, ctrl=ctrls, multipliers=multipliers)
            planned = self._planned(problem, shifted, x)
            return self._acted(problem, self._entry(planned, 0), t, x)

        return act

    def _search(
        self, problem: Problem, start: Any, knots: Knot, ctrls: jax.Array,
        multipliers: ConstraintMultipliers | None, iterations: int,
    ) -> Any:  # fmt: skip
        number = lambda x: jnp.asarray(x, ctrls.dtype)  # noqa: E731
        rule = StoppingRule(
            number(self.tolerance), number(self.violation), jnp.asarray(iterations), number(1.0)
        )
        options = SolveOptions(rule, multipliers=multipliers)
        return METHODS[self.method].solve(problem, start, knots, ctrls, options, iterations)

    def _gap(self, found: Any) -> jax.Array | None:
        """Return the largest gap between the knots of a plan; None without constraints."""
        return found.gap if self.problem.constraints else None

    def _multipliers(self, found: Any) -> ConstraintMultipliers | None:
        """Return the multipliers for the start of the next search; None without constraints."""
        if not self.problem.constraints or found.penalty is None:
            return None
        return ConstraintMultipliers(found.path, found.end, jnp.minimum(found.penalty, HARDEST))

    def _planned(self, problem: Problem, memory: Memory, start: Any) -> Memory:
        """Return the memory with a new plan, or with the last plan if the new one fails."""
        found = self._search(
            problem, start, memory.knots, memory.ctrl, memory.multipliers, self.iterations
        )
        good = _finite((found.knots, found.ctrl, found.K, found.cost, start))
        # accept a plan whose measured start violates a constraint
        first = take(found.knots, 0)
        zero = jnp.zeros((), found.ctrl.dtype)
        off = knot_violation(problem, "path", zero, first, found.ctrl[0]) > self.violation
        good &= (found.status != NOT_FINITE) & ((found.status != INFEASIBLE) | off)
        new = memory._replace(
            knots=found.knots, ctrl=found.ctrl, K=found.K, cost=found.cost,
            violation=found.violation, gap=self._gap(found),
            multipliers=self._multipliers(found), failures=jnp.zeros_like(memory.failures),
        )  # fmt: skip
        old = memory._replace(failures=memory.failures + 1)
        return select(good, new, old)._replace(search_status=found.status)

    def _shifted(self, problem: Problem, memory: Memory) -> Memory:
        """Shift the plan by a tick, with the last control repeated."""
        ctrls = jnp.concatenate([memory.ctrl[1:], memory.ctrl[-1:]])
        K = jnp.concatenate([memory.K[1:], memory.K[-1:]])
        last = take(memory.knots, -1)
        k = jnp.asarray(problem.horizon - 1, ctrls.dtype)
        after = threads(problem.step)(k, last, ctrls[-1])
        after = select(_finite(after), after, last)
        knots = jax.tree.map(lambda a, b: jnp.concatenate([a[1:], b[None]]), memory.knots, after)
        at = jnp.minimum(jnp.arange(problem.horizon) + 1, problem.horizon - 1)
        multipliers = shift_multipliers(memory.multipliers, at)
        return memory._replace(knots=knots, ctrl=ctrls, K=K, multipliers=multipliers)

    def _entry(self, memory: Memory, k: int) -> PlannedControl:
        """Return the planned control at index k of the plan, with gains, state and status."""
        status = jnp.asarray(PLANNED)
        if memory.gap is not None:
            # with gaps, the motion may violate constraints that the planned states satisfy
            off = jnp.maximum(memory.violation, memory.gap)
            status = jnp.where(off > self.violation, VIOLATED, PLANNED)
        status = jnp.where(memory.failures > 0, KEPT, status)
        status = jnp.where(memory.failures > self.patience, FALLBACK, status)
        state = take(memory.knots.state, k)
        return PlannedControl(memory.ctrl[k], memory.K[k], state, status)

    def _acted(self, problem: Problem, entry: PlannedControl, t: Any, state: Any) -> jax.Array:
        """Return the control of a tick, planned with feedback or of the fallback policy."""
        u = entry.u
        if self.feedback:
            back = product(entry.K, problem.system.minus(state, entry.state))
            u = u + jnp.where(_finite(back), back, 0.0)
        other = jnp.asarray(self.fallback(t, state), u.dtype)
        u = jnp.where(entry.status == FALLBACK, other, u)
        return problem.within_bounds(u)


def mpc(
    problem: Problem | Callable[[Any], Problem],
    *,
    method: str = "ddp",
    iterations: int | None = None,
    delay: int = 1,
    feedback: bool = True,
    patience: int = 5,
    fallback: Callable[[Any, Any], Any] | None = None,
    tolerance: float = 1e-9,
    violation: float = 1e-4,
    first: int = 100,
) -> PredictiveController:
    """Build a model predictive controller with a fixed number of iterations per tick.

    Args:
        problem: `Problem`, whose dt is the length of a tick. Its costs, constraints and dynamics
            depend on the time of the loop, which begins at its start_time. Or a function t ->
            Problem that returns the problem of the plan that begins at t; times in that problem
            count from its own start_time. The problems may differ only in the values of arrays.
        method: a name from `rb.control.methods()`, of a method with gains.
        iterations: maximum number of iterations per tick. None: 1, or 10 with constraints.
        delay: ticks from the measured state to its control: 1 if the computation lasts up to a
            tick, 0 in a simulation that waits for it.
        feedback: if true, the gains correct the prediction error when the control is applied.
        patience: number of ticks for which the last plan is continued while new ones fail.
        fallback: the policy (t, state) -> (nu,) after that; zeros within the bounds if None.
        tolerance: iterations end if the predicted cost change is below it times max(1, |cost|).
        violation: largest accepted constraint violation, in the units of the constraints, and gap
            between a step and its next state. A plan beyond it has the status `VIOLATED`.
        first: iterations of the first plan.

    Returns:
        `PredictiveController`.

    Raises:
        InputError: wrong types; a problem whose start, design or final time is free.
        UnknownName: no such method.

    Source: Diehl, Bock & Schloder, *A real-time iteration scheme for nonlinear optimization in
    optimal feedback control*, SIAM J. Control Optim. 2005; Mayne et al., Automatica 2000.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> C = rb.control
        >>> cart = C.Equations(lambda t, x, u: jnp.stack([x[1], u[0]]), 2, 1)
        >>> problem = C.Problem(cart, 10, 0.1, running=[lambda t, x, u: x, C.Control()],
        ...                     bounds=(-1.0, 1.0))
        >>> controller, x = C.mpc(problem, delay=0), jnp.array([1.0, 0.0])
        >>> u, memory, status = controller.tick(controller.begin(x), 0.0, x)
        >>> float(u[0]) < 0, int(status)
        (True, 0)
    """
    problem_at = _problem_at(problem)
    example = problem if isinstance(problem, Problem) else problem_at(0.0)
    if not isinstance(example, Problem):
        raise InputError(f"mpc: problem gave {type(example).__name__}, expected a Problem")
    if example.free_first_knot:
        raise InputError(
            "mpc: the start, a design or the final time of the problem is free, expected a problem "
            "whose start is the state; remove free_start, design and free_time"
        )
    choice("method of rb.control", method, METHODS)
    if iterations is None:
        iterations = WITH_CONSTRAINTS if example.constraints else 1
    for name, value, least in (
        ("iterations", iterations, 1), ("delay", delay, 0), ("patience", patience, 0),
        ("first", first, 1),
    ):  # fmt: skip
        integer("mpc", name, value, least=least)
    for name, number in (("tolerance", tolerance), ("violation", violation)):
        real_number("mpc", name, number, least=0.0, finite=False, traced=True)
    if fallback is None:
        nu = example.nu
        fallback = lambda t, state: jnp.zeros(nu)  # noqa: E731
    else:
        check_takes("mpc", "fallback", fallback, "t", "state")
    return PredictiveController(
        problem_at, example, method, iterations, delay,
        flag("mpc", "feedback", feedback), patience, fallback, tolerance, violation, first,
    )  # fmt: skip


def _problem_at(problem: Any) -> Callable[[Any], Problem]:
    if isinstance(problem, Problem):
        begin = problem.start_time
        return lambda t: eqx.tree_at(lambda p: p.start_time, problem, jnp.asarray(t, begin.dtype))
    if not callable(problem):
        raise InputError(
            f"mpc: problem is {type(problem).__name__}, expected an rb.control.Problem or a "
            "function t -> Problem"
        )
    check_takes("mpc", "problem", problem, "t")
    return problem


def _finite(tree: Any) -> jax.Array:
    each = [jnp.isfinite(x).all() for x in jax.tree.leaves(tree)]
    return jnp.stack(each).all()
