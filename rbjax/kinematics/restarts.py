"""Damped Gauss-Newton search for goals from many starts, in sequence, in one loop.

    dq = N s + J^T (J J^T + c E 1)^-1 e ,      E = |e|^2 / 2

The damping is proportional to the error (Sugihara 2011). s is a step towards a posture, projected
to the null space of the goals. Coordinates at a bound whose step points out of the range are fixed
(an active set of two rounds). Each iteration evaluates one configuration. If it meets the goals,
the search ends. If the error has stopped falling, or the start has no iterations left, the next
start begins. If no start succeeds, up to `POLISH` more iterations improve the best configuration,
so a target out of reach gives the nearest pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.algorithms.manifold import difference_lanes, integrate_lanes
from rbjax.kinematics.goals import Goal, GoalErrors, unrolled_driver
from rbjax.kinematics.joint_ranges import Ranges
from rbjax.lanes import Lane, add, inner, is_zero, ldlt, mul, sub, total
from rbjax.model import Model
from rbjax.model.record import Record

#: maximum number of rounds of the active set
ROUNDS = 2


def weighted_errors(goal_errors: GoalErrors) -> tuple[list[Lane], list[list[Lane]]]:
    """Return the errors e and the rows of J, each times the weight of its row."""
    e = [mul(w, x) for w, x in zip(goal_errors.weights, goal_errors.errors, strict=True)]
    rows = zip(goal_errors.weights, goal_errors.rows, strict=True)
    J = [[mul(w, x) for x in row] for w, row in rows]
    return e, J


def step(
    q: Sequence[Lane],
    e: Sequence[Lane],
    J: Sequence[Sequence[Lane]],
    ranges: Ranges,
    null_step: Sequence[Lane] | None,
    damping: Lane,
) -> list[Lane]:
    """Return the damped least-squares step dq (nv lanes) at q, without motion beyond active limits.

    e, J: weighted errors and their Jacobian. null_step: step in the null space of J, or None.
    """
    g = transpose_product(J, e)
    direction = g if null_step is None else [add(a, b) for a, b in zip(g, null_step, strict=True)]
    dq = g
    for _ in range(ROUNDS):
        J, null_step = without_active_limits(q, J, null_step, ranges, direction)
        dq = unbounded_step(e, J, null_step, damping)
        if not ranges.bounded and not ranges.balls:
            break
        direction = dq
    return dq


def without_active_limits(
    q: Sequence[Lane],
    J: Sequence[Sequence[Lane]],
    null_step: Sequence[Lane] | None,
    ranges: Ranges,
    direction: Sequence[Lane],
) -> tuple[Sequence[Sequence[Lane]], Sequence[Lane] | None]:
    """Remove the coordinates at active limits from J and from the null-space step. Return both.

    A limit is active if the coordinate is at its bound and the step `direction` leaves the range.
    """
    free, outward = ranges.free(q, direction), ranges.outward(q, direction)

    def row(x: Sequence[Lane]) -> list[Lane]:
        out = list(x)
        for i, mask in free.items():
            out[i] = mul(mask, out[i])
        for start, axis in outward.items():
            at = range(start, start + 3)
            if not all(is_zero(out[i]) for i in at):
                along = inner(axis, [out[i] for i in at])
                for i, a in zip(at, axis, strict=True):
                    out[i] = sub(out[i], mul(along, a))
        return out

    return [row(x) for x in J], None if null_step is None else row(null_step)


def unbounded_step(
    e: Sequence[Lane], J: Sequence[Sequence[Lane]], null_step: Sequence[Lane] | None, damping: Lane
) -> list[Lane]:
    """Return s + J^T (J J^T + damping)^-1 (e - J s), from the smaller of J J^T and J^T J."""
    if null_step is not None:
        e = [sub(x, inner(row, null_step)) for x, row in zip(e, J, strict=True)]
    moving = [i for i in range(len(J[0])) if any(not is_zero(row[i]) for row in J)]
    if len(moving) < len(J):
        columns = [[row[i] for row in J] for i in moving]
        x = solve(columns, damping, [inner(c, e) for c in columns])
        found: list[Lane] = [0.0] * len(J[0])
        for i, value in zip(moving, x, strict=True):
            found[i] = value
    else:
        found = transpose_product(J, solve(J, damping, e))
    if null_step is None:
        return found
    return [add(a, b) for a, b in zip(found, null_step, strict=True)]


def solve(A: Sequence[Sequence[Lane]], damping: Lane, b: Sequence[Lane]) -> list[Lane]:
    """Solve (A A^T + damping) x = b."""
    square: list[list[Lane]] = []
    for i, row in enumerate(A):
        square.append([inner(row, other) for other in A[: i + 1]])
        square[i][i] = add(square[i][i], damping)
    return ldlt(square).solve(b)


def transpose_product(J: Sequence[Sequence[Lane]], y: Sequence[Lane]) -> list[Lane]:
    """Return J^T y."""
    return [total(mul(row[i], x) for row, x in zip(J, y, strict=True)) for i in range(len(J[0]))]


def half_square(e: Sequence[Lane]) -> jax.Array:
    """Return the cost E = |e|^2 / 2 of weighted pose errors e."""
    return jnp.asarray(inner(e, e)) / 2


#: The damping is SHARE * E + LEAST * tolerance. The second term makes a singular J J^T invertible.
#: With a posture, it leaves an error of its size times the multipliers.
SHARE, LEAST = 3e-2, 1e-4
#: a start ends if the error does not fall to `FALL` of its minimum within `PATIENCE` iterations
FALL, PATIENCE = 0.5, 4
#: iterations from the best configuration if no start succeeds
POLISH = 100
#: the search has converged to a closest pose if no entry of dq exceeds this, m or rad
REST = 1e-10
#: largest change of a coordinate in an iteration, m or rad
LONGEST = 1.0


class InverseKinematics(Record):
    """The result of `inverse_kinematics`.

    q: configuration within the joint ranges, (nq,).
    rotation_error: largest rotation error of any goal, rad.
    position_error: largest position error of any goal, m.
    success: true if both errors are within the tolerance.
    iterations: total number of iterations of all starts.
    start: index of the start that converged; 0 is the argument `start`.
    """

    q: jax.Array
    rotation_error: jax.Array
    position_error: jax.Array
    success: jax.Array
    iterations: jax.Array
    start: jax.Array

    def summary(self) -> str:
        """Return "converged ..." or "closest pose ..."; for a batch, the number that converged."""
        met = np.asarray(self.success)
        rotation, position = np.asarray(self.rotation_error), np.asarray(self.position_error)
        if met.ndim and met.all():
            return f"converged: all {met.size}"
        if met.ndim:
            return (
                f"{int(met.sum())} of {met.size} converged; the worst result is "
                f"{np.max(position, where=~met, initial=0.0):.3g} m and "
                f"{np.max(rotation, where=~met, initial=0.0):.3g} rad from its goal"
            )
        rest = f"{float(position):.3g} m and {float(rotation):.3g} rad from the goal"
        if met:
            return f"converged: {rest}, by start {int(self.start)}"
        return (
            f"closest pose: {rest}. No start reached it within the joint ranges: it may be out of "
            "reach; more seeds or another key search further"
        )


class _SearchState(NamedTuple):
    q: jax.Array
    lowest: jax.Array
    stuck: jax.Array
    turn: jax.Array
    start: jax.Array
    total: jax.Array
    done: jax.Array
    best: jax.Array
    best_E: jax.Array
    met: jax.Array
    rotation: jax.Array
    position: jax.Array


def search(
    model: Model,
    goals: Sequence[Goal],
    start: jax.Array,
    others: jax.Array,
    posture: jax.Array | None,
    weights: tuple[Any, Any],
    tolerance: tuple[Any, Any],
    *,
    iterations: int,
    limits: bool,
) -> InverseKinematics:
    """Search for the goals from each start in turn, and return the first solution or nearest pose.

    start: first start, (nq,).
    others: starts that follow, (n, nq).
    weights, tolerance: pairs, for rotation errors and for position errors.
    iterations: maximum number for each start. limits: whether joints stay within their ranges.
    """
    dtype, top, last = start.dtype, model.topology, 1 + others.shape[0]
    ranges, d = Ranges(model, dtype, limits), unrolled_driver(model, dtype)
    least = LEAST * jnp.minimum(*(jnp.asarray(x, dtype) for x in tolerance))
    squares = [jnp.square(jnp.asarray(x, dtype)) for x in tolerance]

    def iterate(now: _SearchState) -> _SearchState:
        q = list(now.q)
        goal_errors = GoalErrors(model, d, goals, now.q, weights)
        e, J = weighted_errors(goal_errors)
        E = half_square(e)
        errors = [_array(goal_errors.size(turns), dtype) for turns in (True, False)]
        met = (errors[0] <= squares[0]) & (errors[1] <= squares[1])
        null_step = None if posture is None else difference_lanes(top, q, list(posture))
        damping = SHARE * E + least
        dq = step(q, e, J, ranges, null_step, damping)
        dq = [x if is_zero(x) else jnp.clip(x, -LONGEST, LONGEST) for x in dq]
        moved = ranges.within(integrate_lanes(top, q, [_array(x, dtype) for x in dq]))

        longest = jnp.max(jnp.stack([jnp.abs(_array(x, dtype)) for x in dq]))
        finished = met if posture is None else met & (longest <= jnp.sqrt(squares[0]))
        better = (now.best_E > E) | met
        better = jnp.where(now.met, met, better)
        fell = FALL * now.lowest >= E
        stuck = jnp.where(fell | met, 0, now.stuck + 1)
        polishing = now.start >= last
        over = jnp.where(
            polishing,
            (now.turn >= POLISH) | (longest <= REST),
            (now.turn + 1 >= iterations) | (stuck > PATIENCE),
        ) | ~jnp.isfinite(E)
        best = jnp.where(better, now.q, now.best)
        # at the last iteration, met goals suffice even if the posture has not converged
        done = finished | (over & (polishing | now.met | met))
        following = now.start + 1
        fresh = best
        if last > 1:
            row = others[jnp.clip(following - 1, 0, last - 2)]
            fresh = jnp.where(following < last, row, best)
        return _SearchState(
            q=jnp.where(over, fresh, jnp.stack([_array(x, dtype) for x in moved])),
            lowest=jnp.where(over, jnp.inf, jnp.where(fell, E, now.lowest)),
            stuck=jnp.where(over, 0, stuck),
            turn=jnp.where(over, 0, now.turn + 1),
            start=jnp.where(over & ~done, following, now.start),
            total=now.total + 1,
            done=done,
            best=best,
            best_E=jnp.where(better, E, now.best_E),
            met=now.met | met,
            rotation=jnp.where(better, errors[0], now.rotation),
            position=jnp.where(better, errors[1], now.position),
        )

    endless, none = jnp.asarray(jnp.inf, dtype), jnp.asarray(0, jnp.int32)
    first = _SearchState(
        start, endless, none, none, none, none, jnp.asarray(False), start, endless,
        jnp.asarray(False), endless, endless,
    )  # fmt: skip
    end = jax.lax.while_loop(lambda now: ~now.done, iterate, first)
    return InverseKinematics(
        end.best, jnp.sqrt(end.rotation), jnp.sqrt(end.position), end.met, end.total, end.start
    )


def _array(x: Lane, dtype: Any) -> jax.Array:
    return jnp.asarray(x, dtype)
