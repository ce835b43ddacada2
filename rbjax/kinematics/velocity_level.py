"""Differential inverse kinematics: the velocity that moves frames towards goals, within limits.

    min  sum over goals of |J_w v - V|^2 + d |v - v_0|^2 ,     l <= v <= u
    l = max(-speed, (lower - q) / dt),  u = min(speed, (upper - q) / dt)

It is a strictly convex quadratic program with bounds, solved exactly by an active set.
Source: Nakamura & Hanafusa 1986; Nocedal & Wright, 16.5 (active set).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import check_positive
from rbjax.compiler import compile_threads, kernels_available
from rbjax.compiling import compiled, inside_jit
from rbjax.dynamics.arguments import (
    check_array,
    check_model,
    check_moves,
    check_quaternions,
    check_step,
)
from rbjax.dynamics.tracing.custom_rules import split_tracers
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_bound, check_not_negative, check_several
from rbjax.kinematics.goals import Goal, errors
from rbjax.kinematics.joint_ranges import Ranges
from rbjax.kinematics.position_level import check_frames
from rbjax.lanes import ldlt, matmat, matvec
from rbjax.meshes import automatic
from rbjax.model import Model
from rbjax.model.record import Record

WHERE = "differential_inverse_kinematics"
#: maximum number of steps per coordinate; each step fixes or frees one coordinate
STEPS = 8


class DifferentialInverseKinematics(Record):
    """The result of `differential_inverse_kinematics`.

    v: velocity within the limits, (nv,).
    residual: requested minus actual velocity, goal by goal, rotation first, (m,).
    optimality: largest entry of the projected gradient, ().
    """

    v: jax.Array
    residual: jax.Array
    optimality: jax.Array


def differential_inverse_kinematics(
    model: Model,
    q: Any,
    goals: Goal | Sequence[Goal],
    *,
    rate: Any = 1.0,
    speed: Any = np.inf,
    dt: float | None = None,
    rest: Any = None,
    damping: Any = 1e-6,
) -> DifferentialInverseKinematics:
    """Compute the velocity (nv,) that moves frames towards goals, within speeds and joint ranges.

        min |W (J v - rate e)|^2 + damping |v - rest|^2,   l <= v <= u

    e is the error of the goals (`Goal`). With J v = rate e, each error decays as exp(-rate t).

    Args:
        model: the robot.
        q: (nq,) configuration, within the ranges.
        goals: a `Goal` or several; their weights W matter if not all can be met.
        rate: 1/s, decay rate of the errors; 1 / dt gives a Newton step.
        speed: the largest speed of each coordinate, rad/s or m/s, a number or (nv,).
        dt: s, the step within which no joint passes the end of its range; None ignores the ranges.
        rest: (nv,) preferred velocity in the null space of the goals; zero if None.
        damping: the weight of |v - rest|^2, which bounds v near singular configurations.

    Returns:
        `DifferentialInverseKinematics`.

    Raises:
        UnknownName: no such frame.
        InputError: a wrong shape; a frame that no joint moves.

    Source: Nakamura & Hanafusa 1986; Nocedal & Wright, *Numerical Optimization*, 16.5.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("arm7")
        >>> goal = rb.control.Goal(site="tool", position=[0.4, 0.0, 0.5])
        >>> found = rb.control.differential_inverse_kinematics(
        ...     model, model.default_state().q, goal, rate=5.0, speed=1.0)
        >>> found.v.shape
        (7,)
    """
    check_model(WHERE, model)
    check_moves(WHERE, model)
    goals = check_several(WHERE, "goals", (goals,) if isinstance(goals, Goal) else goals, "Goal")
    if not goals or not all(isinstance(g, Goal) for g in goals):
        raise InputError(f"{WHERE}: goals has entries of other types, expected Goals")
    check_frames(WHERE, model, goals)
    q = check_array(WHERE, "q", q, (model.nq,))
    check_quaternions(WHERE, "q", model, q)
    rate = check_not_negative(WHERE, "rate", rate, ()).astype(q.dtype)
    damping = check_not_negative(WHERE, "damping", damping, ()).astype(q.dtype)
    most = _speeds(speed, model.nv, q.dtype)
    v0 = jnp.zeros(model.nv, q.dtype)
    if rest is not None:
        v0 = check_array(WHERE, "rest", rest, (model.nv,)).astype(q.dtype)
    step = None if dt is None else check_step(WHERE, "dt", dt, q.dtype)
    args = (model, goals, q, v0, rate, most, step, damping)
    inside = split_tracers(args)[0] and inside_jit()
    return (_inlined if inside else _program)(*args)


@automatic
def _inlined(*args: Any) -> DifferentialInverseKinematics:
    """Solve by a kernel, with one sample per GPU thread or SIMD lane, if kernels are available."""
    moving, closed = split_tracers(args)

    def run(moving: list) -> DifferentialInverseKinematics:
        return _solved(*closed(moving))

    return (compile_threads(run) if kernels_available() else run)(moving)


_program = compiled(_inlined)


def _solved(
    model: Model, goals: Sequence[Goal], q: jax.Array, v0: jax.Array, rate: jax.Array,
    most: jax.Array, step: Any, damping: jax.Array,
) -> DifferentialInverseKinematics:  # fmt: skip
    low, high = -most, most
    if step is not None:
        for at in Ranges(model, q.dtype).bounded:
            low = low.at[at.v].max(jnp.minimum((at.lower - q[at.q]) / step, 0.0))
            high = high.at[at.v].min(jnp.maximum((at.upper - q[at.q]) / step, 0.0))
    e, J = errors(model, goals, q)
    weights = jnp.stack([jnp.asarray(g.weight, q.dtype) for g in goals for _ in range(g.rows)])
    A, b = J * weights[:, None], rate * e * weights
    H = matmat(A.T, A) + damping * jnp.eye(model.nv, dtype=q.dtype)
    v, optimality = bounded_quadratic(H, matvec(A.T, b) + damping * v0, low, high)
    return DifferentialInverseKinematics(v, rate * e - matvec(J, v), optimality)


class _Set(NamedTuple):
    """State of the active set: point, mask of fixed entries, true if optimal, step count."""

    x: jax.Array
    held: jax.Array
    done: jax.Array
    step: jax.Array


def bounded_quadratic(
    H: jax.Array, g: jax.Array, low: jax.Array, high: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Solve min x^T H x / 2 - g^T x, low <= x <= high, for positive definite H, by an active set.
    Returns x and the largest entry of the projected gradient at x. Unlike the projected Newton
    steps of `box_qp`, the active set also converges for ill-conditioned H."""
    n, dtype = g.shape[0], g.dtype
    program = jax.lax.stop_gradient((H, g, low, high))
    size = jnp.abs(program[1]).max() + jnp.abs(program[0]).max()
    rounding = 64 * float(jnp.finfo(dtype).eps) * size

    def newton(H: jax.Array, free: jax.Array, slope: jax.Array) -> jax.Array:
        rows = H * (free[:, None] * free[None, :]) + jnp.diag(1 - free)
        found = ldlt([list(row) for row in rows]).solve(list(-slope * free))
        return jnp.stack([jnp.asarray(a, dtype) for a in found])

    def step(now: _Set) -> _Set:
        H, g, low, high = program
        x = now.x
        d = newton(H, jnp.where(now.held, 0.0, 1.0).astype(dtype), matvec(H, x) - g)
        end = jnp.where(d > 0, high, low)
        room = jnp.where(d == 0, jnp.inf, (end - x) / jnp.where(d == 0, 1.0, d))
        first = jnp.argmin(room)
        blocked = room[first] < 1
        there = jnp.clip(x + jnp.minimum(room[first], 1.0) * d, low, high)
        hit = (jnp.arange(n) == first) & blocked
        there = jnp.where(hit, end, there)
        slope = matvec(H, there) - g
        presses = jnp.where(there <= low, slope, -slope)
        wrong = jnp.where(now.held & ~blocked, -presses, -jnp.inf)
        worst = jnp.argmax(wrong)
        frees = wrong[worst] > rounding
        released = (jnp.arange(n) == worst) & frees
        held = (now.held | hit) & ~released
        return _Set(there, held, ~blocked & ~frees, now.step + 1)

    x = jnp.clip(jnp.zeros_like(g), *program[2:])
    start = _Set(x, jnp.zeros(n, bool), jnp.asarray(False), jnp.asarray(0, jnp.int32))
    found = jax.lax.while_loop(lambda now: ~now.done & (now.step < STEPS * n), step, start)
    # a Newton step with value zero and the derivative of the solution
    at_low = found.held & (found.x <= low)
    x = jnp.where(found.held, jnp.where(at_low, low, high), found.x)
    free = jnp.where(found.held, 0.0, 1.0).astype(dtype)
    d = newton(H, free, matvec(H, x) - g)
    x = x + (d - jax.lax.stop_gradient(d))
    slope = matvec(H, x) - g
    # at a bound, only a slope that leads into the range counts as a residual
    slope = jnp.where(x <= low, jnp.minimum(slope, 0.0), slope)
    slope = jnp.where(x >= high, jnp.where(x <= low, 0.0, jnp.maximum(slope, 0.0)), slope)
    return x, jnp.abs(slope).max()


def _speeds(speed: Any, n: int, dtype: Any) -> jax.Array:
    x = check_bound(WHERE, "speed", speed)
    if x.shape not in ((), (n,)):
        raise InputError(f"{WHERE}: speed has shape {x.shape}, expected () or ({n},)")
    check_positive(WHERE, speed=x)
    return jnp.broadcast_to(x, (n,)).astype(dtype)
