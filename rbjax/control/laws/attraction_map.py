"""Map of a region of attraction: the initial states that return to an equilibrium under feedback.

x' = f(x, pi(t, x)),   x(0) = x* (+) (a e_i + b e_j),   back if |x(T) (-) x*| <= tolerance
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import flag, instance, integer, real_number
from rbjax.display import Display, field_rows, host, shape
from rbjax.dynamics.arguments import check_array, check_model, check_step, check_takes
from rbjax.errors import InputError, UnknownName
from rbjax.kinematics.arguments import check_not_negative, check_several
from rbjax.model import Model, State
from rbjax.model.record import Record
from rbjax.motion.linearise import box_minus, box_plus
from rbjax.motion.rollout import run_rollout
from rbjax.svg import cells

KEPT = 2**23  # maximum number of state entries in memory: 64 MiB in f64

#: maps of more states are not drawn in a notebook
MOST_CELLS = 4_000_000


class RegionMap(Record):
    """A map of a region of attraction, over a grid of initial states.

    x, y: deviations of the initial state along two tangent coordinates, (nx,) and (ny,), SI units.
    back: true if the final state is within the tolerance, (ny, nx).
    distance: largest entry of |x(T) (-) x*|, (ny, nx); infinite if the motion is not finite.
    time: s, after which the motion stays within the tolerance, (ny, nx); nan if back is false.
    names: names of the two coordinates.
    """

    x: jax.Array
    y: jax.Array
    back: jax.Array
    distance: jax.Array
    time: jax.Array
    names: tuple[str, str] = eqx.field(static=True)

    def _display_(self) -> Display:
        back = host(self.back, most=MOST_CELLS)
        size = " x ".join(map(str, reversed(shape(self.back))))
        title = f"RegionMap: {size} initial states"
        title += "" if back is None else f", {back.mean():.0%} return"
        return Display(title, field_rows(self), picture=self._picture)

    def _picture(self) -> str:
        back = host(self.back, most=MOST_CELLS)
        return "" if back is None or back.ndim != 2 else cells(back.T)

    @property
    def share(self) -> jax.Array:
        """Fraction of the initial states that return."""
        return self.back.mean()

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Return (left, right, bottom, top), for `imshow(back, origin="lower", extent=...)`."""
        sides = []
        for x in (np.asarray(self.x), np.asarray(self.y)):
            half = 0.5 * (x[-1] - x[0]) / max(len(x) - 1, 1)
            sides += [float(x[0] - half), float(x[-1] + half)]
        return sides[0], sides[1], sides[2], sides[3]


def region_of_attraction(
    model: Model,
    policy: Callable[[Any, State], jax.Array],
    equilibrium: State,
    axes: Sequence[tuple[str | int, float, float]],
    *,
    points: int | tuple[int, int] = 101,
    duration: float = 5.0,
    dt: float | None = None,
    tolerance: float = 0.05,
    angles: bool = True,
    integrator: Any = None,
    **dynamics: Any,
) -> RegionMap:
    """Simulate a grid of initial states about an equilibrium and map which of them return to it.

    Initial states are x(0) = x* (+) (a e_i + b e_j). The field `back` is true if
    every entry of |x(T) (-) x*| is at most `tolerance`.

    Args:
        model: the robot.
        policy: (t, state) -> (nu,), such as `Solution.policy()`, `Environment.controller(...)` or
            the feedback of an LQR.
        equilibrium: `State`, x*.
        axes: two of (coordinate, low, high), with low and high the interval of deviations. A
            coordinate is an index in (dq, dv), or the name of a joint with one dof: "hinge" for its
            position, "hinge'" for its velocity.
        points: number of points along each axis, or a pair (nx, ny).
        duration: T, s.
        dt: the step, s; the model's timestep if None.
        tolerance: largest entry of |x(T) (-) x*| (m, rad, m/s, rad/s).
        angles: if true, positions of hinges are compared modulo 2 pi.
        integrator: as in `rb.rollout`.
        **dynamics: `dynamics` and `constraints` of `rb.rollout`.

    Returns:
        `RegionMap`.

    Raises:
        InputError: axes that are not two, an empty interval, wrong types.
        UnknownName: no such coordinate.

    Source: Khalil, *Nonlinear Systems*, 8.2.

    Example:
        >>> import jax.numpy as jnp
        >>> import rbjax as rb
        >>> model = rb.load("cart_pole")
        >>> K = jnp.array([[1.0, 30.0, 2.5, 8.0]])
        >>> found = rb.control.region_of_attraction(
        ...     model, lambda t, state: (K * jnp.concatenate([state.q, state.v])).sum(-1),
        ...     model.keyframe("up"), [("hinge", -1.5, 1.5), ("hinge'", -4.0, 4.0)],
        ...     points=5, dt=0.02)
        >>> found.back.shape, bool(found.back[2, 2]), found.names
        ((5, 5), True, ('hinge', "hinge'"))
    """
    where = "region_of_attraction"
    check_model(where, model)
    check_takes(where, "policy", policy, "t", "state")
    instance(where, "equilibrium", equilibrium, State, "an rb.State")
    real_number(where, "tolerance", tolerance, least=0.0, most=1e12, traced=True)
    dtype = equilibrium.q.dtype
    step: Any = check_step(where, "dt", model.timestep if dt is None else dt, dtype)
    angles = flag(where, "angles", angles)
    steps = round(float(check_not_negative(where, "duration", duration, ())) / float(step))
    integer(where, "the number of steps duration / dt", steps, least=1)
    places, names, lines = _axes(where, model, axes, points, dtype)
    nx, ny = (len(line) for line in lines)
    n = 2 * model.nv + model.nx
    plane = jnp.zeros((ny, nx, n), dtype)
    plane = plane.at[..., places[0]].set(lines[0]).at[..., places[1]].set(lines[1][:, None])
    x = equilibrium.x if equilibrium.x is not None else model.start(dtype)
    about = State(equilibrium.q, equilibrium.v, x)
    states = jax.vmap(lambda dx: box_plus(model, about, dx))(plane.reshape(-1, n))
    turns = _turns(model, angles)

    def off(q: jax.Array, v: jax.Array, x: Any) -> jax.Array:
        dx = box_minus(model, about, State(q, v, x))[: 2 * model.nv]
        dq = dx[: model.nv]
        dq = jnp.where(turns, dq - 2 * jnp.pi * jnp.round(dq / (2 * jnp.pi)), dq)
        far = jnp.abs(jnp.concatenate([dq, dx[model.nv :]])).max()
        return jnp.where(jnp.isfinite(far), far, jnp.inf)

    distances = jax.jit(jax.vmap(jax.vmap(off)))
    size = len(states.q) * sum(leaf.shape[-1] for leaf in jax.tree.leaves(states))
    few = max(1, min(steps, KEPT // size))
    after = jnp.zeros(len(states.q), int)  # the first knot after the last one outside
    lost = jnp.zeros(len(states.q), bool)
    begin = 0
    while begin < steps:
        few = min(few, steps - begin)
        t = jnp.asarray(begin, dtype) * step
        part = lambda s, state, t=t: policy(t + s, state)  # noqa: E731
        # unlike `rollout`, `run_rollout` does not warn of motions that are not finite
        run, _, _ = run_rollout(
            model, states, part, step, steps=few, integrator=integrator, **dynamics
        )
        far = distances(run.q, run.v, run.x)
        outside = far > tolerance
        last = begin + few + 1 - jnp.argmax(outside[:, ::-1], 1)
        after = jnp.where(outside.any(1), last, after)
        ends = jax.tree.map(lambda x: x[:, -1], State(run.q, run.v, run.x))
        lost = lost | jnp.isinf(far[:, -1])  # their states are constant from here on
        states = jax.tree.map(
            lambda x, old, gone=lost[:, None]: jnp.where(gone, old, x), ends, states
        )
        begin += few
    distance = jnp.where(lost, jnp.inf, far[:, -1])
    back = distance <= tolerance
    time = jnp.where(back, after * step, jnp.nan)
    shape = (ny, nx)
    return RegionMap(
        lines[0], lines[1], back.reshape(shape), distance.reshape(shape), time.reshape(shape),
        names,
    )  # fmt: skip


def _turns(model: Model, angles: bool) -> jax.Array:
    """Return a mask (nv,) of the coordinates that are angles of hinges."""
    hinges = np.zeros(model.nv, bool)
    if angles:
        for name, kind in zip(model.joint_names, model.topology.joint_kinds, strict=True):
            if kind == "hinge":
                hinges[model.v_slice(name)] = True
    return jnp.asarray(hinges)


def _axes(
    where: str, model: Model, axes: Any, points: Any, dtype: Any
) -> tuple[tuple[int, int], tuple[str, str], tuple[jax.Array, jax.Array]]:
    """Return the tangent-space indices, the names and the values of both axes."""
    axes = check_several(where, "axes", axes, "(coordinate, low, high)")
    if len(axes) != 2 or any(np.ndim(axis) > 1 or len(axis) != 3 for axis in axes):
        raise InputError(
            f"{where}: axes is {axes!r}, expected two of (coordinate, low, high), such as "
            "('hinge', -1.0, 1.0)"
        )
    counts = (points, points) if isinstance(points, int) else points
    counts = check_several(where, "points", counts, "two integers")
    if len(counts) != 2:
        raise InputError(f"{where}: points is {points!r}, expected a number or (nx, ny)")
    places, names, lines = [], [], []
    for (name, low, high), count in zip(axes, counts, strict=True):
        integer(where, "points", count, least=2)
        low, high = (check_array(where, f"an end of axis {name!r}", x, ()) for x in (low, high))
        if not low < high:
            raise InputError(
                f"{where}: the axis {name!r} is from {low} to {high}, expected low < high"
            )
        places.append(_place(where, model, name))
        names.append(str(name))
        lines.append(jnp.linspace(low, high, count, dtype=dtype))
    if places[0] == places[1]:
        raise InputError(f"{where}: both axes are {names[0]!r}, expected two coordinates")
    return (places[0], places[1]), (names[0], names[1]), (lines[0], lines[1])


def _place(where: str, model: Model, name: Any) -> int:
    n = 2 * model.nv
    if not isinstance(name, str):
        integer(where, "a coordinate", name, least=0, most=n - 1)
        return int(name)
    joint, rate = name.removesuffix("'"), name.endswith("'")
    single = [j for j in model.joint_names if model.v_slice(j).stop - model.v_slice(j).start == 1]
    if joint not in single:
        raise UnknownName(f"coordinate of {where}", name, [*single, *(f"{j}'" for j in single)])
    return model.v_slice(joint).start + rate * model.nv
