"""Motion of a vehicle: fixed steps of one or of many, and adaptive solutions.

A vehicle is a robot at a fidelity (`at`). Both functions take controls as numbers or as a function
of the time and the state, and return a `Trajectory`.
"""

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
from rbjax.errors import InputError
from rbjax.lanes import Lane, add, fusion_barrier, mul
from rbjax.model import State
from rbjax.motion.closures.captured import with_captured
from rbjax.motion.trajectory import Trajectory, all_finite
from rbjax.wheeled.kinematics.context import RobotContext
from rbjax.wheeled.kinematics.parameters import Parameters
from rbjax.wheeled.models.robot_model import RobotModel, as_state
from rbjax.wheeled.models.states import check_state, check_vehicle

Lists = tuple[list[Lane], list[Lane], list[Lane]]


class _How(NamedTuple):
    """What is static of a rollout."""

    method: str
    steps: int
    save_every: int


def _plus(a: Sequence[Lane], b: Sequence[Lane], h: Lane) -> list[Lane]:
    return [add(x, mul(h, y)) for x, y in zip(a, b, strict=True)]


def _moved(vehicle: RobotModel, n: Parameters, y: Lists, u: list[Lane]) -> Lists:
    # XLA's CPU compiler would compute a stage again wherever a later one uses it
    return fusion_barrier(vehicle.rates(RobotContext(n, *y, u)))


def _semi_implicit_euler(
    vehicle: RobotModel, n: Parameters, y: Lists, u: list[Lane], h: Lane
) -> Lists:
    """v+ = v + h v'(q, v),  q+ = q + h q'(q, v+)."""
    q, v, x = y
    now = RobotContext(n, q, v, x, u)
    v = _plus(v, vehicle.accelerations(now), h)
    x = _plus(x, vehicle.tyre_rates(now), h)
    return _plus(q, vehicle.coordinate_rates(now.with_velocities(v, x)), h), v, x


def _linearly_implicit_euler(
    vehicle: RobotModel, n: Parameters, y: Lists, u: list[Lane], h: Lane
) -> Lists:
    """v+ = v + h v'(q, v, v+),  x+ = x + h x'(q, v+),  q+ = q + h q'(q, v+)."""
    q, v, x = y
    now = RobotContext(n, q, v, x, u)
    then = now.with_velocities(_plus(v, vehicle.damped_accelerations(now, h), h), x)
    x = _plus(x, vehicle.tyre_rates(then), h)
    return _plus(q, vehicle.coordinate_rates(then), h), then.v, x


def _rk4(vehicle: RobotModel, n: Parameters, y: Lists, u: list[Lane], h: Lane) -> Lists:
    def beyond(k: Lists, c: float) -> Lists:
        q, v, x = (_plus(a, b, c * h) for a, b in zip(y, k, strict=True))
        return q, v, x

    k1 = _moved(vehicle, n, y, u)
    k2 = _moved(vehicle, n, beyond(k1, 0.5), u)
    k3 = _moved(vehicle, n, beyond(k2, 0.5), u)
    k4 = _moved(vehicle, n, beyond(k3, 1.0), u)
    q, v, x = (
        [a + h / 6 * (b + 2 * (c + d) + e) for a, b, c, d, e in zip(*parts, strict=True)]
        for parts in zip(y, k1, k2, k3, k4, strict=True)
    )
    return q, v, x


METHODS: dict[str, Callable[..., Lists]] = {
    "semi_implicit_euler": _semi_implicit_euler,
    "linearly_implicit_euler": _linearly_implicit_euler,
    "rk4": _rk4,
}


def advance(
    vehicle: RobotModel, n: Parameters, y: Lists, u: list[Lane], h: Lane, method: str
) -> Lists:
    """The lists after a step, their velocities put back on what they must satisfy."""
    q, v, x = METHODS[method](vehicle, n, y, u, h)
    v = vehicle.project(RobotContext(n, q, v, x, u))
    q, v, x = ([jnp.asarray(a, n.dtype) for a in part] for part in (q, v, x))
    return q, v, x


def rollout(
    vehicle: RobotModel,
    state: State,
    controls: Any,
    dt: Any,
    *,
    method: str = "rk4",
    steps: int | None = None,
    save_every: int = 1,
) -> Trajectory:
    """Fixed steps of one vehicle or of a batch of states.

    "rk4": order 4, four evaluations. "semi_implicit_euler": order 1, one evaluation; velocities
    first, then coordinates with the new velocities. "linearly_implicit_euler": the same, with the
    sliding of contacts and the speeds of motors at the end of the step, as linear dampers of their
    laws' secants; it is stable where wheels are light, tyres stiff and speeds low. Controls are
    constant over a step.

    A sample is a thread on a GPU, and a lane of machine code on a CPU. A number of the robot can
    change with no recompilation. If the robot is closed over inside `jit`, its zeros vanish from
    the program.

    Args:
        vehicle: `at(robot, fidelity)`.
        state: q (nq,), v (nv,), x (nx,); or with a leading axis, a batch.
        controls: (steps, nu), or (B, steps, nu) for a batch; or a function (t, state) -> (nu,),
            which needs `steps`.
        dt: the step, s.
        method: "rk4", "semi_implicit_euler" or "linearly_implicit_euler".
        steps: the number of steps where the controls do not give it.
        save_every: keep every so many states; it must divide the number of steps.

    Returns:
        `Trajectory` of 1 + steps / save_every states, the first the initial one; `ok` says whether
        all is finite.

    Raises:
        InputError: wrong types or shapes, values that are not finite, a step that is not positive.
        UnknownName: no such method.

    Source: Hairer, Norsett & Wanner, *Solving Ordinary Differential Equations I*, II.1; Hairer &
    Wanner, *II*, IV.9, of linearly implicit methods.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax import wheeled
        >>> cart = wheeled.at(wheeled.kinds()["differential_drive"].make(), "kinematical")
        >>> wheeled.rollout(cart, wheeled.start(cart), jnp.full((10, 2), 0.1), 0.01).q.shape
        (11, 7)
    """
    check_vehicle("rollout", vehicle)
    choice("method", method, METHODS)
    shape = shape_of("rollout", "state.q", getattr(state, "q", 0.0))
    batch = shape[:1] if len(shape) == 2 else ()
    state = check_state("rollout", vehicle, state, batch)
    dtype = state.q.dtype
    dt = check_step("rollout", "dt", dt, dtype)
    if callable(controls):
        check_takes("rollout", "controls", controls, "t", "state")
    else:
        found = shape_of("rollout", "controls", controls)
        count = found[-2] if steps is None and len(found) > 1 else steps
        due = [(*lead, count or 1, vehicle.nu) for lead in dict.fromkeys([(), batch])]
        controls = check_array("rollout", "controls", controls, *due).astype(dtype)
        steps = controls.shape[-2]
    if not isinstance(steps, int) or steps < 1:
        raise InputError(
            f"rollout: steps is {steps!r}, expected a positive number of steps with a function"
        )
    if not isinstance(save_every, int) or save_every < 1 or steps % save_every:
        raise InputError(
            f"rollout: save_every is {save_every!r}, expected a divisor of the {steps} steps"
        )
    how = _How(method, steps, save_every)
    if not callable(controls):
        return _rollout(vehicle, state, controls, dt, how)
    return with_captured(lambda f: _rollout(vehicle, state, f, dt, how), controls)


def _rollout(vehicle: RobotModel, state: State, controls: Any, dt: Any, how: _How) -> Trajectory:
    numbers, rest = eqx.partition((vehicle, controls), eqx.is_array)
    run = _run if inside_jit() else _compiled
    leaves, tree = jax.tree.flatten(rest)
    states = run(numbers, state, dt, (tree, *leaves), how)
    ts = dt * jnp.arange(0, how.steps + 1, how.save_every, dtype=state.q.dtype)
    stats = {"steps": how.steps}
    return Trajectory(ts, states.q, states.v, all_finite(states), stats=stats, x=states.x)


def _run(numbers: Any, state: State, dt: Any, key: Any, how: _How) -> State:
    rest = jax.tree.unflatten(key[0], key[1:])
    vehicle, controls = eqx.combine(numbers, rest)
    batched = state.q.ndim == 2
    rows = None if callable(controls) else controls
    shared, closed = split_tracers((vehicle, controls if rows is None else None, dt))

    def sample(args: list) -> State:
        (state, rows), (vehicle, f, dt) = own(args[:first]), closed(args[first:])
        return _march(vehicle, state, f if rows is None else rows, dt, how)

    mine, tree = jax.tree.flatten((state, rows))
    own, first = functools.partial(jax.tree.unflatten, tree), len(mine)
    run = compile_threads(sample) if kernels_available() else sample
    if not batched:
        return run([*mine, *shared])
    each = None if rows is None or rows.ndim < 3 else 0
    axes = [0] * len(jax.tree.leaves(state)) + [each] * (rows is not None)
    return jax.vmap(lambda *xs: run([*xs, *shared]), axes)(*mine)


_compiled = compiled(_run, static_argnames=("key", "how"))


def _march(vehicle: RobotModel, state: State, controls: Any, dt: Any, how: _How) -> State:
    """The states (T, nq), (T, nv), (T, nx) of one sample."""
    now = vehicle.context(state)
    n = now.n
    dtype = state.q.dtype

    def once(y: Lists, i: Any) -> tuple[Lists, None]:
        if callable(controls):
            u = jnp.asarray(controls(i * dt, as_state(*y, dtype)), dtype)
        else:
            u = controls[i]
        return advance(vehicle, n, y, [u[k] for k in range(vehicle.nu)], dt, how.method), None

    def segment(y: Lists, first: Any) -> tuple[Lists, Lists]:
        if how.save_every == 1:
            y, _ = once(y, first)
        else:
            y, _ = jax.lax.scan(jax.checkpoint(once), y, first + jnp.arange(how.save_every))
        return y, y

    begin = (now.q, now.v, now.x)
    starts = jnp.arange(0, how.steps, how.save_every)
    _, path = jax.lax.scan(jax.checkpoint(segment), begin, starts)

    def table(first: list[Lane], later: list[Lane]) -> jax.Array:
        if not first:
            return jnp.zeros((len(starts) + 1, 0), dtype)
        return jnp.concatenate([jnp.stack(first)[None], jnp.stack(later, -1)])

    q, v, x = (table(a, b) for a, b in zip(begin, path, strict=True))
    return State(q, v, x if vehicle.nx else None)


def simulate(
    vehicle: RobotModel,
    state: State,
    ts: Any,
    controls: Any = None,
    *,
    solver: Any = None,
    tolerance: float | None = None,
    adjoint: Any = None,
    max_steps: int = 100_000,
) -> Trajectory:
    """Motion from ts[0] to ts[-1], saved at ts, by an adaptive solver of diffrax.

    Args:
        vehicle: `at(robot, fidelity)`.
        state: q (nq,), v (nv,), x (nx,).
        ts: (T,) s, increasing.
        controls: (nu,), constant; or a function (t, state) -> (nu,); None for zeros.
        solver: a diffrax solver, of `rb.solvers` among others; Dopri8 if None.
        tolerance: relative and absolute; 1e-10 in f64 and 1e-5 in f32 if None.
        adjoint: diffrax's; None for its default, for reverse mode.
        max_steps: the largest number of steps.

    Returns:
        `Trajectory`; `ok` says whether the solver succeeded and all is finite.

    Raises:
        InputError: wrong types or shapes, values that are not finite, times that do not increase.

    Source: Kidger, *On Neural Differential Equations*, 2021 (diffrax).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax import wheeled
        >>> cart = wheeled.at(wheeled.kinds()["differential_drive"].make(), "kinematical")
        >>> wheeled.simulate(cart, wheeled.start(cart), jnp.array([0.0, 1.0]), [0.1, 0.1]).v.shape
        (2, 2)
    """
    check_vehicle("simulate", vehicle)
    state = check_state("simulate", vehicle, state)
    dtype = state.q.dtype
    ts = check_array("simulate", "ts", ts, shape_of("simulate", "ts", ts)).astype(dtype)
    known = not isinstance(ts, jax.core.Tracer)
    if ts.ndim != 1 or len(ts) < 2 or (known and not bool((ts[1:] > ts[:-1]).all())):
        raise InputError("simulate: ts does not increase, expected two or more times (T,) in s")
    if callable(controls):
        check_takes("simulate", "controls", controls, "t", "state")
    else:
        given = jnp.zeros(vehicle.nu) if controls is None else controls
        controls = check_array("simulate", "controls", given, (vehicle.nu,)).astype(dtype)
    if max_steps is not None:
        integer("simulate", "max_steps", max_steps, least=1)
    if tolerance is None:
        tolerance = 1e-10 if dtype == jnp.float64 else 1e-5
    solve = functools.partial(
        _simulated, vehicle, state, ts,
        solver=diffrax.Dopri8() if solver is None else solver,
        tolerance=tolerance, adjoint=adjoint or diffrax.RecursiveCheckpointAdjoint(),
        max_steps=max_steps,
    )  # fmt: skip
    if callable(controls):
        return with_captured(lambda f: solve(f), controls)
    return solve(controls)


def _simulated(
    vehicle: RobotModel, state: State, ts: jax.Array, controls: Any, *, solver: Any,
    tolerance: float, adjoint: Any, max_steps: int,
) -> Trajectory:  # fmt: skip
    elapsed = ts - ts[0]
    out = _diffeqsolve(
        diffrax.ODETerm(_Field(ts[0])), solver, elapsed[0], elapsed[-1], None, state,
        (vehicle, controls), saveat=diffrax.SaveAt(ts=elapsed), adjoint=adjoint, throw=False,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=max_steps,
    )  # fmt: skip
    path = out.ys
    ok = all_finite(path) & (out.result == diffrax.RESULTS.successful)
    return Trajectory(ts, path.q, path.v, ok, out.result, out.stats, path.x)


_diffeqsolve = compiled(diffrax.diffeqsolve, jit=eqx.filter_jit)


class _Field(eqx.Module):
    """The rate of a state at the time since the start."""

    start: jax.Array

    def __call__(self, t: Any, state: State, args: Any) -> State:
        vehicle, controls = args
        u = controls(self.start + t, state) if callable(controls) else controls
        now = vehicle.context(state, jnp.asarray(u, state.q.dtype))
        q, v, x = vehicle.rates(now)
        return as_state(q, v, x, state.q.dtype)
