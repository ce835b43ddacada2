"""One damped Gauss-Newton step towards goals, within the ranges of joints.

    dq = N s + J^T (J J^T + c E 1)^-1 e ,      E = |e|^2 / 2
The damping is proportional to the error itself (Sugihara, *Solvability-unconcerned inverse
kinematics by the Levenberg-Marquardt method*, 2011): far from the goal, or where it is out of
reach, the step is short; near it the method is Newton's. The residuals and rows of J are weighted.
s is a desired step in the null space of the goals (towards a posture). The pair is the solution
of  min |dq - s|^2 + |e - J dq|^2 / (c E).

Coordinates at the end of their range that would be driven out of it are held: their columns are
left out. The signs of the gradient J^T e choose first, then those of the step, once more, because
without the held columns the others turn (an active set of two rounds). The result is clipped.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from rbjax.kinematics.goals import GoalErrors
from rbjax.kinematics.joint_ranges import Ranges
from rbjax.lanes import Lane, add, inner, is_zero, ldlt, mul, sub, total

#: rounds of the active set
ROUNDS = 2


def weighted(goal_errors: GoalErrors) -> tuple[list[Lane], list[list[Lane]]]:
    """e and the rows of J, each times the weight of its row."""
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
    """The step dq (nv lanes) from q, for weighted e and J."""
    g = transposed(J, e)
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
    q: Sequence[Lane], J: Sequence[Sequence[Lane]], null_step: Sequence[Lane] | None,
    ranges: Ranges, direction: Sequence[Lane],
) -> tuple[Sequence[Sequence[Lane]], Sequence[Lane] | None]:
    """J and the desired step without the coordinates at active limits."""
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
    """s + J^T (J J^T + damping)^-1 (e - J s), by whichever matrix is smaller."""
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
        found = transposed(J, solve(J, damping, e))
    if null_step is None:
        return found
    return [add(a, b) for a, b in zip(found, null_step, strict=True)]


def solve(A: Sequence[Sequence[Lane]], damping: Lane, b: Sequence[Lane]) -> list[Lane]:
    """x of (A A^T + damping) x = b."""
    square: list[list[Lane]] = []
    for i, row in enumerate(A):
        square.append([inner(row, other) for other in A[: i + 1]])
        square[i][i] = add(square[i][i], damping)
    return ldlt(square).solve(b)


def transposed(J: Sequence[Sequence[Lane]], y: Sequence[Lane]) -> list[Lane]:
    """J^T y."""
    return [total(mul(row[i], x) for row, x in zip(J, y, strict=True)) for i in range(len(J[0]))]


def half_square(e: Sequence[Lane]) -> jax.Array:
    """E = |e|^2 / 2."""
    return jnp.asarray(inner(e, e)) / 2
