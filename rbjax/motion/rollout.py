"""`rollout`: integration of a batch of states with fixed steps, for throughput.

All steps of a sample are one program (`checkpointed_rollout`): a GPU thread, or a lane of machine
code on a CPU. If neither is available, XLA maps the loop of one sample over the batch.

The reverse gradient under XLA keeps each saved state. The steps between two saved states are
computed again. So a sample keeps (T / save_every + save_every) states and the intermediate values
of one step.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, integer
from rbjax.compiler import kernels_available
from rbjax.compiling import compiled, inside_jit
from rbjax.constraints.formulation import Formulation
from rbjax.contact.impact_bias import warn_of_impacts
from rbjax.dynamics.arguments import check_arrays, check_moves, check_step, shape_of
from rbjax.dynamics.tracing.custom_rules import split_tracers
from rbjax.dynamics.tracing.devices import memory_share
from rbjax.errors import InputError, RbjaxError
from rbjax.forces.inputs import Inputs, Source
from rbjax.meshes import on_auto_axes
from rbjax.model import Model, State
from rbjax.motion.closures.captured import Captured, with_captured
from rbjax.motion.field import Dynamics, Field, dynamics_of, free_motion, with_contact
from rbjax.motion.inputs import Sources, check_sources
from rbjax.motion.integrators import Integrator, advance_state, integrator_of
from rbjax.motion.linearise import linearise
from rbjax.motion.solver_report import initial_report, warn_if_unconverged
from rbjax.motion.step import with_memory
from rbjax.motion.threaded import Steps, rollout_on_threads
from rbjax.motion.trajectory import Trajectory, all_finite, check_save_every, scan_steps


def rollout(
    model: Model,
    state: State,
    ctrl: ArrayLike | Source | None = None,
    dt: float | None = None,
    *,
    tau: ArrayLike | Source | None = None,
    wrenches: ArrayLike | Source | None = None,
    integrator: str | Integrator | None = None,
    dynamics: Dynamics = free_motion,
    constraints: str | Formulation | None = None,
    contact: Any = None,
    save_every: int = 1,
    steps: int | None = None,
    kernel: bool | None = None,
    memory: float | None = None,
) -> Trajectory:
    """Integrate one state or a batch of states with fixed steps, for throughput.

    `semi_implicit_euler`: v+ = v + dt a(q, v, u), q+ = q (+) dt v+. It has order 1 and one
    evaluation. It is symplectic in (q, v) only if the mass matrix is constant: a double pendulum
    loses energy.

    `euler_implicit_damping`, `implicitfast`, `implicit`: semi-implicit Euler with implicit damping,
    (M + dt D) (v+ - v) = dt M a, as in MuJoCo. Use them for stiff dampers and velocity gains. D has
    the dampers of joints; the symmetric part of -d tau/dv of dampers, tendons, actuators and fluid,
    and the bias forces of bodies that float freely; or -d(tau - b)/dv. Other force elements may
    define their part (`Element.slopes`). Rigid constraints need another integrator.

    `discrete`: springs, dampers, servos and the rows of MuJoCo's contacts act at the end of a step,
    in one problem with the matrix M + dt D + dt^2 K, as in MuJoCo. Use it for stiff springs and
    servos, and for contacts with time constants below the step.

    `variational_midpoint`: order 2, symplectic in (q, p = M v), attitudes included, and implicit in
    all forces. Energy does not drift. A step has 6 evaluations (`VariationalMidpoint(evaluations)`
    changes the number) and costs as much as 4.5 to 8 steps of semi-implicit Euler. A step that does
    not converge is nan. The derivative is the derivative of the 6 evaluations with a constant
    iteration matrix. Its error is of the size of the error of the iteration.

    `rk4`, `tsit5`, `dopri8`, `dop853`: explicit Runge-Kutta methods on the manifold, of order 4, 5,
    8, 8 with 4, 6, 13, 12 evaluations. If a body turns by more than about
    3 rad in a step, they diverge, and `success` is False.

    Force elements read the step dt. Their states end each step within their ranges.

    The functions (policy, tau, wrenches, dynamics, integrator) are compared by the values that they
    read, and not by identity: lambdas that differ only in floats and arrays compile once. A
    function that branches on a float compiles for each value. A function with side effects (it
    counts its calls, or draws numpy's random numbers) compiles for each object. The programs of the
    last 64 functions are cached.

    Args:
        model: the robot.
        state: q (nq,) or (B, nq), v (nv,) or (B, nv); a leading axis is a batch. x (nx,) or (B, nx)
            if force elements have states.
        ctrl: controls, (nu,) or (steps, nu), or (B, steps, nu) for a batch; or a policy
            (t, state) -> (nu,), evaluated once a step; or None for no actuation.
        dt: step in s; the model's timestep if None.
        tau: generalized forces in addition to those of the model: (nv,) or (steps, nv), or
            (B, steps, nv); or a function (t, state) -> (nv,), evaluated once a step.
        wrenches: [moment N m; force N] on bodies, in world axes at their origins: (nb, 6) or
            (steps, nb, 6), or (B, steps, nb, 6); or a function (t, state) -> (nb, 6), evaluated
            once a step.
        integrator: one of "semi_implicit_euler", "euler_implicit_damping", "implicitfast",
            "implicit", "discrete", "variational_midpoint", "rk4", "tsit5", "dopri8", "dop853"; or a
            function (field, t, state, inputs, dt) -> state
            (`rbjax.motion.integrators.Integrator`). None:
            "semi_implicit_euler"; with MuJoCo's contacts `model.solver.integrator`, the
            integrator of the file. For constraints of index 2 and 3 a fully implicit method
            (`rbjax.constraints.DifferentialAlgebraic`).
        dynamics: map from forces to accelerations, or to the velocity after a step with a memory
            (`rbjax.motion.field.Dynamics`, `VelocityDynamics`).
        constraints: how to enforce the constraints of the model: a name of
            `rbjax.constraints.formulations`, a `Formulation`, or None for "projected" (see
            `rbjax.recommend.formulation`).
        contact: law of contact between the geoms of the model, a name of `rbjax.contact.laws`; None
            for the law of the model (`load(contacts=True)`).
        save_every: number of steps from one saved state to the next, a divisor of the steps.
        steps: the number of steps, if no input has a row for each step.
        kernel: True: a sample is a GPU thread or a lane of machine code. False: a scan under XLA.
            None: True if the platform supports it.
        memory: bytes in which a reverse gradient of threads may keep states, for the whole batch.
            With less memory more steps are computed twice. None: an eighth of the memory of the
            devices over which a batch can be spread. Not used under XLA.

    Returns:
        `Trajectory` of 1 + steps / save_every states, beginning with the initial state. q is
        (T, nq), or (B, T, nq) for a batch. `success`: whether all values are finite.
        `unconverged`: the number of steps whose solver of contacts did not converge;
        `worst_error`: its largest error. Outside traced code failures of both kinds warn: the
        number of samples, the first failure, and a stable step.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite, an unknown integrator, a
            step that is not positive, no steps, a policy that does not return nu numbers.

    Differentiable in state, ctrl, model and the values that a policy closes over, in forward and
    reverse mode. The reverse gradient keeps steps / save_every + save_every states per sample.

    On a GPU (docs/develop/threads.md):

    - f32 and f64, forward mode, reverse mode and their derivatives work as on a CPU;
    - a derivative keeps every k-th state, in forward mode too: k = 1 if that fits into `memory`,
      else the smallest divisor of save_every that fits, or save_every;
    - a policy of more than 4,000 operations runs under XLA between the steps;
    - the rollout runs under XLA, with a warning, if a step has more than 100,000 statements or
      64 KiB of arrays, or a primitive that threads do not support (svd, eigh, a callback).

    Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, I.1, IV.8; Marsden & West,
    *Discrete mechanics and variational integrators*, Acta Numerica 2001; Tsitouras (2011);
    Prince & Dormand (1981); Hairer, Norsett & Wanner, *Solving Ordinary Differential Equations I*,
    II.5 (`dop853`); MuJoCo, *Computation*, numerical integration.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> rb.rollout(model, model.default_state(), jnp.zeros((10, 1)), 0.01).q.shape
        (11, 2)
    """
    dynamics = with_contact("rollout", model, dynamics, contact)
    path, step, dynamics = run_rollout(
        model, state, ctrl, dt, tau, wrenches, integrator, dynamics, constraints, save_every,
        steps, kernel, memory,
    )  # fmt: skip
    if not isinstance(path.success, jax.core.Tracer):
        _warn_if_not_finite(model, path, step, dynamics)
        warn_if_unconverged("rollout", path, dynamics)
    if (path.q.shape[-2] - 1) * save_every > 1:
        q, v = warn_of_impacts("rollout", model, dynamics, path.q, path.v)
        path = dataclasses.replace(path, q=q, v=v)
    return path


def run_rollout(
    model: Model, state: State, ctrl: Any, dt: Any, tau: Any = None, wrenches: Any = None,
    integrator: Any = None, dynamics: Dynamics = free_motion, constraints: Any = None,
    save_every: int = 1,
    steps: int | None = None, kernel: bool | None = None, memory: float | None = None,
) -> tuple[Trajectory, jax.Array, Dynamics]:  # fmt: skip
    """Run `rollout` without its warning. Return the trajectory, the step in s, and the dynamics."""
    dynamics = dynamics_of("rollout", model, dynamics, constraints, steps=True)
    advance = integrator_of("rollout", integrator, dynamics, model)
    _check_where(kernel, memory)
    state, sources, steps, batched = _checked(model, state, Inputs(ctrl, tau, wrenches), steps)
    save_every = check_save_every("rollout", save_every, steps)
    batch = state.q.shape[:-1]
    state = with_memory(model, state, dynamics, batch)
    state = State(
        state.q, state.v, state.x, state.memory, initial_report(dynamics, state.q.dtype, batch)
    )
    step = check_step("rollout", "dt", model.timestep if dt is None else dt, state.q.dtype)
    threads = kernels_available() if kernel is None else kernel
    memory = memory_share() if memory is None else memory
    how = (save_every, steps, batched)

    def run_steps(*functions: Any) -> Trajectory:
        *asked, dynamics, advance = functions
        given = dataclasses.replace(sources, functions=Inputs(*asked))
        numbers, rest = eqx.partition((given, dynamics, advance), eqx.is_array)
        traced = split_tracers((model, state, numbers, step))[0]
        hidden = any(callable(f) and not isinstance(f, Captured) for f in asked)
        eager = traced and (hidden or inside_jit())
        leaves, tree = jax.tree.flatten(rest)
        key = (tree, *leaves)
        run = _run if eager else _compiled(*key)
        return run(model, state, numbers, step, key, how, threads, memory)

    if advance is integrator:  # the caller's function
        path = with_captured(run_steps, *sources.functions, dynamics, advance)
    else:
        path = with_captured(lambda *f: run_steps(*f, advance), *sources.functions, dynamics)
    return path, step, dynamics


def _run(model, state, numbers, dt, key, how, threads, memory) -> Trajectory:
    rest = jax.tree.unflatten(key[0], key[1:])
    run_steps = functools.partial(rollout_on_threads, memory=memory) if threads else _under_xla

    def moved(model: Model, state: State, numbers: Any, dt: jax.Array) -> State:
        given, dynamics, advance = eqx.combine(numbers, rest)
        return run_steps(model, state, given, dt, Steps(dynamics, advance, *how))

    save_every, count, batched = how
    rows = numbers[0].rows
    each = () if rows is None or rows.ndim < 3 else (rows,)
    along = (*jax.tree.leaves(state), *each) if batched else ()
    states = on_auto_axes(moved, model, state, numbers, dt, along=along)
    ts = dt * jnp.arange(0, count + 1, save_every, dtype=state.q.dtype)
    ok = all_finite(State(states.q, states.v, states.x, states.memory))
    return Trajectory(
        ts, states.q, states.v, ok, stats={"steps": count}, x=states.x, memory=states.memory,
        report=states.report,
    )  # fmt: skip


@functools.lru_cache(64, typed=True)  # a compiled program occupies some MB
def _compiled(*key: Any) -> Callable:
    """Return the compiled `_run` for one key of functions."""
    del key
    run = functools.partial(_run)  # a new object, so that `jit` drops its programs with it
    return compiled(run, static_argnames=("key", "how", "threads", "memory"))


def _under_xla(model: Model, state: State, sources: Sources, dt: jax.Array, how: Steps) -> State:
    """Compute the states (..., T, nq), (..., T, nv), (..., T, nx) by an XLA loop, vmapped over the
    batch."""
    rows = sources.rows

    def one(state: State, rows: Any) -> State:
        return _states(model, state, rows, sources, dt, how)

    if not how.batched:
        return one(state, rows)
    each = 0 if rows is not None and rows.ndim == 3 else None
    return jax.vmap(one, in_axes=(0, each))(state, rows)


def _states(
    model: Model, state: State, rows: Any, sources: Sources, dt: jax.Array, how: Steps
) -> State:
    """Integrate one sample and return all saved states, beginning with the initial one."""
    field = Field(model, how.dynamics, dt)

    def step(state: State, i: jax.Array) -> State:
        given = [] if rows is None else [rows[i]]
        if sources.has_functions:
            given.append(sources.evaluate(model, i * dt, state))
        inputs = sources.inputs(model, *given)
        return advance_state(how.integrator, field, i * dt, state, inputs, dt)

    states = scan_steps(step, state, how.count, how.save_every)
    return jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), state, states)


def _checked(
    model: Model, state: State, given: Inputs, steps: int | None
) -> tuple[State, Sources, int, bool]:
    """Check state and inputs; return them in one dtype, the number of steps, and the batch flag."""
    shape = shape_of("rollout", "q", state.q) if isinstance(state, State) else ()
    batched = len(shape) == 2
    batch = shape[:1] if batched else ()
    if batch == (0,):
        raise InputError(
            f"rollout: q has shape {shape}, a batch of no states, expected one or more"
        )
    state = check_arrays("rollout", model, {"state": state}, batch)["state"]
    check_moves("rollout", model)
    if steps is not None:
        integer("rollout", "steps", steps, least=1)
    sources, steps = check_sources(model, given, steps, batch, state.q.dtype)
    return state, sources, steps, batched


def _check_where(kernel: Any, memory: Any) -> None:
    """Raise InputError unless kernel is True, False or None, and memory positive or None."""
    if not (kernel is None or isinstance(kernel, bool)):
        raise InputError(f"rollout: kernel is {kernel!r}, expected True, False or None to choose")
    if not (memory is None or (isinstance(memory, (int, float)) and memory > 0)):
        raise InputError(f"rollout: memory is {memory!r}, expected a positive number of bytes")


def _warn_if_not_finite(model: Model, path: Trajectory, dt: jax.Array, dynamics: Dynamics) -> None:
    """Warn of the number of samples that are not finite, of the first failure, and of the largest
    stable step. `path.success` must not be traced; under `grad` the other arrays are, with
    values."""
    if not path.success.is_fully_addressable:  # another process holds a part of the batch
        return
    ok = np.atleast_1d(np.asarray(path.success))
    if ok.all():
        return
    model, path, dt = jax.lax.stop_gradient((model, path, dt))
    batched = path.success.ndim == 1
    states = [x if batched else x[None] for x in (path.q, path.v, path.x) if x is not None]
    bad = ~np.logical_and.reduce([np.isfinite(np.asarray(x)).all(-1) for x in states])
    at = int(bad.any(0).argmax())
    sample = int(bad[:, at].argmax())
    which = f", sample {sample}" if batched else ""
    count = f"{int((~ok).sum())} of {len(ok)} samples have" if batched else "the motion has"
    given = State(*(x[sample, 0] for x in states))
    warnings.warn(
        f"rollout: {count} values that are not finite, the first at t = "
        f"{float(path.ts[at]):.6g} s{which}; dt is {float(dt):.4g} s. "
        f"{_advice(model, given, float(dt), dynamics)}",
        stacklevel=3,
    )


def _advice(model: Model, state: State, dt: float, dynamics: Dynamics) -> str:
    largest = np.nan
    try:
        ctrl = jnp.zeros(model.nu, state.q.dtype) if model.nu else None
        A = np.asarray(linearise(model, state, ctrl, dynamics=dynamics).A)
        largest = np.abs(np.linalg.eigvals(A)).max(initial=0.0) if np.isfinite(A).all() else np.nan
    except (
        RbjaxError,
        TypeError,
        NotImplementedError,
    ):  # `linearise` does not support the dynamics
        pass
    if not np.isfinite(largest) or largest == 0:
        return "Take a smaller dt; if no step helps, check that rb.mass_matrix is not singular"
    stable = 2 / largest
    found = f"at the start the linearised motion has an eigenvalue s with |s| = {largest:.4g} /s"
    if stable < dt:
        return f"Take dt below {stable:.2g} s: {found}, and explicit steps need dt < 2 / |s|"
    return (
        f"Take a smaller dt: {found}, for which this step is stable, so forces, controls or speeds "
        "later in the motion need a smaller one"
    )
