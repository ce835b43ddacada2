"""Simulation of wheeled robots: fixed steps of one or of many, and adaptive solvers."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import choice, integer
from rbjax.compiler import compile_threads, kernels_available
from rbjax.compiling import compiled, inside_jit
from rbjax.dynamics.arguments import check_array, check_step, check_takes, shape_of
from rbjax.dynamics.tracing.custom_rules import split_tracers
from rbjax.lanes import Lane, add, fusion_barrier, mul
from rbjax.model import State
from rbjax.motion.closures.captured import with_captured
from rbjax.motion.trajectory import (
    Trajectory,
    all_finite,
    check_save_every,
    check_times,
    scan_steps,
)
from rbjax.wheeled.kinematics.context import RobotContext
from rbjax.wheeled.kinematics.parameters import Parameters
from rbjax.wheeled.models.robot_model import RobotModel, as_state, check_robot_model, check_state

Lists = tuple[list[Lane], list[Lane], list[Lane]]


class _Steps(NamedTuple):
    """The options of a rollout that are compile-time constants."""

    integrator: str
    steps: int
    save_every: int


def _plus(a: Sequence[Lane], b: Sequence[Lane], h: Lane) -> list[Lane]:
    return [add(x, mul(h, y)) for x, y in zip(a, b, strict=True)]


def _semi_implicit_euler(
    model: RobotModel, p: Parameters, y: Lists, u: list[Lane], h: Lane
) -> Lists:
    """Step by v+ = v + h v'(q, v),  q+ = q + h q'(q, v+)."""
    q, v, x = y
    context = RobotContext(p, q, v, x, u)
    v = _plus(v, model.accelerations(context), h)
    x = _plus(x, model.tyre_rates(context), h)
    return _plus(q, model.coordinate_rates(context.with_velocities(v, x)), h), v, x


def _linearly_implicit_euler(
    model: RobotModel, p: Parameters, y: Lists, u: list[Lane], h: Lane
) -> Lists:
    """Step by v+ = v + h v'(q, v, v+),  x+ = x + h x'(q, v+),  q+ = q + h q'(q, v+)."""
    q, v, x = y
    context = RobotContext(p, q, v, x, u)
    then = context.with_velocities(_plus(v, model.damped_accelerations(context, h), h), x)
    x = _plus(x, model.tyre_rates(then), h)
    return _plus(q, model.coordinate_rates(then), h), then.v, x


def _rk4(model: RobotModel, p: Parameters, y: Lists, u: list[Lane], h: Lane) -> Lists:
    def rates(k: Lists | None, c: float) -> Lists:
        q, v, x = y if k is None else (_plus(a, b, c * h) for a, b in zip(y, k, strict=True))
        # without a barrier XLA's CPU compiler recomputes a stage for each use
        return fusion_barrier(model.rates(RobotContext(p, q, v, x, u)))

    k1 = rates(None, 0.0)
    k2 = rates(k1, 0.5)
    k3 = rates(k2, 0.5)
    k4 = rates(k3, 1.0)
    q, v, x = (
        [a + h / 6 * (b + 2 * (c + d) + e) for a, b, c, d, e in zip(*parts, strict=True)]
        for parts in zip(y, k1, k2, k3, k4, strict=True)
    )
    return q, v, x


INTEGRATORS: dict[str, Callable[..., Lists]] = {
    "semi_implicit_euler": _semi_implicit_euler,
    "linearly_implicit_euler": _linearly_implicit_euler,
    "rk4": _rk4,
}


def advance(
    model: RobotModel, p: Parameters, y: Lists, u: list[Lane], h: Lane, integrator: str
) -> Lists:
    """Integrate one step. Return the coordinates, projected velocities and tyre states."""
    q, v, x = INTEGRATORS[integrator](model, p, y, u, h)
    v = model.project(RobotContext(p, q, v, x, u))
    q, v, x = ([jnp.asarray(a, p.dtype) for a in part] for part in (q, v, x))
    return q, v, x


def rollout(
    model: RobotModel,
    state: State,
    ctrl: Any,
    dt: Any,
    *,
    integrator: str = "rk4",
    steps: int | None = None,
    save_every: int = 1,
) -> Trajectory:
    """Simulate one wheeled robot or a batch of states by fixed steps.

    "rk4": order 4, four evaluations. "semi_implicit_euler": order 1, one evaluation; velocities
    first, then coordinates with the new velocities. "linearly_implicit_euler": order 1, with the
    sliding of contacts and the speeds of motors at the end of the step, as linear dampers with
    their secants. It is stable for light wheels, stiff tyres and low speeds. Controls are constant
    over a step.

    A sample is a thread on a GPU, and a lane of machine code on a CPU. Parameters of the robot can
    change without recompilation. If the robot is closed over inside `jit`, its zeros are removed
    from the program.

    Args:
        model: `at(robot, fidelity)`.
        state: q (nq,), v (nv,), x (nx,); or a batch with a leading axis.
        ctrl: (steps, nu), or (B, steps, nu) for a batch; or a function (t, state) -> (nu,), which
            requires `steps`.
        dt: the step, s.
        integrator: "rk4", "semi_implicit_euler" or "linearly_implicit_euler".
        steps: the number of steps, if `ctrl` is a function.
        save_every: the number of steps between saved states; it must divide the number of steps.

    Returns:
        `Trajectory` of 1 + steps / save_every states, the first the initial one. `success` is
        true if all values are finite.

    Raises:
        InputError: wrong types or shapes, values that are not finite, a step that is not positive.
        UnknownName: no such integrator.

    Source: Hairer, Norsett & Wanner, *Solving Ordinary Differential Equations I*, II.1; Hairer &
    Wanner, *II*, IV.9, of linearly implicit methods.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax import wheeled
        >>> cart = wheeled.at(wheeled.kinds()["differential_drive"].make(), "reduced")
        >>> wheeled.rollout(cart, wheeled.start(cart), jnp.full((10, 2), 0.1), 0.01).q.shape
        (11, 7)
    """
    check_robot_model("rollout", model)
    choice("integrator", integrator, INTEGRATORS)
    shape = shape_of("rollout", "state.q", getattr(state, "q", 0.0))
    batch = shape[:1] if len(shape) == 2 else ()
    state = check_state("rollout", model, state, batch)
    dt = check_step("rollout", "dt", dt, state.q.dtype)
    if callable(ctrl):
        check_takes("rollout", "ctrl", ctrl, "t", "state")
    else:
        found = shape_of("rollout", "ctrl", ctrl)
        count = found[-2] if steps is None and len(found) > 1 else steps
        due = [(*lead, count or 1, model.nu) for lead in dict.fromkeys([(), batch])]
        ctrl = check_array("rollout", "ctrl", ctrl, *due).astype(state.q.dtype)
        steps = ctrl.shape[-2]
    steps = integer("rollout", "steps", steps, least=1)
    save_every = check_save_every("rollout", save_every, steps)
    how = _Steps(integrator, steps, save_every)
    run = _run if inside_jit() else _compiled
    if callable(ctrl):
        states = with_captured(lambda f: run(model, state, f, dt, how), ctrl)
    else:
        states = run(model, state, ctrl, dt, how)
    ts = dt * jnp.arange(0, steps + 1, save_every, dtype=state.q.dtype)
    return Trajectory(
        ts, states.q, states.v, all_finite(states), stats={"steps": steps}, x=states.x
    )


def _run(model: RobotModel, state: State, ctrl: Any, dt: Any, how: _Steps) -> State:
    """Compute the states of one sample or of a batch."""
    rows = None if callable(ctrl) else ctrl
    shared, closed = split_tracers((model, ctrl if rows is None else None, dt))
    own, tree = jax.tree.flatten((state, rows))

    def sample(args: list) -> State:
        state, rows = jax.tree.unflatten(tree, args[: len(own)])
        model, f, dt = closed(args[len(own) :])
        return _states(model, state, f if rows is None else rows, dt, how)

    run = compile_threads(sample) if kernels_available() else sample
    if state.q.ndim == 1:
        return run([*own, *shared])
    each = None if rows is None or rows.ndim < 3 else 0
    axes = [0] * len(jax.tree.leaves(state)) + [each] * (rows is not None)
    return jax.vmap(lambda *xs: run([*xs, *shared]), axes)(*own)


_compiled = compiled(_run, jit=eqx.filter_jit)


def _states(model: RobotModel, state: State, ctrl: Any, dt: Any, how: _Steps) -> State:
    """Compute the states (T, nq), (T, nv), (T, nx) of one sample."""
    context = model.context(state)
    dtype = state.q.dtype

    def step(y: Lists, i: Any) -> Lists:
        u = ctrl(i * dt, as_state(*y, dtype)) if callable(ctrl) else ctrl[i]
        u = jnp.asarray(u, dtype)
        given = [u[k] for k in range(model.nu)]
        return advance(model, context.n, y, given, dt, how.integrator)

    begin = (context.q, context.v, context.x)
    path = scan_steps(step, begin, how.steps, how.save_every)

    def table(first: list[Lane], later: list[Lane]) -> jax.Array:
        if not first:
            return jnp.zeros((how.steps // how.save_every + 1, 0), dtype)
        return jnp.concatenate([jnp.stack(first)[None], jnp.stack(later, -1)])

    q, v, x = (table(a, b) for a, b in zip(begin, path, strict=True))
    return State(q, v, x if model.nx else None)


def simulate(
    model: RobotModel,
    state: State,
    ts: Any,
    ctrl: Any = None,
    *,
    solver: Any = None,
    tolerance: float | None = None,
    adjoint: Any = None,
    max_steps: int = 100_000,
) -> Trajectory:
    """Simulate a wheeled robot from ts[0] to ts[-1] by an adaptive solver of diffrax.

    Args:
        model: `at(robot, fidelity)`.
        state: q (nq,), v (nv,), x (nx,).
        ts: (T,), increasing, s.
        ctrl: (nu,), constant; or a function (t, state) -> (nu,); None for zeros.
        solver: a diffrax solver, such as one of `rb.solvers`; Dopri8 if None.
        tolerance: relative and absolute; 1e-10 in f64 and 1e-5 in f32 if None.
        adjoint: an adjoint of diffrax; None for its default, for reverse mode.
        max_steps: the largest number of steps.

    Returns:
        `Trajectory` at ts. `success` is true if the solver succeeded and all values are finite.

    Raises:
        InputError: wrong types or shapes, values that are not finite, times that do not increase.

    Source: Kidger, *On Neural Differential Equations*, 2021 (diffrax).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax import wheeled
        >>> cart = wheeled.at(wheeled.kinds()["differential_drive"].make(), "reduced")
        >>> wheeled.simulate(cart, wheeled.start(cart), jnp.array([0.0, 1.0]), [0.1, 0.1]).v.shape
        (2, 2)
    """
    check_robot_model("simulate", model)
    state = check_state("simulate", model, state)
    dtype = state.q.dtype
    ts, elapsed = check_times("simulate", ts, dtype)
    if callable(ctrl):
        check_takes("simulate", "ctrl", ctrl, "t", "state")
    else:
        given = jnp.zeros(model.nu) if ctrl is None else ctrl
        ctrl = check_array("simulate", "ctrl", given, (model.nu,)).astype(dtype)
    if max_steps is not None:
        integer("simulate", "max_steps", max_steps, least=1)
    if tolerance is None:
        tolerance = 1e-10 if dtype == jnp.float64 else 1e-5
    solve = functools.partial(
        _diffeqsolve, diffrax.ODETerm(_Field(ts[0])), solver or diffrax.Dopri8(), elapsed[0],
        elapsed[-1], None, state, saveat=diffrax.SaveAt(ts=elapsed), throw=False,
        adjoint=adjoint or diffrax.RecursiveCheckpointAdjoint(), max_steps=max_steps,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
    )  # fmt: skip
    if callable(ctrl):
        out = with_captured(lambda f: solve((model, f)), ctrl)
    else:
        out = solve((model, ctrl))
    path = out.ys
    ok = all_finite(path) & (out.result == diffrax.RESULTS.successful)
    return Trajectory(ts, path.q, path.v, ok, out.result, out.stats, path.x)


_diffeqsolve = compiled(diffrax.diffeqsolve, jit=eqx.filter_jit)


class _Field(eqx.Module):
    """The vector field of diffrax: the rate of a state at the time since the start."""

    start: jax.Array

    def __call__(self, t: Any, state: State, args: Any) -> State:
        model, ctrl = args
        u = ctrl(self.start + t, state) if callable(ctrl) else ctrl
        context = model.context(state, jnp.asarray(u, state.q.dtype))
        q, v, x = model.rates(context)
        return as_state(q, v, x, state.q.dtype)
