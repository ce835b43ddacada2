"""An optimal control problem, independent of the method.

    min  sum_k h L_i(t_k, x_k, u_k) + sum Phi_j(x_N)        over u and the free parts of x_0, p, T
    x_{k+1} = f(t_k, x_k, u_k, h; p),   low <= u_k <= high,   low <= c(t_k, x_k, u_k) <= high

p are parameters of the model (`Design`), T = N h is the final time. Both are states with a zero
derivative: a knot is (x, p, T), and its tangent vector (dx, dp, dT).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import flag, instance, integer
from rbjax.control.optimal.problem_table import problem_display
from rbjax.control.optimal.system import LinearisedStep, System, system_of
from rbjax.control.optimal.terms import Constraint, Cost, Term, cost_of
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_array, check_step, check_takes
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_bound, check_several, known_array
from rbjax.lanes import safe_sqrt
from rbjax.model.record import Record
from rbjax.motion.field import free_motion


class Design(Record):
    """Parameters of the model that are optimised together with the motion.

    apply: function (model, p (n,)) -> model.
    start: first guess, (n,).
    low, high: bounds, (n,).
    """

    apply: Callable[[Any, jax.Array], Any]
    start: jax.Array
    low: jax.Array
    high: jax.Array

    def __init__(self, apply: Any, start: Any, low: Any = -np.inf, high: Any = np.inf) -> None:
        check_takes("Design", "apply", apply, "model", "p")
        self.apply = apply
        n = jnp.atleast_1d(check_bound("Design", "start", start)).shape
        if len(n) != 1:
            raise InputError(f"Design: start has shape {n}, expected (n,)")
        self.start = check_array("Design", "start", jnp.atleast_1d(jnp.asarray(start, float)), n)
        low, high = (check_bound("Design", k, x, (), n) for k, x in (("low", low), ("high", high)))
        self.low, self.high = jnp.broadcast_to(low, n), jnp.broadcast_to(high, n)
        lowest, first, highest = (known_array(x) for x in (self.low, self.start, self.high))
        if lowest is None or first is None or highest is None:  # traced
            return
        if not ((lowest <= first) & (first <= highest)).all():
            raise InputError(
                f"Design: low is {lowest.tolist()}, start {first.tolist()}, high "
                f"{highest.tolist()}, expected low <= start <= high"
            )


@displayed
class Knot(NamedTuple):
    """A state of the system, and the parameters (p,), which are constant along the motion."""

    state: Any
    parameters: jax.Array


BODY, NEXT = slice(None, -1), slice(1, None)  # knots with controls, knots after them


def take(tree: Any, at: Any) -> Any:
    """Index the first axis of all arrays of a pytree."""
    return jax.tree.map(lambda x: x[at], tree)


def append(tree: Any, last: Any) -> Any:
    """Append an entry to the first axis of all arrays of a pytree."""
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), tree, last)


class Problem(Record):
    """An optimal control problem: find controls, and the free parts of the start, model and time.

    Args:
        model: an `rb.Model`; `Equations`; or a robot of `rb.wheeled.at`.
        horizon: N, the number of steps, each with constant controls.
        dt: the step in s; the model's timestep if None.
        running: costs at the N knots with controls: `Cost(term, weight)`, a term, or a function
            ([model,] t, state, ctrl) -> a cost, or a vector of residuals r with the cost r.r / 2.
        terminal: costs of the last state, of the same kinds, evaluated with ctrl = 0.
        constraints: `Constraint`s.
        bounds: "model" for its control ranges, None, or (low, high), each a number or (nu,).
        integral: true if running costs are rates, multiplied by dt; false to sum them as they are.
        design: a `Design`, parameters of the model that are optimised too.
        free_time: (low, high) s, bounds of a free final time; its first guess is horizon * dt.
        start_time: t_0, the time in s of the first knot.
        free_start: optimised tangent coordinates of the start: True for all, or (n,) booleans.
        integrator, dynamics, held: `integrator`, `dynamics`, `constraints` of `rb.rollout`.

    Raises:
        InputError: no knot, no cost, bounds that contradict each other, wrong types.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> goal = rb.control.StateError(model.default_state())
        >>> problem = rb.control.Problem(model, 50, 0.02, running=[rb.control.Control()],
        ...                              terminal=[rb.control.Cost(goal, 100.0)])
        >>> problem.n, problem.nu
        (4, 1)
    """

    system: System
    dt: jax.Array
    running: tuple[Cost, ...]
    terminal: tuple[Cost, ...]
    constraints: tuple[Constraint, ...]
    low: jax.Array
    high: jax.Array
    design: Design | None
    times: jax.Array | None
    start_time: jax.Array
    horizon: int = eqx.field(static=True)
    integral: bool = eqx.field(static=True)
    bounded: bool = eqx.field(static=True)
    free: tuple[bool, ...] = eqx.field(static=True)

    def __init__(
        self, model: Any, horizon: int, dt: Any = None, *,
        running: Sequence[Any] = (), terminal: Sequence[Any] = (),
        constraints: Sequence[Constraint] = (), bounds: Any = "model", integral: bool = True,
        design: Design | None = None, free_time: Any = None, free_start: Any = False,
        start_time: Any = 0.0,
        integrator: Any = None, dynamics: Any = free_motion, held: Any = None,
    ) -> None:  # fmt: skip
        self.system = system_of("Problem", model, integrator, dynamics, held)
        self.horizon = integer("Problem", "horizon", horizon, least=1)
        dt = getattr(model, "timestep", None) if dt is None else dt
        if dt is None:
            raise InputError("Problem: dt is None, expected a step in s; only an rb.Model has one")
        self.dt = check_step("Problem", "dt", dt, jnp.zeros(()).dtype)
        self.running = _costs("running", running)
        self.terminal = _costs("terminal", terminal)
        if not self.running + self.terminal:
            raise InputError("Problem: no cost, expected one in running or terminal")
        constraints = check_several("Problem", "constraints", constraints, "Constraint")
        wrong = [type(c).__name__ for c in constraints if not isinstance(c, Constraint)]
        if wrong:
            raise InputError(
                f"Problem: constraints has {wrong}, expected rb.control.Constraint(term, low, high)"
            )
        self.constraints = tuple(constraints)
        terms: tuple[Cost | Constraint, ...] = (*self.running, *self.terminal, *self.constraints)
        for x in terms:
            if x.knots is not None and max(x.knots, default=0) >= horizon:
                raise InputError(
                    f"Problem: {x.term.label} has knots {x.knots}, expected indices below the "
                    f"horizon {horizon}"
                )
        self.low, self.high, self.bounded = _bounds(self.system, bounds)
        self.integral = flag("Problem", "integral", integral)
        instance("Problem", "design", design, Design | None, "a Design")
        self.design = design
        self.times = None if free_time is None else _times(free_time)
        finite = ": a finite time in s"
        self.start_time = check_array("Problem", "start_time", start_time, (), fix=finite)
        self.free = _free(free_start, self.system.n)

    _display_ = problem_display

    @property
    def nu(self) -> int:
        """The number of controls."""
        return self.system.nu

    @property
    def parameter_count(self) -> int:
        """The number of parameters: of the design, plus one for a free final time."""
        design = 0 if self.design is None else self.design.start.shape[0]
        return design + (self.times is not None)

    @property
    def n(self) -> int:
        """The dimension of a knot's tangent space."""
        return self.system.n + self.parameter_count

    @property
    def free_first_knot(self) -> bool:
        """True if any part of the first knot is free."""
        return any(self.free) or self.parameter_count > 0

    def within_bounds(self, u: jax.Array) -> jax.Array:
        """Return the controls projected onto their bounds."""
        if not self.bounded:
            return u
        return jnp.clip(u, self.low.astype(u.dtype), self.high.astype(u.dtype))

    @property
    def by_velocities(self) -> bool:
        """True if a step is dq+ = dq + h dv+ on a knot's tangent space (dq, dv)."""
        return self.system.by_velocities and not self.parameter_count

    # functions of the parameters of a knot

    def first_parameters(self, dtype: Any) -> jax.Array:
        """Return the first guess (p,) of the parameters."""
        parts = [] if self.design is None else [self.design.start]
        if self.times is not None:
            parts.append(jnp.atleast_1d(jnp.clip(self.dt * self.horizon, *self.times)))
        return jnp.concatenate(parts).astype(dtype) if parts else jnp.zeros(0, dtype)

    def parameter_bounds(self, dtype: Any) -> tuple[jax.Array, jax.Array]:
        """Return the lower and upper bounds of the parameters, (p,) each."""
        ends = [] if self.design is None else [(self.design.low, self.design.high)]
        if self.times is not None:
            ends.append((self.times[:1], self.times[1:]))
        low, high = zip(*ends, strict=True) if ends else ([jnp.zeros(0)], [jnp.zeros(0)])
        return jnp.concatenate(low).astype(dtype), jnp.concatenate(high).astype(dtype)

    def at(self, parameters: jax.Array) -> tuple[System, jax.Array]:
        """Return the system and the step size for the parameters."""
        system, dt = self.system, self.dt.astype(parameters.dtype)
        if self.times is not None:
            dt = parameters[-1] / self.horizon
        if self.design is not None:
            size = self.design.start.shape[0]
            system = system.with_model(self.design.apply(system.model, parameters[:size]))
        return system, dt

    def time(self, k: Any, dt: Any) -> Any:
        """Return the time in s of knot k."""
        return self.start_time.astype(dt.dtype) + k * dt

    # a knot

    def plus(self, knot: Knot, dx: jax.Array) -> Knot:
        """Return knot (+) dx."""
        n = self.system.n
        return Knot(self.system.plus(knot.state, dx[:n]), knot.parameters + dx[n:])

    def minus(self, one: Knot, other: Knot) -> jax.Array:
        """Return dx (n,) from `other` to `one`."""
        parts = [self.system.minus(one.state, other.state), one.parameters - other.parameters]
        return jnp.concatenate(parts)

    def off_start(self, start: Any, first: Knot) -> jax.Array:
        """Return the gap start (-) first knot (n,), which is 0 for free coordinates."""
        off = jnp.where(jnp.asarray(self.free), 0.0, self.system.minus(start, first.state))
        return jnp.concatenate([off, jnp.zeros(self.parameter_count, off.dtype)])

    def step(self, k: Any, knot: Knot, ctrl: jax.Array) -> Knot:
        """Return the knot after a step."""
        system, dt = self.at(knot.parameters)
        return Knot(system.step(self.time(k, dt), knot.state, ctrl, dt), knot.parameters)

    def linear(self, k: Any, knot: Knot, ctrl: jax.Array) -> LinearisedStep:
        """Return the knot after a step, and its derivatives A and B by knot and controls."""
        system, dt = self.at(knot.parameters)
        after, A, B = system.linear(self.time(k, dt), knot.state, ctrl, dt)
        after = Knot(after, knot.parameters)
        p = self.parameter_count
        if p:

            def moved(dp: jax.Array) -> jax.Array:
                there = self.step(k, Knot(knot.state, knot.parameters + dp), ctrl)
                return system.minus(there.state, after.state)

            by = jax.jacfwd(moved)(jnp.zeros_like(knot.parameters))
            below = jnp.eye(p, self.n, self.system.n, dtype=A.dtype)
            A = jnp.concatenate([jnp.concatenate([A, by], 1), below])
            B = jnp.concatenate([B, jnp.zeros((p, self.nu), B.dtype)])
        return LinearisedStep(after, A, B)

    def term(self, term: Term, k: Any, knot: Knot, ctrl: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the value of a term at a knot, and the step size."""
        system, dt = self.at(knot.parameters)
        value = term(system.model, self.time(k, dt), knot.state, ctrl)
        try:
            return jnp.asarray(value, dt.dtype), dt
        except (TypeError, ValueError) as error:
            got = type(value).__name__
            raise InputError(
                f"Problem: the term {term.label} returned {got}, expected a number or a vector"
            ) from error

    def value(self, cost: Cost, where: str, k: Any, knot: Knot, ctrl: jax.Array) -> jax.Array:
        """Return a cost at a knot with controls ("path") or at the "end". It is a number, or
        weighted residuals (r,) with the cost r.r / 2."""
        value, dt = self.term(cost.term, k, knot, ctrl)
        w = jnp.asarray(cost.weight, dt.dtype)
        if self.integral and where == "path":
            w = w * dt
        if where == "path" and cost.knots is not None:
            w = w * self.counts_at(cost.knots, k)
        if value.ndim > 1:
            raise InputError(
                f"Problem: the cost {cost.term.label} returned shape {value.shape}, expected a "
                "number or a vector"
            )
        if w.shape not in ((), value.shape):
            raise InputError(
                f"Problem: the weight of {cost.term.label} has shape {w.shape}, expected () or "
                f"the shape of its value, {value.shape}"
            )
        return safe_sqrt(w) * value if value.ndim else w * value

    def row(self, c: Constraint, k: Any, knot: Knot, ctrl: jax.Array) -> jax.Array:
        """Return the values (c,) of a constraint at a knot."""
        value = jnp.ravel(self.term(c.term, k, knot, ctrl)[0])
        if c.knots is None:
            return value
        low, high = (jnp.ravel(jnp.asarray(x, value.dtype)) for x in (c.low, c.high))
        return jnp.where(self.counts_at(c.knots, k), value, jnp.clip(value, low, high))

    def counts_at(self, knots: tuple[int, ...], k: Any) -> jax.Array:
        """Return whether knot index k, rounded down (a stage has a fraction), is in `knots` or the
        end.
        """
        counts = np.zeros(self.horizon + 1, bool)
        counts[[*knots, self.horizon]] = True
        at = jnp.floor(jnp.asarray(k) + 1e-6).astype(jnp.uint32)
        return jax.lax.dynamic_index_in_dim(jnp.asarray(counts), at, keepdims=False)

    def rows(self, where: str, k: Any, knot: Knot, ctrl: jax.Array) -> jax.Array:
        """Return the values (c,) of the constraints at "path" or "end"."""
        none = jnp.zeros(0, knot.parameters.dtype)
        return jnp.concatenate(
            [none, *(self.row(c, k, knot, ctrl) for c in self.constraints_at(where))]
        )

    def costs(self, where: str) -> tuple[Cost, ...]:
        """Return the costs of a knot with controls ("path") or of the "end"."""
        return self.running if where == "path" else self.terminal

    def constraints_at(self, where: str) -> list[Constraint]:
        """Return the constraints at "path" or "end"."""
        return [c for c in self.constraints if c.where in (where, "all")]


def _costs(name: str, given: Any) -> tuple[Cost, ...]:
    if isinstance(given, (Cost, Term)) or callable(given):
        given = (given,)
    given = check_several("Problem", name, given, "costs")
    return tuple(cost_of(f"Problem({name}=...)", x) for x in given)


def _bounds(system: System, bounds: Any) -> tuple[jax.Array, jax.Array, bool]:
    if isinstance(bounds, str):
        if bounds != "model":
            raise InputError(f"Problem: bounds is {bounds!r}, expected 'model', None, (low, high)")
        low, high = system.ctrl_range
    elif bounds is None:
        low, high = -jnp.inf, jnp.inf
    else:
        try:
            low, high = bounds
        except (TypeError, ValueError) as error:
            raise InputError(
                f"Problem: bounds is {bounds!r}, expected 'model', None or (low, high)"
            ) from error
    low, high = (
        check_bound("Problem", f"{side} of bounds", x, (), (system.nu,))
        for side, x in (("low", low), ("high", high))
    )
    lowest, highest = known_array(low), known_array(high)
    low, high = (jnp.broadcast_to(x, (system.nu,)) for x in (low, high))
    if lowest is None or highest is None:
        return low, high, True
    if not (lowest < highest).all():
        raise InputError(
            f"Problem: bounds of controls are {lowest.tolist()} and {highest.tolist()}, expected "
            "low < high"
        )
    return low, high, bool((np.isfinite(lowest) | np.isfinite(highest)).any())


def _times(free_time: Any) -> jax.Array:
    times = check_bound("Problem", "free_time", free_time)
    known = known_array(times)
    if times.shape != (2,) or (known is not None and not 0 < known[0] < known[1]):
        raise InputError(
            f"Problem: free_time is {free_time!r}, expected (low, high) with 0 < low < high"
        )
    return times


def _free(free_start: Any, n: int) -> tuple[bool, ...]:
    free = np.broadcast_to(np.asarray(free_start), (n,)) if np.ndim(free_start) < 1 else free_start
    free = np.asarray(free)
    if free.shape != (n,) or free.dtype != bool:
        raise InputError(f"Problem: free_start is {free_start!r}, expected a bool or ({n},) bools")
    return tuple(map(bool, free))
