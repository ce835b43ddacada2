"""Time-optimal motion along a path, within limits of torques, speeds and steering rates.

Along a path the torques are linear in s'' and in x = s'^2 (`driven_path`). With s'' = u constant in
a step of length ds, x+ = x + 2 ds u, and all limits are half-planes of (u, x):

    |A u + B x + C| <= tau_max           at both ends of the step
    x <= min (v_max / |v|)^2, ...        of speeds and of steering rates, all linear in s'
    x = 0                                at the stops of the robot

A backward pass computes, for each step, the interval K of x from which the rest of the path can be
driven. u is eliminated from the half-planes (Fourier-Motzkin), which leaves bounds of x. A forward
pass from the start uses the largest u that leads into the next K. That motion is the fastest.

Source: Pham & Pham, *A new approach to time-optimal path parameterization based on reachability
analysis*, IEEE T-RO 34 (2018) 645, algorithm 1; Lynch & Park, *Modern Robotics*, 9.4.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import instance
from rbjax.compiling import alone, compiled
from rbjax.errors import InputError
from rbjax.lanes import safe_sqrt
from rbjax.lanes.arrays import largest, smallest
from rbjax.model.record import Record, cast_floats
from rbjax.planning.paths.path import Path
from rbjax.planning.timing.driven_path import DrivenPath, Sides, drive_along
from rbjax.planning.timing.limits import Limits, Timed, check_can_follow
from rbjax.wheeled import RobotModel


class TimeScaled(Record):
    """The fastest motion along a path.

    Fields:
        motion: a `Timed` of 2 n intervals, alternately standing and driving; some have no duration.
        success: (), whether such a motion exists.
    """

    motion: Timed
    success: jax.Array

    @property
    def status(self) -> str:
        """Status: "found", or "infeasible" if no speed satisfies the limits."""
        return "found" if bool(self.success) else "infeasible"


def time_scaling(model: RobotModel, path: Path, limits: Limits) -> TimeScaled:
    """Compute the time-optimal motion of a robot along a path, at rest at both ends.

    The robot stops and steers at reversals and at turns of more than 60 degrees. Elsewhere it
    rounds a corner between two steps, within half of each step. With shorter steps (`Path.split`)
    corners are rounded less, and the motion is slower.

    Args:
        model: a model of a rolling robot with torque sources, `wheeled.at(robot, "reduced")`.
            It starts with its steerings and trailers straight.
        path: one `Path` of the chassis. It may be padded by steps of zeros. Use `jax.vmap` for
            many.
        limits: `Limits`. The path determines the steering angles, so a path that exceeds their
            limit is infeasible at any speed.

    Returns:
        `TimeScaled`. Its coordinates are on the path with rounded corners. A replay of its controls
        without feedback misses the goal in proportion to the steps' length; `refine` ends at the
        goal. Trailers are not checked for collisions.

    Raises:
        InputError: wrong types, a batch, a robot whose drives give no torques for a path.

    Source: Pham & Pham, IEEE T-RO 34 (2018) 645.

    Example:
        >>> import rbjax as rb
        >>> robot = rb.wheeled.kinds()["differential_drive"].make(caster=None)
        >>> cart = rb.wheeled.at(robot, "reduced")
        >>> ahead = Path([0.0, 0.0, 0.0], [[2.0, 0.0, 0.0]]).split(0.1)
        >>> found = time_scaling(cart, ahead, Limits(torque=0.4, speed=1.0))
        >>> found.status, round(float(found.motion.time), 2)
        ('found', 3.15)
    """
    check_can_follow("time_scaling", model, limits)
    check_path("time_scaling", path)
    run = _program if alone() else _time_scaling
    return run(model, path, limits)


def check_path(where: str, path: Any) -> None:
    """Raise `InputError` unless the argument is one path."""
    instance(where, "path", path, Path, "rbjax.planning.Path")
    if path.start.ndim != 1 or not path.steps.shape[0]:
        raise InputError(
            f"{where}: path.steps has shape {path.steps.shape}, expected (n, 3) with n of at "
            "least 1, one path; use jax.vmap for several"
        )


def _time_scaling(model: RobotModel, path: Path, limits: Limits) -> TimeScaled:
    dtype = path.steps.dtype
    model, limits = cast_floats((model, limits), dtype)
    p = drive_along(model, limits, path)
    most = limits.torques(model)
    caps = jnp.stack([_cap(p, side, limits) for side in (p.first, p.last)])
    zero = jnp.zeros((), dtype)
    # x at the beginning of a step is also x at the end of the previous step
    cap = jnp.minimum(caps[0], jnp.concatenate([zero[None], caps[1, :-1]]))
    cap = jnp.where(p.stops, 0.0, cap)

    flat = jnp.sqrt(jnp.finfo(dtype).eps)

    def rows(k, low, high):
        """Return the constraints a u + b x <= c of step k, for a final x in [low, high].

        x is the squared path speed at the start of the step, and u the path acceleration.
        """
        step, (A0, B0, C0), (A1, B1, C1) = k
        A, B = jnp.stack([A0, A1 + 2 * step * B1]) / most, jnp.stack([B0, B1]) / most
        C, one = jnp.stack([C0, C1]) / most, jnp.ones(1, dtype)
        a, b, c = (jnp.ravel(x) for x in (A, B, C))
        # a torque that hardly depends on u bounds u only by rounding errors
        a = jnp.where(jnp.abs(a) > flat * jnp.abs(a).max(), a, 0.0)
        return (
            jnp.concatenate([a, -a, 2 * step * one, -2 * step * one]),
            jnp.concatenate([b, -b, one, -one]),
            jnp.concatenate([1 - c, 1 + c, high * one, -low * one]),
        )

    def back(next, k):
        step, cap = k
        a, b, c = rows(step, *next)
        low, high = _eliminated(a, b, c, cap)
        return (low, high), (low, high)

    steps = p.size, p.first[3:], p.last[3:]
    _, (low, high) = jax.lax.scan(back, (zero, zero), (steps, cap), reverse=True)
    ends = jnp.append(low[1:], zero), jnp.append(high[1:], zero)

    def ahead(x, k):
        step, low, high = k
        a, b, c = rows(step, low, high)
        up = a > 0
        u = smallest(jnp.where(up, (c - b * x) / jnp.where(up, a, 1.0), jnp.inf))
        after = jnp.clip(x + 2 * step[0] * jnp.where(step[0] > 0, u, 0.0), low, high)
        return after, after

    _, x = jax.lax.scan(ahead, zero, (steps, *ends))
    steerings = model.robot.layout.steerings
    angles = jnp.abs(jnp.stack([p.first.q, p.last.q])[..., steerings]).max(initial=0.0)
    rounding = 64 * jnp.finfo(dtype).eps  # for a path of arcs exactly at the limit
    ok = (low <= high).all() & (angles <= limits.steering * (1 + rounding))
    return TimeScaled(_timed(model, p, limits, jnp.concatenate([zero[None], x])), ok)


def _fastest(rates: jax.Array) -> jax.Array:
    """Compute the largest absolute steering rate of each step, per unit path speed; zero without
    steerings."""
    return largest(jnp.abs(rates)) if rates.shape[-1] else jnp.zeros(rates.shape[:-1], rates.dtype)


def _cap(p: DrivenPath, side: Sides, limits: Limits) -> jax.Array:
    """Compute the largest squared path speed x (n,) within the limits of rates, at one end of the
    steps."""
    v = side.twist
    steer = _fastest(p.bends) / limits.steering_rate
    ways = [
        (v[:, 0] ** 2 + v[:, 1] ** 2) / limits.speed**2, (v[:, 2] / limits.turn_rate) ** 2, steer**2
    ]  # fmt: skip
    return 1 / jnp.maximum(largest(jnp.stack(ways), 0), 1e-12)


def _eliminated(a, b, c, cap) -> tuple[jax.Array, jax.Array]:
    """Compute the interval of x in [0, cap] for which some u satisfies all a u + b x <= c."""
    # row i bounds u from above, row j from below; a row without u bounds x directly
    i, j, flat = a > 0, a < 0, a == 0
    eps = 64 * jnp.finfo(a.dtype).eps
    p, r = a[:, None], b[:, None]
    alpha, gamma = p * b - a * r, p * c - a * c[:, None]
    size = jnp.abs(p * b) + jnp.abs(a * r)
    used = i[:, None] & j
    alpha = jnp.concatenate([jnp.where(used & (jnp.abs(alpha) > eps * size), alpha, 0).ravel(), b])
    gamma = jnp.concatenate([jnp.where(used, gamma, 0).ravel(), c])
    alpha = alpha.at[-len(b) :].set(jnp.where(flat, b, 0))
    gamma = gamma.at[-len(b) :].set(jnp.where(flat, c, 0))
    ratio = gamma / jnp.where(alpha == 0, 1.0, alpha)
    high = jnp.minimum(cap, smallest(jnp.where(alpha > 0, ratio, jnp.inf)))
    low = jnp.maximum(0.0, largest(jnp.where(alpha < 0, ratio, -jnp.inf)))
    # rounding may make an interval that is a single point empty
    off = ((alpha == 0) & (gamma < -eps)).any() | (low > high + eps * (1 + cap))
    return jnp.where(off, jnp.inf, jnp.minimum(low, high)), high


def _timed(model: RobotModel, p: DrivenPath, limits: Limits, x: jax.Array) -> Timed:
    """Make the motion with x = s'^2 (n + 1,) at the ends of the steps."""
    n = len(p.size)
    speed = safe_sqrt(x)
    both = speed[1:] + speed[:-1]
    runs = (p.size > 0) & (both > 0)
    drive = jnp.where(runs, 2 * p.size / jnp.where(runs, both, 1.0), 0.0)
    turn = _fastest(p.turns)
    stand = turn / limits.steering_rate
    u = jnp.where(runs, (x[1:] - x[:-1]) / (2 * jnp.where(runs, p.size, 1.0)), 0.0)
    tau = [
        s.A * u[:, None] + s.B * y[:, None] + s.C for s, y in ((p.first, x[:-1]), (p.last, x[1:]))
    ]
    driving = jnp.concatenate([(tau[0] + tau[1]) / 2, p.bends * (both / 2)[:, None]], -1)
    standing = jnp.concatenate([p.first.C, p.turns / jnp.where(stand > 0, stand, 1.0)[:, None]], -1)

    def in_turn(a, b):
        return jnp.stack([a, b], 1).reshape(2 * n, *a.shape[1:])

    before = jnp.concatenate([jnp.zeros_like(p.first.q[:1]), p.last.q[:-1]])
    before = before.at[0].set(p.first.q[0].at[model.robot.layout.steerings].add(-p.turns[0]))
    v = p.first.nu * speed[:-1, None]
    q = jnp.concatenate([in_turn(before, p.first.q), p.last.q[-1:]])
    v = jnp.concatenate([in_turn(v, v), p.last.nu[-1:] * speed[-1]])
    ts = jnp.concatenate([jnp.zeros(1, x.dtype), jnp.cumsum(in_turn(stand, drive))])
    return Timed(ts, q, v, in_turn(standing, driving))


_program = compiled(_time_scaling)
