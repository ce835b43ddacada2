"""Inverse kinematics: the configuration in which frames reach their goals.

    find q:  e(q) = 0,  lower <= q <= upper          (else the q with the least |W e|^2 / 2)

by damped Gauss-Newton steps from many starts (`restarts`). With a posture p, the search ends at the
solution with the least |p - q|^2 / 2 nearby. Derivatives follow from the implicit function theorem,

    J dq = (de/dtheta) dtheta ,      dq of least length,
    or, with a posture,  H dq + J^T dy = dF,  F = (p - q) - J^T y = 0,  H = -dF/dq,

and coordinates at the end of their range stay.
Source: Sugihara 2011; Beeson & Ames, *TRAC-IK*, 2015; Nocedal & Wright, ch. 18.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import flag, integer
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
from rbjax.kinematics.arguments import check_key
from rbjax.kinematics.goals import Goal, body_of, errors
from rbjax.kinematics.joint_ranges import Ranges, random_configurations
from rbjax.kinematics.restarts import Found, Settings, search
from rbjax.lanes import ldlt, matmat, matvec
from rbjax.meshes import automatic
from rbjax.model import Model
from rbjax.model.record import Record
from rbjax.rank_tolerances import rank_tolerance

WHERE = "inverse_kinematics"


class InverseKinematics(Record):
    """The result of `inverse_kinematics`.

    q: (nq,), within the ranges.
    rotation_error, position_error: rad and m, the largest of any goal.
    success: whether both are within the tolerance.
    iterations: of all starts together.
    start: the index of the start that converged (0 is `start`; of searches side by side the first
        starts count first).
    """

    q: jax.Array
    rotation_error: jax.Array
    position_error: jax.Array
    success: jax.Array
    iterations: jax.Array
    start: jax.Array

    def summary(self) -> str:
        """How the search ended: "converged ..." or "closest pose ...". Of a batch, of all."""
        met = np.asarray(self.success)
        rotation, position = np.asarray(self.rotation_error), np.asarray(self.position_error)
        if met.ndim and met.all():
            return f"converged: all {met.size}"
        if met.ndim:
            return (
                f"{int(met.sum())} of {met.size} converged; the worst of the others is "
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
    """The configuration in which a frame, or several, reach a target, within the joint ranges.

    e(q) = 0, lower <= q <= upper, by damped Gauss-Newton steps from up to `seeds` starts.

    It is a function of one target. For a batch use `jax.vmap`, inside of `jax.jit` and with the
    model closed over: each target then is a GPU thread or a lane of machine code. Derivatives by
    target, posture and model are exact for a solution, and zero if the search did not converge.

    Args:
        model: the robot. Free, ball and other joints move on their manifold.
        target: (R (3, 3), p (3,)) or a matrix (4, 4), a pose; (3,) a position; (3, 3) an attitude;
            all in the world. Or a `Goal`, or several in a list, which name their own frames.
        site, body: the name of the frame.
        start: (nq,) the first start; the middle of the ranges if None (of a joint without a range
            the model's reference).
        posture: (nq,), to select the nearest of all solutions.
        seeds: how many starts there are at most; those after the first are random.
        side_by_side: how many searches run in parallel, each a thread or a lane, with the
            starts shared out among them; the one that converges in the fewest steps counts. 8 or
            more suit one target, or a small batch on a GPU, which waits for its last target.
        key: of the random starts; `jax.random.key(0)` if None.
        limits: whether joints keep `model.joints.range`, exactly.
        weights: how much a radian, and a metre, count where not all errors can be zero.
        tolerance: the largest error, rad and m; or a pair of these.
        iterations: how many steps a start has.

    Returns:
        `InverseKinematics`. A target out of reach gives the closest pose found and
        `success` false.

    Raises:
        UnknownName: no such site or body. InputError: no frame, a wrong shape, not a rotation,
        a frame that no joint moves.

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
    check_key(WHERE, key)
    limits = flag(WHERE, "limits", limits)
    args = (model, goals, given["start"], given["posture"], key, weighting, within)
    inside = split_tracers(args)[0] and inside_jit()
    run = _inlined if inside else _program
    how = Settings(iterations, bool(limits))
    return run(*args, searches=(side_by_side, -(-seeds // side_by_side)), how=how)


def _goals(target: Any, site: str | None, body: str | None) -> tuple[Goal, ...]:
    """The goals of a target."""
    several = target if isinstance(target, (list, tuple)) else (target,)
    if several and all(isinstance(g, Goal) for g in several):
        if site is not None or body is not None:
            raise InputError(f"{WHERE}: got site or body with goals, which name their own frames")
        return tuple(several)
    frame = {"site": site, "body": body}
    if (site is None) == (body is None):
        got = "neither" if site is None else "both"
        raise InputError(f"{WHERE}: got {got} of site and body, expected exactly one")
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
    """`InputError` if no joint moves the frame of a goal."""
    top = model.topology
    for goal in goals:
        of = body_of(model, goal)
        if of < 0 or top.body_links[of] < 0:
            name = f"site {goal.site!r}" if goal.body is None else f"body {goal.body!r}"
            raise InputError(f"{where}: no joint moves {name}; expected a frame that one moves")


def _pair(name: str, value: Any, dtype: Any) -> tuple[jax.Array, jax.Array]:
    x = check_array(WHERE, name, value, (), (2,)).astype(dtype)
    if not isinstance(x, jax.core.Tracer) and not (np.asarray(x) > 0).all():
        raise InputError(f"{WHERE}: {name} is {value}, expected numbers above zero")
    return (x, x) if x.ndim == 0 else (x[0], x[1])


@automatic
def _inlined(
    model: Model, goals: tuple[Goal, ...], start: Any, posture: Any, key: Any, weights: Any,
    tolerance: Any, *, searches: tuple[int, int], how: Settings,
) -> InverseKinematics:  # fmt: skip
    """searches: how many run side by side, and the starts of each."""
    dtype, limits, (side, each) = tolerance[0].dtype, how.limits, searches
    if start is None:
        start = _middle(model, dtype) if limits else model.joints.reference.astype(dtype)
    ranges = Ranges(model, dtype, limits)
    start = jnp.stack([jnp.asarray(x, dtype) for x in ranges.within(list(start))])
    others = random_configurations(model, key, side * each - 1, start, limits)
    moving, closed = split_tracers((model, goals, start, others, posture, weights, tolerance))

    def one(start: jax.Array, others: jax.Array, moving: list) -> Found:
        model, goals, _, _, posture, weights, tolerance = closed(moving)
        return search(model, goals, start, others, posture, weights, tolerance, how)

    run = compile_threads(one) if kernels_available() else one

    def found(moving: list) -> Found:
        _, _, start, others, _, weights, _ = closed(moving)
        if side == 1:
            return run(start, others, moving)
        starts = jnp.concatenate([start[None], others]).reshape(side, each, -1)
        return _best(jax.vmap(run, (0, 0, None))(starts[:, 0], starts[:, 1:], moving), weights)

    ruled = jax.custom_jvp(found)

    def rule(primals: tuple, tangents: tuple) -> tuple[Found, Found]:
        out = ruled(*primals)

        def at(moving: list, rate: Any) -> jax.Array:
            model, goals, _, _, posture, _, _ = closed(moving)
            return _configuration_rate(model, goals, posture, limits, out, rate)

        def known(moving: list) -> Any:
            model, goals, _, _, posture, _, _ = closed(moving)
            return _stationarity_conditions(model, goals, posture, out.q)

        _, rate = jax.jvp(known, primals, tangents)
        still = jax.tree.map(_no_tangent, out)
        return out, still._replace(q=at(primals[0], rate))

    ruled.defjvp(rule)
    out = ruled(moving)
    return InverseKinematics(
        out.q, out.rotation, out.position, out.converged, out.iterations, out.start
    )


_program = compiled(_inlined, static_argnames=("searches", "how"))


def _best(found: Found, weights: Any) -> Found:
    """Of searches side by side, the one that converged in the fewest steps, else the nearest."""
    side = found.converged.shape[0]
    off = jnp.hypot(weights[0] * found.rotation, weights[1] * found.position)
    last = jnp.where(jnp.isfinite(off), off, jnp.inf)
    turns = found.iterations.astype(off.dtype)
    first = jnp.where(found.converged, turns - 1 - turns.max(), last)  # those that did are below 0
    i = jnp.argmin(first)
    out = jax.tree.map(lambda x: x[i], found)
    return out._replace(iterations=found.iterations.sum(), start=out.start * side + i)


def _no_tangent(x: jax.Array) -> Any:
    if jnp.issubdtype(x.dtype, jnp.floating):
        return jnp.zeros_like(x)
    return np.zeros(x.shape, jax.dtypes.float0)


def _middle(model: Model, dtype: Any) -> jax.Array:
    """The model's reference, with the middle of the range where a coordinate has one."""
    q = list(model.joints.reference.astype(dtype))
    for at in Ranges(model, dtype).bounded:
        middle = (at.lower + at.upper) / 2
        q[at.q] = jnp.where(jnp.isfinite(middle), middle, q[at.q])
    return jnp.stack(q)


def _stationarity_conditions(model: Model, goals: Any, posture: Any, q: jax.Array) -> Any:
    """The conditions that are zero at a solution q, without multipliers: e, and with a posture
    also the parts s = p - q and J of s - J^T y."""
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
    model: Model, goals: Any, posture: Any, limits: bool, found: Found, rate: Any
) -> jax.Array:
    """The rate of q (nq,) at a solution, from the rates of its conditions at constant q."""
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
    dq = jnp.where(found.converged, dq, 0.0)
    return jax.jvp(lambda u: _retract(model, q, u), (jnp.zeros_like(dq),), (dq,))[1]


def _configuration_rate_with_posture(
    model: Model, goals: Any, posture: jax.Array, q: jax.Array, J: jax.Array, free: jax.Array,
    rate: Any,
) -> jax.Array:  # fmt: skip
    """dq of  H dq + J^T dy = dF,  J dq = de,  for coordinates that are free."""
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
    """1 for each velocity coordinate, and 0 for one that stays at the end of its range: with a
    posture where that lies beyond it."""
    out = [jnp.ones((), q.dtype)] * model.nv
    for at in ranges.bounded:
        x = q[at.q]
        low, high = x <= at.lower, x >= at.upper
        if step is not None:
            low, high = low & (step[at.v] < 0), high & (step[at.v] > 0)
        out[at.v] = jnp.where(low | high, 0.0, 1.0).astype(q.dtype)
    return jnp.stack(out)
