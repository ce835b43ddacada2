"""`simulate`: integration of the motion by any diffrax solver."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, integer
from rbjax.compiler import compile_threads, kernels_available
from rbjax.compiling import compiled, inside_jit
from rbjax.constraints.formulation import Formulation
from rbjax.contact.impact_bias import warn_of_impacts
from rbjax.dynamics.arguments import (
    check_arrays,
    check_moves,
    check_step,
)
from rbjax.dynamics.drivers.choice import on_threads
from rbjax.dynamics.tracing.custom_rules import is_traced, split_tracers
from rbjax.errors import InputError
from rbjax.forces.inputs import Inputs, Source
from rbjax.meshes import automatic
from rbjax.model import Model, State, with_constants
from rbjax.motion.closures.captured import with_captured
from rbjax.motion.field import Dynamics, Field, dynamics_of, free_motion, with_contact
from rbjax.motion.inputs import inputs_between
from rbjax.motion.solver_report import warn_if_unconverged
from rbjax.motion.term import (
    ReportingSolver,
    check_for_robots,
    make_term,
    project_after_steps,
    solver_of,
    unit_quaternions,
)
from rbjax.motion.trajectory import Trajectory, all_finite, check_times


@automatic
def simulate(
    model: Model,
    state: State,
    ts: ArrayLike,
    ctrl: ArrayLike | Source | None = None,
    *,
    tau: ArrayLike | Source | None = None,
    wrenches: ArrayLike | Source | None = None,
    solver: diffrax.AbstractSolver | None = None,
    dt: float | ArrayLike | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    constraints: str | Formulation | None = None,
    contact: Any = None,
    dynamics: Dynamics = free_motion,
    progress: bool = False,
    throw: bool = True,
    max_steps: int = 100_000,
) -> Trajectory:
    """Integrate the motion from ts[0] to ts[-1] by a diffrax solver, and save it at ts.

    q' = N(q) v, v' = M^-1 (applied forces - b). The solver's time is relative to ts[0], so that a
    late start loses no digits.

    Parameters of the model can change without recompilation, unless a structural zero appears or
    disappears in the links (placements, axes, masses, centers, inertias, armatures, references) or
    in gravity.

    Inside `jit` a sample is a GPU thread or a lane of machine code on a CPU. Its reverse gradient
    is one too if `max_steps` or the checkpoints of the adjoint are few; otherwise it runs under XLA
    (docs/develop/threads.md).

    A new function (ctrl, tau, wrenches, dynamics) is not compiled again if it differs from an
    earlier one only in numbers that it reads (see `rollout`). For arrays on a mesh with explicit
    axes call `simulate` inside `jax.jit`; outside it, each call compiles.

    Args:
        model: the robot.
        state: initial state with q (nq,), v (nv,), and x (nx,) if force elements have states.
        ts: (T,) increasing times in s; ts[0] is the time of the initial state.
        ctrl: controls: (nu,); (T - 1, nu), a row for each interval of ts; a policy
            (t, state) -> (nu,); or None for no actuation.
        tau: generalized forces in addition to those of the model: (nv,), (T - 1, nv), or
            (t, state) -> (nv,).
        wrenches: [moment N m; force N] on bodies, in world axes at their origins: (nb, 6),
            (T - 1, nb, 6), or (t, state) -> (nb, 6).
        solver: any diffrax solver, including those of `rb.solvers`; Tsit5 if None. Second-order,
            splitting and Lie group solvers integrate on the configuration manifold. Constraints of
            index 2 and 3 require radau_iia, gauss_legendre, lobatto_iiic or bdf; None:
            radau_iia(3).
        dt: first step in s, or the fixed step without a controller.
        stepsize_controller: a diffrax controller. If it and dt are None: adaptive with tolerance
            1e-8 (f64) or 1e-5 (f32).
        adjoint: a diffrax adjoint. None: checkpointed reverse mode, for `grad` and `jacrev`. Use
            diffrax.ForwardMode() for `jvp` and `jacfwd`, diffrax.DirectAdjoint() for both.
        dynamics: map from forces to accelerations (`rbjax.motion.field.Dynamics`).
        constraints: how to enforce the constraints of the model: a name of
            `rbjax.constraints.formulations`, a `Formulation`, or None for "projected".
        contact: law of contact between the geoms of the model, a name of `rbjax.contact.laws`; None
            for the law of the model (`load(contacts=True)`).
        progress: whether to show diffrax's progress meter.
        throw: whether to raise if the solve fails; otherwise `result` and `success` report it.
        max_steps: largest number of steps.

    Returns:
        `Trajectory`: q (T, nq) with unit quaternions, v (T, nv), `result`, `stats`, `success`; with
        MuJoCo's contacts `unconverged`, the number of steps whose solver of contacts did not
        converge, and `worst_error`, their largest error as a mean over a step. Outside traced code
        such steps warn. Solvers on Lie groups, splitting and second-order solvers do not report.

    Raises:
        InputError: wrong shapes or dtypes, times that do not increase, a step that is not positive
            or below the rounding of time, a policy that does not return nu numbers, a value that is
            not a solver, no dt for a solver without an error estimate, or forward derivatives with
            the default adjoint.

    Source: Kidger, *On Neural Differential Equations*, 2021 (diffrax).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("pendulum")
        >>> rb.simulate(model, model.default_state(), jnp.linspace(0, 1, 5)).q.shape
        (5, 1)
    """
    dynamics = with_contact("simulate", model, dynamics, contact)
    state = check_arrays("simulate", model, {"state": state})["state"]
    state = State(state.q, state.v, state.x)  # only dynamics with fixed steps have a memory
    check_moves("simulate", model)
    ts, elapsed = check_times("simulate", ts, state.q.dtype)
    inputs = inputs_between("simulate", model, Inputs(ctrl, tau, wrenches), ts)
    if max_steps is not None:
        integer("simulate", "max_steps", max_steps, least=1)
    dynamics = dynamics_of("simulate", model, dynamics, constraints)
    solver = solver_of(solver, dynamics)
    check_for_robots(solver)
    _check_kind("stepsize_controller", stepsize_controller, diffrax.AbstractStepSizeController)
    _check_kind("adjoint", adjoint, diffrax.AbstractAdjoint)
    if dt is not None:
        _advances(check_step("simulate", "dt", dt, state.q.dtype), elapsed)
    if kernels_available():
        model = on_threads(model, state.q.dtype)
    if not inside_jit() or is_traced(model):
        model = with_constants(model, state.q.dtype)
    if stepsize_controller is None:
        if dt is None and not isinstance(solver, diffrax.AbstractAdaptiveSolver):
            raise InputError(
                f"simulate: {type(solver).__name__} estimates no error to choose steps by, "
                "expected dt, the fixed step; or diffrax.HalfSolver around the solver"
            )
        tolerance = 1e-8 if state.q.dtype == jnp.float64 else 1e-5
        adaptive = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        stepsize_controller = adaptive if dt is None else diffrax.ConstantStepSize()
    by_kernel = kernels_available() and not progress
    how = _How(
        solver, dt, stepsize_controller,
        diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        max_steps, throw and not by_kernel, progress, by_kernel,
    )  # fmt: skip
    # In a caller's jit, the caller's constants remain constants. Outside it, the model is an
    # argument, so that a changed parameter does not recompile.
    run = _solved if inside_jit() else _compiled

    def solved(*functions: Any) -> tuple:
        return run(model, state, ts[0], elapsed, functions, how)

    with _only_reverse():
        path, result, stats, report = with_captured(solved, *inputs, dynamics)
    q, failed = path.q, result != diffrax.RESULTS.successful
    ok = all_finite(path) & ~failed
    if throw and not inside_jit():
        q = result.error_if(q, failed)  # raises with the reason
    if throw:
        q = eqx.error_if(
            q,
            ~ok,
            "simulate: integration failed or gave values that are not finite. Take a smaller dt, "
            "an adaptive stepsize_controller or more max_steps, or throw=False to look at the "
            "trajectory and its result; if no step helps, check that rb.mass_matrix of the state "
            "is not singular (a joint that moves no mass)",
        )
    q, v = warn_of_impacts("simulate", model, dynamics, q, path.v)
    out = Trajectory(ts, q, v, ok, result, stats, path.x, report=report)
    warn_if_unconverged("simulate", out, dynamics)
    return out


class _How(NamedTuple):
    """Options of the solve.

    by_kernel: whether one robot is one kernel program, which cannot raise, so `throw` is False.
    """

    solver: diffrax.AbstractSolver
    dt: Any
    stepsize_controller: diffrax.AbstractStepSizeController
    adjoint: diffrax.AbstractAdjoint
    max_steps: int | None
    throw: bool
    progress: bool
    by_kernel: bool


def _solved(
    model: Model, state: State, start: jax.Array, elapsed: jax.Array, functions: tuple, how: _How
) -> tuple:
    """Solve by diffrax; return the saved states, the result, the statistics, and the report of the
    solver of a contact law."""
    *given, dynamics = functions
    args, of_args = split_tracers(model)

    def solved_from(state: State, start: jax.Array, elapsed: jax.Array, args: Any) -> tuple:
        term, state = make_term(
            of_args(args), state, how.solver, Inputs(*given), of_args, dynamics, start
        )
        solver = project_after_steps(how.solver, dynamics, of_args, start)
        watched = isinstance(solver, ReportingSolver)
        out = diffrax.diffeqsolve(
            term,
            solver=solver,
            t0=elapsed[0],
            t1=elapsed[-1],
            dt0=how.dt,
            y0=state,
            args=args,
            saveat=diffrax.SaveAt(
                ts=elapsed, fn=_Saved(of_args, dynamics, start), solver_state=watched
            ),
            stepsize_controller=how.stepsize_controller,
            adjoint=how.adjoint,
            max_steps=how.max_steps,
            throw=how.throw,
            progress_meter=(
                diffrax.TextProgressMeter() if how.progress else diffrax.NoProgressMeter()
            ),
        )
        report = out.solver_state[1][None] if watched else None
        return out.ys, out.result, out.stats, report

    run = compile_threads(solved_from) if how.by_kernel else solved_from
    return run(state, start, elapsed, args)


_compiled = compiled(_solved, jit=eqx.filter_jit)


class _Saved(eqx.Module):
    """The map of a state to its saved form: unit quaternions, projected onto the constraints."""

    model: Callable[[Any], Model]
    dynamics: Dynamics
    start: Any

    def __call__(self, t, y: State, args) -> State:
        model = self.model(args)
        y = State(unit_quaternions(model.topology, y.q), y.v, y.x)
        return Field(model, self.dynamics).project(self.start + t, y)


def _check_kind(name: str, value: Any, kind: type) -> None:
    """Raise InputError if a value has the wrong type, such as a class instead of an instance."""
    if value is None or isinstance(value, kind):
        return
    got = f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
    raise InputError(
        f"simulate: {name} is {got}, expected None or a {kind.__name__} of diffrax, as "
        "diffrax.DirectAdjoint() or diffrax.ConstantStepSize()"
    )


def _advances(step: jax.Array, elapsed: jax.Array) -> None:
    """Raise InputError if adding the step to the time has no effect. Ignore traced values."""
    if isinstance(step, jax.core.Tracer) or isinstance(elapsed, jax.core.Tracer):
        return
    least = np.spacing(np.asarray(elapsed)[-1])
    if not np.asarray(step) > least:
        raise InputError(
            f"simulate: dt is {step}, which {elapsed.dtype} cannot add to a time of "
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
