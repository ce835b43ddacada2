"""Integration until an event: the first zero of a guard along the solution of y' = f(t, y).

A loop of adaptive steps of order 8 locates the event time T by bisection of its last step, with a
Runge-Kutta step for each trial, so that no interpolation limits the accuracy. Its times are
constants under differentiation: the solution is computed once more with these steps, by a loop that
has forward and reverse derivatives. Newton's steps of the time, each with a Runge-Kutta step of the
state,

    d = -g(t, y) / g',   g' = g_t + g_y f,   t <- t + d,   y <- y(t + d)
remove the error of the location, and their derivative is the derivative of the event:
dT = -g_y dy / g', dy(T) = (I - f g_y / g') dy. After a reset y+ = r(y-), `carry_back` returns the
state on the later solution at the constant time. The two together are the saltation matrix
S = r_y + (f+ - r_y f- - r_t) g_y / g'.

Source: Hairer, Norsett & Wanner, *Solving Ordinary Differential Equations I*, II.6; Leine &
Nijmeijer, *Dynamics and Bifurcations of Non-Smooth Mechanical Systems*, 2004, ch. 7.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import integer, real_number, shown
from rbjax.compiling import compiled, inside_jit
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.lanes.arrays import select
from rbjax.solvers.root_finding import stop_gradient
from rbjax.solvers.tableau import of_diffrax

DOPRI8 = of_diffrax(diffrax.Dopri8, 8)

#: (t, y, args) -> y'
VectorField = Callable[[Any, Any, Any], Any]
#: (t, y, args) -> scalar, positive before the event
Guard = Callable[[Any, Any, Any], jax.Array]


@displayed
class Arrival(NamedTuple):
    """Result of `integrate_until`.

    Fields:
        t: (), time of the event in s, or t1 if there was none.
        y: the solution at t.
        reached: (), whether the event occurred.
        success: (), whether the solves succeeded and all values are finite.
        ys: (T, ...), the solution at the times `ts`, held at its first and last value outside of
            [t0, t]; None without `ts`.
        located: (), the time t as a constant under differentiation.
    """

    t: jax.Array
    y: Any
    reached: jax.Array
    success: jax.Array
    ys: Any
    located: jax.Array


def integrate_until(
    vector_field: VectorField,
    y0: Any,
    guard: Guard,
    t1: Any,
    args: Any = None,
    *,
    t0: Any = 0.0,
    ts: Any = None,
    leaving: Any = False,
    tolerance: float | None = None,
    max_steps: int = 256,
) -> Arrival:
    """Integrate y' = f(t, y, args) from t0 until a guard falls to zero, at most until t1.

    Use it for impacts, footfalls and switches of a hybrid system: a vector field, a guard, and a
    reset of the state at the event. Derivatives of t and y by y0 and args include the derivative of
    the event time, in forward and reverse mode and of second order.

    The event is a change of sign of the guard from one step of the solver to the next. A guard that
    falls below zero and rises again within one step has no event.

    Args:
        vector_field: function (t, y, args) -> y', a pytree as y.
        y0: the state at t0, a pytree of floating-point arrays.
        guard: function (t, y, args) -> scalar, positive before the event.
        t1: latest time in s.
        args: parameters of the vector field and the guard, a pytree.
        t0: first time in s; constant under differentiation.
        ts: (n,) increasing times in s at which to save the solution.
        leaving: whether the guard is zero at t0, as after an impact. This zero is no event: it is
            divided out, g / (t - t0). True, False or a traced boolean.
        tolerance: relative and absolute tolerance of a step of Dopri8; 1e-10 (f64) or 1e-5 (f32)
            if None.
        max_steps: largest number of steps.

    Returns:
        `Arrival`. A solve that fails, for example by `max_steps`, has success False.

    Raises:
        InputError: a state that is not floating-point, a guard that is not a scalar.

    Source: Hairer, Norsett & Wanner, *Solving Ordinary Differential Equations I*, II.6.

    Example: the time at which a falling ball touches the ground, and its slope by the height
        >>> import jax, jax.numpy as jnp, rbjax as rb
        >>> def touch(h):
        ...     fall = lambda t, y, g: jnp.stack([y[1], -g])
        ...     height = lambda t, y, g: y[0]
        ...     return rb.solvers.integrate_until(
        ...         fall, jnp.stack([h, 0.0 * h]), height, 5.0, jnp.asarray(9.81)
        ...     ).t
        >>> [round(float(x), 4) for x in jax.value_and_grad(touch)(jnp.asarray(1.0))]
        [0.4515, 0.2258]
    """
    where = "integrate_until"
    integer(where, "max_steps", max_steps, least=1)
    for name, f in (("vector_field", vector_field), ("guard", guard)):
        if not callable(f):
            raise InputError(f"{where}: {name} is {shown(f)}, expected a function of t, y and args")
    for name, t in (("t0", t0), ("t1", t1)):
        real_number(where, name, t, "a time in s", traced=True)
    if tolerance is not None:
        real_number("integrate_until", "tolerance", tolerance, "a number above zero", above=0.0)
    try:
        dtype = jnp.result_type(*jax.tree.leaves(y0))
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: y0 is {shown(y0)}, expected a pytree of arrays") from error
    if not jnp.issubdtype(dtype, jnp.floating):
        raise InputError(f"integrate_until: y0 has dtype {dtype}, expected floating-point arrays")
    start, end = (jax.lax.stop_gradient(jnp.asarray(t, dtype)) for t in (t0, t1))
    shape = jax.eval_shape(guard, start, y0, args)
    if getattr(shape, "shape", None) != ():
        raise InputError(f"integrate_until: the guard returned {shape}, expected one number")
    if tolerance is None:
        tolerance = 1e-10 if dtype == jnp.float64 else 1e-5
    solve = _solve if inside_jit() else _compiled
    times = None if ts is None else jnp.asarray(ts, dtype)
    given = (vector_field, guard, y0, args, start, end, times, jnp.asarray(leaving, bool))
    return solve(*given, jnp.asarray(tolerance, dtype), max_steps)


def _solve(
    f: VectorField, guard: Guard, y0: Any, args: Any, start: Any, end: Any, ts: Any, leaving: Any,
    tolerance: Any, max_steps: int,
) -> Arrival:  # fmt: skip
    """Compute the result of `integrate_until` from checked arguments."""
    steps = _locate(
        _closed(f, start, y0, args), _closed(guard, start, y0, args), stop_gradient(y0),
        stop_gradient(args), start, end, leaving, tolerance, max_steps,
    )  # fmt: skip
    y, ys = _replay(f, y0, args, start, steps, ts)
    t, y = _arrive(f, guard, steps.located, y, args, steps.reached)
    finite = [jnp.isfinite(x).all() for x in jax.tree.leaves((t, y))]
    success = jnp.stack([steps.found, *finite]).all()
    return Arrival(t, y, steps.reached, success, ys, steps.located)


_compiled = compiled(_solve, jit=eqx.filter_jit)


def carry_back(vector_field: VectorField, t: Any, y: Any, args: Any, located: Any) -> Any:
    """Return the state at the time `located`, on the solution through (t, y).

    Use it after a reset at an event: `located` equals t, but is constant under differentiation, so
    that the next solve begins at a constant time.

    Args:
        vector_field: function (t, y, args) -> y'.
        t: time of the event in s, `Arrival.t`.
        y: the state after the reset.
        args: parameters of the vector field.
        located: `Arrival.located`.

    Returns:
        The state, as y.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.solvers import carry_back
        >>> y = carry_back(lambda t, y, args: -y, jnp.array(1.0), jnp.array(2.0), None, 1.0)
        >>> round(float(y), 6)
        2.0
    """
    return _runge_kutta_step(vector_field, t, y, args, located - t)


class _Steps(NamedTuple):
    """Steps of a solve: their ends (max_steps,), the last time, whether there was an event, and
    whether the solve succeeded."""

    ends: jax.Array
    located: jax.Array
    reached: jax.Array
    found: jax.Array


def _closed(f: Callable, *example: Any) -> Callable:
    """Return a function f whose captured arrays are constants under differentiation."""
    return stop_gradient(eqx.filter_closure_convert(f, *example))


class _Trial(NamedTuple):
    """The loop of `_locate`: the last accepted (t, y), the next step h, the ends of the accepted
    steps, counts of accepted steps and of trials, bounds of the step to the event, and the number
    of halvings of their interval."""

    t: jax.Array
    y: Any
    h: jax.Array
    ends: jax.Array
    accepted: jax.Array
    trials: jax.Array
    low: jax.Array
    high: jax.Array
    halvings: jax.Array


def _locate(
    f: VectorField, guard: Guard, y0: Any, args: Any, start: Any, end: Any, leaving: Any,
    tolerance: Any, max_steps: int,
) -> _Steps:  # fmt: skip
    """Choose the steps by their error estimate, and bisect the first step that ends with a guard
    not above zero."""

    def condition(t: Any, y: Any) -> jax.Array:
        value, elapsed = guard(t, y, args), t - start
        divides = leaving & (elapsed > 0)
        return jnp.asarray(value / jnp.where(divides, elapsed, 1), start.dtype)

    def attempt(now: _Trial) -> _Trial:
        """Try a step of length h: accept it, shorten it, or halve the interval that contains the
        event."""
        h = jnp.minimum(now.h, end - now.t)
        t = jnp.where(now.h < end - now.t, now.t + h, end)
        y, error = _long_step(f, now.t, now.y, args, h)
        parts = [
            jnp.max(jnp.abs(e) / (1 + jnp.maximum(jnp.abs(a), jnp.abs(b))), initial=0.0)
            for e, a, b in zip(*map(jax.tree.leaves, (error, now.y, y)), strict=True)
        ]
        size = functools.reduce(jnp.maximum, parts) / tolerance
        accept = size <= 1
        beyond = ~(condition(t, y) > 0)
        bisects = now.halvings > 0
        low = jnp.where(bisects & ~beyond, h, now.low)
        high = jnp.where((bisects | accept) & beyond, h, now.high)
        event = bisects | (accept & beyond)
        factor = jnp.where(size > 0, 0.9 * jnp.where(size > 0, size, 1) ** (-1 / 8), 10.0)
        grown = h * jnp.where(jnp.isfinite(size), jnp.clip(factor, 0.1, 10.0), 0.1)
        go = accept & ~event
        return _Trial(
            jnp.where(go, t, now.t),
            select(go, y, now.y),
            jnp.where(event, (low + high) / 2, grown),
            now.ends.at[now.accepted].set(jnp.where(go, t, jnp.inf)),
            now.accepted + go,
            now.trials + 1,
            low,
            high,
            now.halvings + event,
        )

    digits = jnp.finfo(start.dtype).nmant

    def unfinished(now: _Trial) -> jax.Array:
        searching = (now.halvings == 0) & (now.t < end) & (now.trials < max_steps)
        return searching | ((now.halvings > 0) & (now.halvings <= digits))

    # a guard that is not positive has its event at t0, unless the solution leaves its zero
    at_once = ~leaving & (condition(start, y0) <= 0)
    count, zero = jnp.zeros((), int), jnp.zeros((), start.dtype)
    last = jax.lax.while_loop(unfinished, attempt, _Trial(
        jnp.where(at_once, end, start), y0, 0.01 * (end - start),
        jnp.full(max_steps, jnp.inf, start.dtype), count, count, zero, zero, count,
    ))  # fmt: skip
    event = last.halvings > 0
    located = jnp.where(at_once, start, jnp.where(event, last.t + last.high, last.t))
    ends = jnp.minimum(last.ends, located)
    return _Steps(*stop_gradient((ends, located, at_once | event, event | (last.t >= end))))


def _replay(
    f: VectorField, y0: Any, args: Any, start: jax.Array, steps: _Steps, ts: Any
) -> tuple[Any, Any]:
    """Return the solution at the end of the given steps, and at the times ts within them. A step
    that contains such a time is divided there."""
    extra = jnp.zeros(0, start.dtype) if ts is None else jnp.asarray(ts, start.dtype)
    extra = jnp.clip(extra, start, steps.located)
    ends = jnp.sort(jnp.concatenate([steps.ends, extra]))

    def advance(carry: tuple, end: jax.Array) -> tuple[tuple, Any]:
        t, y = carry
        y = jax.lax.cond(end > t, lambda: _long_step(f, t, y, args, end - t)[0], lambda: y)
        return (jnp.maximum(t, end), y), None if ts is None else y

    (_, y), path = jax.lax.scan(jax.checkpoint(advance), (start, y0), ends)
    if ts is None:
        return y, None
    index = jnp.searchsorted(ends, extra, side="left")
    return y, jax.tree.map(lambda x: x[index], path)


def _long_step(f: VectorField, t: Any, y: Any, args: Any, h: Any) -> tuple[Any, Any]:
    """Return the solution after a step h of order 8 and its estimated error. The stages are a
    loop."""
    zeros = jax.tree.map(lambda x: jnp.zeros((DOPRI8.stages, *x.shape), x.dtype), y)

    def stage(ks: Any, row: tuple) -> tuple[Any, None]:
        i, c, a = row
        at = jax.tree.map(lambda x, k: x + h * weigh(a, k), y, ks)
        rates = f(t + c * h, at, args)
        return jax.tree.map(lambda k, rate: k.at[i].set(rate), ks, rates), None

    def weigh(weights: jax.Array, k: jax.Array) -> jax.Array:
        return (weights.astype(k.dtype).reshape(-1, *(1,) * (k.ndim - 1)) * k).sum(0)

    a, b, c, e = (jnp.asarray(x, h.dtype) for x in (DOPRI8.a, DOPRI8.b, DOPRI8.c, DOPRI8.error[1:]))
    ks, _ = jax.lax.scan(stage, zeros, (jnp.arange(DOPRI8.stages), c, a))
    after = jax.tree.map(lambda x, k: x + h * weigh(b, k), y, ks)
    return after, jax.tree.map(lambda k: h * weigh(e, k), ks)


def _arrive(
    f: VectorField, guard: Guard, t: jax.Array, y: Any, args: Any, reached: jax.Array
) -> tuple[jax.Array, Any]:
    """Move (t, y) along the solution to the zero of the guard, by two steps of Newton's method."""

    def step(now: tuple, _: Any) -> tuple[tuple, None]:
        t, y = now
        flow = (jnp.ones_like(t), f(t, y, args))
        value, rate = jax.jvp(lambda t, y: guard(t, y, args), (t, y), flow)
        moves = reached & (rate != 0)
        d = jnp.where(moves, -value / jnp.where(moves, rate, 1), 0)
        return (t + d, _runge_kutta_step(f, t, y, args, d)), None

    return jax.lax.scan(step, (t, y), None, length=2)[0]


def _runge_kutta_step(f: VectorField, t: Any, y: Any, args: Any, h: Any) -> Any:
    """Return the solution after a step h by the classical Runge-Kutta method."""

    def stage(now: tuple, row: tuple) -> tuple[tuple, None]:
        k, total = now
        share, weight = (x * h for x in row)
        k = f(t + share, jax.tree.map(lambda x, k: x + share * k, y, k), args)
        return (k, jax.tree.map(lambda s, k: s + weight * k, total, k)), None

    zero = jax.tree.map(jnp.zeros_like, y)
    rows = jnp.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]], h.dtype)
    return jax.lax.scan(stage, (zero, y), (rows[:, 0], rows[:, 1]))[0][1]
