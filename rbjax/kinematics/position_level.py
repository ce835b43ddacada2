"""Inverse kinematics: the configuration in which frames reach their goals.

    find q:  e(q) = 0,  lower <= q <= upper     (if infeasible: minimize |W e|^2 / 2)

by damped Gauss-Newton steps from many starts (`restarts`). With a posture p, the search converges
to a solution with a locally minimal |p - q|^2 / 2. Derivatives follow from the implicit function
theorem,

    J dq = (de/dtheta) dtheta ,      dq of minimum norm,
    or, with a posture,  H dq + J^T dy = dF,  F = (p - q) - J^T y = 0,  H = -dF/dq,

in which coordinates at a bound of their range are constant.
Source: Sugihara 2011; Beeson & Ames, *TRAC-IK*, 2015; Nocedal & Wright, ch. 18.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import check_positive, flag, integer, random_key
from rbjax.compiler import compile_threads, kernels_available
from rbjax.compiling import compiled, inside_jit
from rbjax.dynamics.algorithms.manifold import difference_lanes, integrate_lanes
from rbjax.dynamics.arguments import (
    check_array,
    check_model,
    check_moves,
    check_quaternions,
    shape_of,
)
from rbjax.dynamics.tracing.custom_rules import split_tracers
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_frame
from rbjax.kinematics.goals import Goal, body_of, errors
from rbjax.kinematics.joint_ranges import Ranges, random_configurations
from rbjax.kinematics.restarts import InverseKinematics, search
from rbjax.lanes import ldlt, matmat, matvec
from rbjax.meshes import automatic
from rbjax.model import Model
from rbjax.rank_tolerances import rank_tolerance

WHERE = "inverse_kinematics"


def inverse_kinematics(
    model: Model,
    target: Any,
    *,
    site: str | None = None,
    body: str | None = None,
    start: Any = None,
    posture: Any = None,
    seeds: int = 64,
    side_by_side: int = 1,
    key: Any = None,
    limits: bool = True,
    weights: Any = (0.5, 1.0),
    tolerance: Any = 1e-6,
    iterations: int = 40,
) -> InverseKinematics:
    """Solve e(q) = 0, lower <= q <= upper for the configuration in which frames reach a target.

    It uses damped Gauss-Newton steps from up to `seeds` starts.

    The function solves for one target. For a batch use `jax.vmap` inside `jax.jit`, with the model
    as a closed-over constant: each target is then one GPU thread or one SIMD lane. Derivatives with
    respect to target, posture and model are exact at a solution, and zero if the search did not
    converge.

    Args:
        model: the robot. Free, ball and other joints move on their manifold.
        target: a pose (R (3, 3), p (3,)) or (4, 4), a position (3,) or an attitude (3, 3), in the
            world; or a `Goal`, or a list of Goals, which contain the names of their frames.
        site, body: the name of the frame; give exactly one of the two, and none with Goals.
        start: (nq,) the first start. If None, the middle of the ranges, and the model's reference
            for joints without a range.
        posture: (nq,), a preferred configuration: selects the solution closest to it.
        seeds: maximum number of starts; all after the first are random.
        side_by_side: number of parallel searches, each in a thread or a lane, which share the
            starts. The result is from the search that converged in the fewest steps. Use 8 or more
            for one target, or for a small batch on a GPU.
        key: key of the random starts; `jax.random.key(0)` if None.
        limits: if true, joints stay exactly within `model.joints.range`.
        weights: weights of rotation errors (1/rad) and position errors (1/m).
        tolerance: largest accepted error, rad and m; one number or a pair.
        iterations: maximum number of iterations of each start.

    Returns:
        `InverseKinematics`. For a target out of reach, the closest pose and `success` false.

    Raises:
        UnknownName: no such site or body.
        InputError: no frame, a wrong shape, not a rotation, a frame that no joint moves.

    Source: Sugihara 2011 (damping); Beeson & Ames 2015 (restarts).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("two_link")
        >>> found = rb.control.inverse_kinematics(model, [0.5, 0.0, 0.5], body=model.body_names[-1])
        >>> found.q.shape
        (2,)
    """
    check_model(WHERE, model)
    check_moves(WHERE, model)
    goals = _goals(target, site, body)
    check_frames(WHERE, model, goals)
    if model.constraints:
        raise InputError(
            f"{WHERE}: the model has constraints, which this search does not keep; remove them "
            "with model.replace(constraints=()), or add a goal for each closed loop"
        )
    integer(WHERE, "seeds", seeds, least=1)
    integer(WHERE, "side_by_side", side_by_side, least=1, most=seeds, why=": no more than seeds")
    integer(WHERE, "iterations", iterations, least=1)
    dtype = jnp.result_type(*(x for g in goals for x in g.arrays))
    given = {"start": start, "posture": posture}
    for name, value in given.items():
        if value is not None:
            given[name] = check_array(WHERE, name, value, (model.nq,)).astype(dtype)
            check_quaternions(WHERE, name, model, given[name])
    weighting = _pair("weights", weights, dtype)
    within = _pair("tolerance", tolerance, dtype)
    key = jax.random.key(0) if key is None else key
    random_key(WHERE, key)
    limits = flag(WHERE, "limits", limits)
    args = (model, goals, given["start"], given["posture"], key, weighting, within)
    inside = split_tracers(args)[0] and inside_jit()
    run = _inlined if inside else _program
    searches = (side_by_side, -(-seeds // side_by_side))
    return run(*args, searches=searches, iterations=iterations, limits=bool(limits))


def _goals(target: Any, site: str | None, body: str | None) -> tuple[Goal, ...]:
    """Convert the target argument to a tuple of Goals."""
    several = target if isinstance(target, (list, tuple)) else (target,)
    if several and all(isinstance(g, Goal) for g in several):
        if site is not None or body is not None:
            raise InputError(f"{WHERE}: got site or body with goals, which name their own frames")
        return tuple(several)
    frame = {"site": site, "body": body}
    check_frame(WHERE, site, body)
    if isinstance(target, tuple) and len(target) == 2:
        return (Goal(rotation=target[0], position=target[1], **frame),)
    shape = shape_of(WHERE, "target", target)
    known = {(3,): "position", (3, 3): "rotation"}
    if shape == (4, 4):
        pose = check_array(WHERE, "target", target, (4, 4))
        return (Goal(rotation=pose[:3, :3], position=pose[:3, 3], **frame),)
    if shape not in known:
        raise InputError(
            f"{WHERE}: target has shape {shape}, expected a pair (R (3, 3), p (3,)), or one of "
            "(3,) a position, (3, 3) an attitude, (4, 4) a pose; or a Goal, or a list of Goals"
        )
    return (Goal(**{known[shape]: target}, **frame),)


def check_frames(where: str, model: Model, goals: Sequence[Goal]) -> None:
    """Raise InputError if no joint moves the frame of a goal."""
    top = model.topology
    for goal in goals:
        of = body_of(model, goal)
        if of < 0 or top.body_links[of] < 0:
            name = f"site {goal.site!r}" if goal.body is None else f"body {goal.body!r}"
            raise InputError(f"{where}: no joint moves {name}; expected a frame that one moves")


def _pair(name: str, value: Any, dtype: Any) -> tuple[jax.Array, jax.Array]:
    x = check_array(WHERE, name, value, (), (2,)).astype(dtype)
    check_positive(WHERE, **{name: x})
    return (x, x) if x.ndim == 0 else (x[0], x[1])


@automatic
def _inlined(
    model: Model, goals: tuple[Goal, ...], start: Any, posture: Any, key: Any, weights: Any,
    tolerance: Any, *, searches: tuple[int, int], iterations: int, limits: bool,
) -> InverseKinematics:  # fmt: skip
    """Search as compiled code. searches: number of parallel searches, and starts of each."""
    dtype, (side, each) = tolerance[0].dtype, searches
    if start is None:
        start = _middle(model, dtype) if limits else model.joints.reference.astype(dtype)
    ranges = Ranges(model, dtype, limits)
    start = jnp.stack([jnp.asarray(x, dtype) for x in ranges.within(list(start))])
    others = random_configurations(model, key, side * each - 1, start, limits)
    moving, closed = split_tracers((model, goals, start, others, posture, weights, tolerance))

    def one(start: jax.Array, others: jax.Array, moving: list) -> InverseKinematics:
        model, goals, _, _, posture, weights, tolerance = closed(moving)
        args = (model, goals, start, others, posture, weights, tolerance)
        return search(*args, iterations=iterations, limits=limits)

    run = compile_threads(one) if kernels_available() else one

    def found(moving: list) -> InverseKinematics:
        _, _, start, others, _, weights, _ = closed(moving)
        if side == 1:
            return run(start, others, moving)
        starts = jnp.concatenate([start[None], others]).reshape(side, each, -1)
        return _best(jax.vmap(run, (0, 0, None))(starts[:, 0], starts[:, 1:], moving), weights)

    ruled = jax.custom_jvp(found)

    def rule(primals: tuple, tangents: tuple) -> tuple[InverseKinematics, InverseKinematics]:
        out = ruled(*primals)

        def at(moving: list, rate: Any) -> jax.Array:
            model, goals, _, _, posture, _, _ = closed(moving)
            return _configuration_rate(model, goals, posture, limits, out, rate)

        def known(moving: list) -> Any:
            model, goals, _, _, posture, _, _ = closed(moving)
            return _stationarity_conditions(model, goals, posture, out.q)

        _, rate = jax.jvp(known, primals, tangents)
        still = jax.tree.map(_no_tangent, out)
        return out, dataclasses.replace(still, q=at(primals[0], rate))

    ruled.defjvp(rule)
    return ruled(moving)


_program = compiled(_inlined, static_argnames=("searches", "iterations", "limits"))


def _best(found: InverseKinematics, weights: Any) -> InverseKinematics:
    """Return the result of the search that converged in the fewest steps, or else of the least
    error."""
    side = found.success.shape[0]
    off = jnp.hypot(weights[0] * found.rotation_error, weights[1] * found.position_error)
    last = jnp.where(jnp.isfinite(off), off, jnp.inf)
    turns = found.iterations.astype(off.dtype)
    first = jnp.where(found.success, turns - 1 - turns.max(), last)  # converged ones are negative
    i = jnp.argmin(first)
    out = jax.tree.map(lambda x: x[i], found)
    start = out.start * side + i
    return dataclasses.replace(out, iterations=found.iterations.sum(), start=start)


def _no_tangent(x: jax.Array) -> Any:
    if jnp.issubdtype(x.dtype, jnp.floating):
        return jnp.zeros_like(x)
    return np.zeros(x.shape, jax.dtypes.float0)


def _middle(model: Model, dtype: Any) -> jax.Array:
    """Return the model's reference, with bounded coordinates at the middle of their range."""
    q = list(model.joints.reference.astype(dtype))
    for at in Ranges(model, dtype).bounded:
        middle = (at.lower + at.upper) / 2
        q[at.q] = jnp.where(jnp.isfinite(middle), middle, q[at.q])
    return jnp.stack(q)


def _stationarity_conditions(model: Model, goals: Any, posture: Any, q: jax.Array) -> Any:
    """Return the residuals at a solution q: the errors e, or with a posture (e, p - q, J).

    They are zero, or (p - q) - J^T y = 0 for some multipliers y, which are not returned.
    """
    e, J = errors(model, goals, q)
    if posture is None:
        return e
    return e, _posture_step(model, q, posture), J


def _posture_step(model: Model, q: jax.Array, posture: jax.Array) -> jax.Array:
    lanes = difference_lanes(model.topology, list(q), list(posture))
    return jnp.stack([jnp.asarray(x, q.dtype) for x in lanes])


def _retract(model: Model, q: jax.Array, u: jax.Array) -> jax.Array:
    return jnp.stack(integrate_lanes(model.topology, list(q), list(u)))


def _configuration_rate(
    model: Model, goals: Any, posture: Any, limits: bool, found: InverseKinematics, rate: Any
) -> jax.Array:
    """Compute the derivative dq/dtheta (nq,) of the solution by the implicit function theorem.

    rate: derivative of `_stationarity_conditions` by theta at constant q.
    """
    q = found.q
    _, J = errors(model, goals, q)
    ranges = Ranges(model, q.dtype, limits)
    free = _free(model, ranges, q, None if posture is None else _posture_step(model, q, posture))
    if posture is None:
        J = J * free
        rows = [list(r) for r in matmat(J, J.T)]
        least = rank_tolerance("goals", q.dtype)
        y = jnp.stack(ldlt(rows, least=least).solve(list(rate)))
        dq = matvec(J.T, y)
    else:
        dq = _configuration_rate_with_posture(model, goals, posture, q, J, free, rate)
    dq = jnp.where(found.success, dq, 0.0)
    return jax.jvp(lambda u: _retract(model, q, u), (jnp.zeros_like(dq),), (dq,))[1]


def _configuration_rate_with_posture(
    model: Model, goals: Any, posture: jax.Array, q: jax.Array, J: jax.Array, free: jax.Array,
    rate: Any,
) -> jax.Array:  # fmt: skip
    """Compute dq (nv,) of the free coordinates from the optimality conditions with a posture.

        H dq + J^T dy = dF,     J dq = de,     F = (p - q) - J^T y,     H = -dF/dq
    free: mask (nv,), 0 for coordinates at a bound. rate: derivatives (de, d(p - q), dJ) at constant
        q.
    """
    de, ds, dJ = rate
    n, m = J.shape[1], J.shape[0]
    J = J * free
    square = matmat(J, J.T)
    least = 8 * jnp.finfo(q.dtype).eps * jnp.trace(square)
    rows = [list(r) for r in square + least * jnp.eye(m, dtype=q.dtype)]
    y = jnp.stack(ldlt(rows).solve(list(matvec(J, _posture_step(model, q, posture)))))

    def F(u: jax.Array) -> jax.Array:
        there = _retract(model, q, u)
        return _posture_step(model, there, posture) - matvec(errors(model, goals, there)[1].T, y)

    H = -jax.jacfwd(F)(jnp.zeros(n, q.dtype))
    both = free[:, None] * free[None, :]
    H = H * both + jnp.diag(1 - free)
    corner = -least * jnp.eye(m, dtype=q.dtype)
    system = jnp.block([[H, J.T], [J, corner]])
    dF = free * (ds - matvec(dJ.T, y))
    return jnp.linalg.solve(system, jnp.concatenate([dF, de]))[:n]


def _free(model: Model, ranges: Ranges, q: jax.Array, step: jax.Array | None) -> jax.Array:
    """Return a mask (nv,): 0 for coordinates that stay at a bound, 1 for the free ones. step
    (nv,) is the step to the preferred posture. With it, a coordinate stays at its bound only if the
    step leaves the range."""
    out = [jnp.ones((), q.dtype)] * model.nv
    for at in ranges.bounded:
        x = q[at.q]
        low, high = x <= at.lower, x >= at.upper
        if step is not None:
            low, high = low & (step[at.v] < 0), high & (step[at.v] > 0)
        out[at.v] = jnp.where(low | high, 0.0, 1.0).astype(q.dtype)
    return jnp.stack(out)
