"""Time-optimal motions near a path, by gradients through the dynamics.

The fastest motion along the path (`time_scaling`) is the first guess. Its controls and durations
are resampled to intervals and improved iteratively (`shooting`), so the motion may leave the path.
Then it is replayed in finer steps to compute the residuals: distance to the goal, clearance,
limits.

Source: Betts, *Practical Methods for Optimal Control and Estimation*, ch. 4; Fletcher, *Practical
Methods of Optimization*, 14.4.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import instance, integer
from rbjax.compiling import alone, compiled
from rbjax.errors import InputError
from rbjax.lanes.arrays import largest, smallest
from rbjax.model.record import Record, cast_floats
from rbjax.planning.maps.footprint import Footprint, disc_centers
from rbjax.planning.maps.occupancy import DistanceField
from rbjax.planning.paths.path import Path
from rbjax.planning.timing.driven_path import reach_of
from rbjax.planning.timing.limits import Limits, Timed, check_can_follow
from rbjax.planning.timing.shooting import Shooting, optimise
from rbjax.planning.timing.time_scaling import check_path, time_scaling
from rbjax.wheeled import RobotModel
from rbjax.wheeled.models.robot_model import start

NEAR = 2e-3  # tolerance of a feasible motion: m, rad, and relative to limits
FINER = 4  # steps of the replay for each step of the search
PLAIN = 0.05  # rad, the least steering limit if none is given


class Residuals(Record):
    """The residuals of a motion, replayed with steps a quarter as long.

    Fields, each ():
        distance: from the end to the goal, m.
        turn: the heading error at the end, rad.
        speed: at the end, relative to the mean speed of the motion along the path.
        torque: the largest torque relative to its limit.
        rate: the largest speed or turning rate relative to its limit.
        angle: the largest steering angle relative to its limit.
        clearance: the smallest, m; infinite without a map.
        free: whether all poses are certainly free of obstacles.
        defect: the distance between the ends of the replay and of the coarser steps, m.
    """

    distance: jax.Array
    turn: jax.Array
    speed: jax.Array
    torque: jax.Array
    rate: jax.Array
    angle: jax.Array
    clearance: jax.Array
    free: jax.Array
    defect: jax.Array

    @property
    def feasible(self) -> jax.Array:
        """Boolean (...): goal within 2 mm and 2 mrad, limits within 0.2 %, no collision."""
        off = jnp.stack([self.distance, self.turn, self.speed])
        most = jnp.stack([self.torque, self.rate, self.angle])
        return (off <= NEAR).all(0) & (most <= 1 + NEAR).all(0) & self.free


class Refined(Record):
    """A motion that may leave its path to be faster than any motion along it.

    Fields:
        motion: a `Timed`.
        residuals: its `Residuals`.
        start_time: (), the duration of the fastest motion along the path, s.
        steps_taken: (), the number of accepted steps.
        success: (), whether a motion along the path exists.
    """

    motion: Timed
    residuals: Residuals
    start_time: jax.Array
    steps_taken: jax.Array
    success: jax.Array

    @property
    def status(self) -> str:
        """Status of one motion: "refined", "as it was", "not converged" or "infeasible".

        "refined" is feasible and faster than `start_time`; "as it was" is feasible, but not faster.
        After "not converged", see the residuals. "infeasible" means that the limits do not hold on
        the path.
        """
        if not bool(self.success):
            return "infeasible"
        rounding = 64 * float(jnp.finfo(self.motion.time.dtype).eps)
        change = float(self.motion.time) / float(self.start_time) - 1
        if not bool(self.residuals.feasible) or not change <= max(1e-6, rounding):
            return "not converged"
        faster = change < -max(1e-9, rounding)  # not only by rounding
        return "refined" if int(self.steps_taken) and faster else "as it was"


def refine(
    model: RobotModel,
    path: Path,
    limits: Limits,
    field: DistanceField | None = None,
    footprint: Footprint | None = None,
    *,
    margin: Any = None,
    intervals: int = 60,
    iterations: int = 40,
    parts: int = 2,
) -> Refined:
    """Find a faster motion between the ends of a path, which may leave the path.

    It keeps the limits and has no collision.

    The first guess is `time_scaling`. Then controls and durations change by gradients through the
    robot's dynamics. The motion may leave the path: it cuts corners if the map allows it, and may
    reverse elsewhere. The result is a local optimum near the path, or an earlier iterate.

    The time has derivatives by limits and by parameters of the robot, in forward mode.

    Args:
        model: a model of a rolling robot with torque sources, `wheeled.at(robot, "reduced")`.
            It starts at rest, with steerings and trailers straight, and ends at rest.
        path: one `Path` of the chassis in short steps, as from `Path.split` or `smooth`. Its end is
            the goal. Use `jax.vmap` for many.
        limits: `Limits`.
        field: `OccupancyGrid.distance_field()`; None for no obstacles.
        footprint: of the chassis. Trailers are not checked for collisions.
        margin: the required clearance, m; None for one cell. If the motion along the path has less
            clearance, only that is required.
        intervals: the number of intervals of constant controls.
        iterations: the number of steps to try.
        parts: Runge-Kutta steps of an interval. A robot with casters needs about 10, because a
            caster turns within its trail. `residuals.defect` is the integration error.

    Returns:
        `Refined`, with a motion of `intervals` intervals. Replay `motion.sampled(steps)` by
        `wheeled.rollout`. Torques and steering rates are within their limits exactly, all other
        limits up to `Refined.residuals`.

    Raises:
        InputError: wrong types, a batch, a robot whose drives give no torques for a path.

    Source: Fletcher, *Practical Methods of Optimization*, 14.4.

    Example:
        >>> import rbjax as rb
        >>> robot = rb.wheeled.kinds()["differential_drive"].make(caster=None)
        >>> cart = rb.wheeled.at(robot, "reduced")
        >>> corner = Path([0.0, 0.0, 0.0], [[1.0, 0, 0], [0, 0, 1.5], [1.0, 0, 0]]).split(0.1)
        >>> quick = refine(cart, corner, Limits(torque=0.4, speed=1.0), intervals=20, iterations=9)
        >>> quick.status, bool(quick.motion.time < 0.6 * quick.start_time)
        ('refined', True)
    """
    check_can_follow("refine", model, limits)
    check_path("refine", path)
    if (field is None) != (footprint is None):
        raise InputError("refine: got only one of field and footprint, expected both or none")
    for name, x, kind in (("field", field, DistanceField), ("footprint", footprint, Footprint)):
        instance("refine", name, x, kind | None, f"rb.planning.{kind.__name__}")
    counts = {"intervals": intervals, "iterations": iterations, "parts": parts}
    for name, n in counts.items():
        integer("refine", name, n, least=1)
    if margin is None and field is not None:
        margin = field.resolution
    run = _program if alone() else _refine
    return run(model, path, limits, field, footprint, margin, **counts)


def _refine(
    model: RobotModel, path: Path, limits: Limits, field: DistanceField | None,
    footprint: Footprint | None, margin: Any, intervals: int, iterations: int, parts: int,
) -> Refined:  # fmt: skip
    # the first guess may exceed the steering limit
    first = time_scaling(model, path, limits.replace(steering=jnp.inf))
    motion = first.motion
    dtype = motion.ts.dtype
    model, path, limits, field, footprint, margin = cast_floats(
        (model, path, limits, field, footprint, margin), dtype
    )
    robot = model.robot
    steers = jnp.full(len(robot.steerings), limits.steering_rate)
    units = jnp.concatenate([limits.torques(model), steers]).astype(dtype)
    bent = jnp.abs(motion.q[:, robot.layout.steerings]).ravel()
    widest = largest(jnp.append(bent, PLAIN))
    limits = limits.replace(steering=jnp.where(jnp.isinf(limits.steering), widest, limits.steering))
    controls, dt = motion.sampled(intervals)
    bare = start(model, path.start)
    begin = jnp.concatenate([bare.q[: robot.layout.casters.stop], bare.v]).astype(dtype)
    reach = reach_of(model, dtype)
    ways = jnp.abs(path.steps)
    length = (ways[:, :2].sum(-1) + reach * ways[:, 2]).sum().astype(dtype)
    s = Shooting(
        model, limits, units, dt, length, reach,
        _speed_units(model.nv, length / motion.time, reach),
        begin, path.poses[-1].astype(dtype), field, footprint,
        jnp.zeros((intervals * parts, 0), dtype), parts,
    )  # fmt: skip
    w = jnp.column_stack([controls / units, jnp.ones(intervals, dtype)])
    w = jnp.clip(w, -1.0, 1.0)  # rounding
    if field is not None:
        sure = field.resolution / math.sqrt(2)
        flat = s.states(w).reshape(intervals * parts, -1)
        due = jnp.clip(jax.vmap(s.clearances)(flat), sure, jnp.maximum(margin, sure))
        s = s._replace(due=due)
    found = optimise(s, w, iterations)
    z = jnp.concatenate([s.start[None], s.states(found.w)[:, -1]])
    return Refined(
        _as_motion(s, found.w, z),
        _residuals(s, found.w, z[-1]),
        motion.time,
        found.taken,
        first.success,
    )


def _speed_units(nv: int, speed: jax.Array, reach: jax.Array) -> jax.Array:
    """Return units (nv,) of the free velocities. The last of several is a turning rate."""
    units = jnp.full(nv, speed)
    return units.at[-1].divide(reach) if nv > 1 else units


def _as_motion(s: Shooting, w: jax.Array, z: jax.Array) -> Timed:
    states = jax.vmap(s.state)(z)
    ts = jnp.concatenate([jnp.zeros(1, w.dtype), jnp.cumsum(w[:, -1] * s.duration)])
    return Timed(ts, states.q, states.v, w[:, :-1] * s.units)


def _residuals(s: Shooting, w: jax.Array, coarse: jax.Array) -> Residuals:
    """Compute the residuals of a replay. coarse: the last state, in the steps of the search."""
    z = s._replace(parts=FINER * s.parts).states(w)
    z = z.reshape(-1, z.shape[-1])
    end = z[-1]
    off = end[:3] - s.goal
    none = jnp.zeros((len(z), 0), w.dtype)
    over = 1 + jax.vmap(s._replace(field=None).below)(z, none)
    steerings = len(s.model.robot.steerings)
    angles = over[:, 1 : 1 + steerings]
    rates = jnp.concatenate([over[:, :1], over[:, 1 + steerings : 2 + steerings]], -1)
    drives = len(s.model.robot.drives)
    clearance, free = jnp.full((), jnp.inf, w.dtype), jnp.ones((), bool)
    if s.field is not None and s.footprint is not None:
        clearance = jax.vmap(s.clearances)(z)
        sure = clearance - s.field.resolution / math.sqrt(2)
        below = s.field.below(disc_centers(z[:, :3], s.footprint)) - s.footprint.radii
        clearance, free = smallest(clearance), (jnp.maximum(sure, below) > 0).all()

    def worst(x: jax.Array) -> jax.Array:
        return largest(jnp.append(jnp.abs(x), jnp.zeros((), x.dtype)))

    return Residuals(
        jnp.hypot(off[0], off[1]), jnp.abs(off[2]), worst(end[s.tracked :] / s.speeds),
        worst(w[:, :drives]), worst(rates), worst(angles), clearance, free,
        worst(end[:2] - coarse[:2]),
    )  # fmt: skip


_program = compiled(_refine, static_argnames=("intervals", "iterations", "parts"))
