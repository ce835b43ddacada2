"""`simulate`: motion through diffrax, with any of its solvers.

    q' = the motion of the configuration at velocity v (for attitudes q quaternion (0, w / 2)),
    v' = FD(q, v, applied forces)
The attitude enters only as the direction of its quaternion, and its rate is linear in it, so the
length that a solver loses or gains to its error has no effect until it is no number any more
(Euler, 0.4 rad a step, 40,000 steps), which `ok` tells; what is returned has unit length.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import compiled, staged
from rbjax.dynamics.arguments import check_arrays, check_control, check_moves, check_step
from rbjax.dynamics.drivers import on_threads
from rbjax.dynamics.forward import acceleration
from rbjax.dynamics.manifold import difference_lanes, integrate_lanes
from rbjax.dynamics.rnea import momentum
from rbjax.dynamics.tracing import opened
from rbjax.errors import InputError
from rbjax.forces.applied import applied
from rbjax.materialize import materialize
from rbjax.meshes import automatic
from rbjax.model import Model, State, Topology, made_ahead, spans
from rbjax.rotations import quaternion
from rbjax.solvers import AbstractGroup, AbstractGroupSolver, OnGroup
from rbjax.solvers.arguments import check_solver, check_whole
from rbjax.threads import threaded, wanted
from rbjax.trajectory import Trajectory, all_finite

Control = Callable[[jax.Array, State], jax.Array]


def configuration_rate(top: Topology, q: jax.Array, v: jax.Array) -> jax.Array:
    """q' (nq,) of the velocity v (nv,): for attitudes q (0, w) / 2."""
    out = [jnp.zeros(0, q.dtype)]
    for span in spans(top):
        out.append(v[span.v])
        if span.attitude:
            turn, by = span.attitude
            w = jnp.concatenate([jnp.zeros(1, q.dtype), v[by]])
            out.append(quaternion.multiply(q[turn], w) / 2)
    return jnp.concatenate(out)


def unit(top: Topology, q: jax.Array) -> jax.Array:
    """q with quaternions of unit length."""
    for start in top.quaternion_starts:
        rows = slice(start, start + 4)
        q = q.at[rows].set(quaternion.normalize(q[rows]))
    return q


class Motion(eqx.Module):
    """The vector field of a robot under its own forces and a control, for diffrax.

    model: of diffrax' args, which hold what is traced of it; what is known stays known.
    tangent: the configuration's rate is v itself, for solvers that move along the manifold.
    """

    control: Control | None
    model: Callable[[Any], Model]
    tangent: bool = eqx.field(static=True, default=False)

    @eqx.filter_jit  # diffrax asks for it in many places: traced once
    def __call__(self, t: Any, y: State, args: Any) -> State:
        model = self.model(args)
        q = unit(model.topology, y.q)
        ctrl = None
        if self.control is not None:
            ctrl = check_control("simulate", model, self.control(t, State(q, y.v)), q.dtype)
        tau = applied(model, q, y.v, ctrl)
        rate = y.v if self.tangent else configuration_rate(model.topology, y.q, y.v)
        return State(rate, acceleration(model, q, y.v, tau))


class Late(eqx.Module):
    """A control whose time runs on from a start."""

    control: Control
    start: jax.Array

    def __call__(self, t: Any, state: State) -> jax.Array:
        return self.control(self.start + t, state)


class Manifold(AbstractGroup):
    """The states of a robot as a Lie group: attitudes turn, everything else adds."""

    topology: Topology = eqx.field(static=True)

    def retract(self, y: State, u: State) -> State:
        q = materialize(integrate_lanes(self.topology, list(y.q), list(u.q)))
        return State(jnp.stack(q), y.v + u.v)

    def difference(self, y: State, z: State) -> State:
        dq = materialize(difference_lanes(self.topology, list(y.q), list(z.q)))
        return State(jnp.stack(dq), z.v - y.v)

    def bracket(self, u: State, w: State) -> State:
        out = jnp.zeros_like(w.q)
        for start in self.topology.turn_starts:
            rows = slice(start, start + 3)
            out = out.at[rows].set(jnp.cross(u.q[rows], w.q[rows]))
        return State(out, jnp.zeros_like(w.v))


class Momentum(eqx.Module):
    """M v (nv,)."""

    model: Callable[[Any], Model]

    @eqx.filter_jit
    def __call__(self, t: Any, y: State, args: Any) -> jax.Array:
        model = self.model(args)
        return momentum(model, unit(model.topology, y.q), y.v)


def _itself(x: Any) -> Any:
    return x


def _check_takes_robots(solver: diffrax.AbstractSolver) -> None:
    if isinstance(solver, AbstractGroupSolver) and not issubclass(OnGroup, solver.term_structure):
        raise InputError(
            f"simulate: {type(solver).__name__} solves {solver.term_structure.__name__} alone, "
            "with diffrax.diffeqsolve; robots take the other solvers"
        )


def motion(
    model: Model,
    state: State,
    solver: diffrax.AbstractSolver,
    control: Control | None = None,
    of_args: Callable[[Any], Model] = _itself,
) -> tuple[diffrax.AbstractTerm, State]:
    """The term of a robot's motion that a solver takes, and where it starts: solvers on groups move
    along the manifold, from quaternions of unit length. The term's args hold the model."""
    if not isinstance(solver, AbstractGroupSolver):
        return diffrax.ODETerm(Motion(control, of_args)), state
    top = model.topology
    _check_takes_robots(solver)
    term = OnGroup(Motion(control, of_args, tangent=True), Manifold(top), Momentum(of_args))
    return term, State(unit(top, state.q), state.v)


@automatic
def simulate(
    model: Model,
    state: State,
    ts: jax.Array,
    control: Control | None = None,
    *,
    solver: diffrax.AbstractSolver | None = None,
    dt0: float | jax.Array | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    constraints: None = None,
    progress: bool = False,
    throw: bool = True,
    max_steps: int = 100_000,
) -> Trajectory:
    """Motion from ts[0] to ts[-1], kept at ts.

    q' = N(q) v, v' = M^-1 (applied forces - b). Solved in the time since ts[0], so that a late
    start costs no digits.

    Args:
        model: the robot.
        state: initial q (nq,), v (nv,).
        ts: (T,) increasing times in seconds, the first that of the state.
        control: (t, state) -> (nu,); None for no actuation.
        solver: any diffrax solver, `rb.solvers` among them; Tsit5 if None. Those for second-order
            form, splittings and Lie groups move along the manifold of configurations.
        dt0: first step, or the fixed step where no controller is given.
        stepsize_controller: diffrax's; without it and without dt0, adaptive to 1e-8 (f64) or 1e-5.
        adjoint: diffrax's; if None checkpointed reverse mode, for `grad` and `jacrev`. For `jvp`
            and `jacfwd` give diffrax.ForwardMode(), for both diffrax.DirectAdjoint().
        progress: show diffrax's meter.
        throw: raise if the solve fails; otherwise `result` and `ok` say so.
        max_steps: at most so many steps.

    Returns:
        `Trajectory`: q (T, nq) with unit quaternions, v (T, nv), `result`, `stats`, `ok`.

    Raises:
        InputError: shapes, dtypes, times that do not increase, a step that is not positive or below
            the rounding of time; a control that is no function or returns anything but nu numbers;
            no solver, or one without an estimate of its error and no dt0; a forward derivative
            through the default adjoint.

    Source: Kidger, *On Neural Differential Equations*, 2021 (diffrax).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("pendulum")
        >>> rb.simulate(model, model.default_state(), jnp.linspace(0, 1, 5)).q.shape
        (5, 1)
    """
    if constraints is not None:
        raise InputError(
            f"simulate: constraints={constraints!r}, expected None: no formulation yet"
        )
    state = check_arrays("simulate", model, {"state": state})["state"]
    check_moves("simulate", model)
    ts, elapsed = _times(ts, state.q.dtype)
    if control is not None and not callable(control):
        raise InputError(
            f"simulate: control is {type(control).__name__}, expected a function (t, state) -> "
            "(nu,) or None; controls in an array are for rollout"
        )
    if max_steps is not None:
        check_whole("simulate", "max_steps", max_steps, 1)
    solver = diffrax.Tsit5() if solver is None else solver
    check_solver("simulate", solver)
    _check_takes_robots(solver)
    if dt0 is not None:
        _advances(check_step("simulate", "dt0", dt0, state.q.dtype), elapsed)
    # Inside a caller's jit diffrax would trace what the caller holds constant.
    # Outside, the model is an argument: a number that changes does not compile anew.
    if wanted():
        model = on_threads(model, state.q.dtype)
    if not staged() or opened(model)[0]:
        model = made_ahead(model, state.q.dtype)
    args, of_args = opened(model) if staged() else (model, _itself)
    if stepsize_controller is None:
        if dt0 is None and not isinstance(solver, diffrax.AbstractAdaptiveSolver):
            raise InputError(
                f"simulate: {type(solver).__name__} estimates no error to choose steps by, "
                "expected dt0, the fixed step; or diffrax.HalfSolver around the solver"
            )
        tolerance = 1e-8 if state.q.dtype == jnp.float64 else 1e-5
        adaptive = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        stepsize_controller = adaptive if dt0 is None else diffrax.ConstantStepSize()
    # one robot a GPU thread, each with its own steps; a thread cannot raise: that is done after it
    on_gpu = wanted() and staged() and not progress
    solve = functools.partial(
        diffrax.diffeqsolve if on_gpu else _diffeqsolve,
        solver=solver,
        dt0=dt0,
        stepsize_controller=stepsize_controller,
        adjoint=diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        max_steps=max_steps,
        throw=throw and not on_gpu,
        progress_meter=diffrax.TextProgressMeter() if progress else diffrax.NoProgressMeter(),
    )
    saved = _Saved(model.topology)

    def solved(state: State, start: jax.Array, elapsed: jax.Array, args: Any) -> tuple:
        late = None if control is None else Late(control, start)
        term, state = motion(model, state, solver, late, of_args)
        saveat = diffrax.SaveAt(ts=elapsed, fn=saved)
        out = solve(term, t0=elapsed[0], t1=elapsed[-1], y0=state, args=args, saveat=saveat)
        return out.ys, out.result, out.stats

    with _only_reverse():
        path, result, stats = (threaded if on_gpu else _itself)(solved)(
            state, ts[0], elapsed, args
        )
    q, v = path.q, path.v
    ok = all_finite(q, v) & (result == diffrax.RESULTS.successful)
    if throw:
        q = eqx.error_if(
            q,
            ~ok,
            "simulate: the solver gave up, or the motion has values that are not finite; take a "
            "smaller dt0, an adaptive stepsize_controller or more max_steps, or throw=False to "
            "look at the trajectory and its result; if no step helps, see that rb.mass_matrix of "
            "the state is not singular (a joint that moves no mass)",
        )
    return Trajectory(ts, q, v, ok, result, stats)


_diffeqsolve = compiled(diffrax.diffeqsolve, jit=eqx.filter_jit)


class _Saved(eqx.Module):
    """What is kept of a state: the same, with unit quaternions."""

    topology: Any = eqx.field(static=True)

    def __call__(self, t, y: State, args) -> State:
        return State(unit(self.topology, y.q), y.v)


def _times(ts: Any, dtype) -> tuple[jax.Array, jax.Array]:
    """The times, and the time since the first, taken before it is rounded to the dtype."""
    known = not isinstance(ts, jax.core.Tracer)
    ts = np.asarray(ts) if known else ts
    if ts.ndim != 1 or ts.shape[0] < 2:
        raise InputError(f"simulate: ts has shape {ts.shape}, expected (T,) with at least 2 times")
    if ts.dtype.kind not in "iuf":
        raise InputError(f"simulate: ts has dtype {ts.dtype}, expected times in seconds")
    elapsed = (ts - ts[0]).astype(dtype)
    if known and not (np.diff(elapsed) > 0).all():
        raise InputError("simulate: ts must increase from the first to the last")
    return jnp.asarray(ts, dtype), jnp.asarray(elapsed)


def _advances(step: jax.Array, elapsed: jax.Array) -> None:
    """Refuse a step that is lost when it is added to the time, where both are known."""
    if isinstance(step, jax.core.Tracer) or isinstance(elapsed, jax.core.Tracer):
        return
    least = np.spacing(np.asarray(elapsed)[-1])
    if not np.asarray(step) > least:
        raise InputError(
            f"simulate: dt0 is {step}, which {elapsed.dtype} cannot add to a time of "
            f"{elapsed[-1]} s; expected more than {least}, a state in float64, or a shorter ts"
        )


@contextlib.contextmanager
def _only_reverse() -> Iterator[None]:
    try:
        yield
    except TypeError as error:
        if "forward-mode autodiff" not in str(error):
            raise
        raise InputError(
            "simulate: a forward derivative (jvp, jacfwd, hessian) through an adjoint that is for "
            "reverse ones; give adjoint=diffrax.ForwardMode(), or differentiate with jacrev"
        ) from error
