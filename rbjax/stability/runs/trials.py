"""A trial of a solver on a scene: run, compare, judge."""

from __future__ import annotations

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.forces.inputs import Inputs
from rbjax.model import Model, State
from rbjax.motion.simulate import simulate
from rbjax.motion.term import motion
from rbjax.motion.trajectory import Trajectory
from rbjax.solvers import AbstractGroupSolver, RigidBodySplitting
from rbjax.stability.methods import Solver, made, stepping
from rbjax.stability.runs.long_run import DONE, NO_ROOT, NOT_FINITE, long_run
from rbjax.stability.runs.scenes import SAMPLES, Scene, Truth, deviation, kept, truth
from rbjax.stability.runs.systems import Arm, Body, tumbling
from rbjax.stability.runs.verdicts import MOTION, Outcome, Verdict, verdict

TOLERANCE, BUDGET = 1e-6, 10_000


def attempt(solver: Solver, scene: Scene, true: Truth | None = None) -> Verdict | None:
    """Run a solver on a scene and judge the result; None if the solver cannot run the scene.

    max_k |x_k - r_k| at 201 samples, or the kind of failure.

    Args:
        solver: a name of `rb.solvers.all()`, any solver of rbjax or diffrax, or an
            `rb.solvers.Tableau`.
        scene: one of `rb.stability.scenes()`.
        true: the scene's `truth`, if known already.

    Returns:
        `Verdict`: errors are angles in rad. None if a controller needs an error estimate that the
        solver lacks, or for a robot with `RigidBodySplitting`.

    Raises:
        UnknownName: an unknown name of a solver.
        InputError: f64 is off; no solver.

    Source: Hairer & Wanner, *Solving ODEs II*, IV.2; Hairer, Lubich & Wanner, *Geometric Numerical
    Integration*, I.

    Example:
        >>> import rbjax as rb
        >>> scene = rb.stability.scenes()["fast_top"]
        >>> rb.stability.attempt("euler", scene).outcome.value
        'blows up'
    """
    if jnp.result_type(float) != jnp.float64:
        raise InputError('attempt: f64 is off; jax.config.update("jax_enable_x64", True)')
    one = made(solver)
    if isinstance(one, RigidBodySplitting) and isinstance(scene.system, Arm):
        return None
    if scene.adaptive and not estimates(one):
        return None
    run = (_adaptively if scene.adaptive else _equally)(one, scene)
    if scene.single:
        in_f64 = run.q
        if run.ending is None:
            run = _equally(one, scene, np.float32)
        return _judged(scene, run, in_f64)
    return _judged(scene, run, (truth(scene) if true is None else true).observed)


def estimates(solver: diffrax.AbstractSolver) -> bool:
    """Whether a solver estimates the error of its steps, which a controller needs."""
    term = diffrax.ODETerm(lambda t, y, args: (y[1], y[0]))

    def error(t, y):
        memory = solver.init(term, t, t + 1, y, None)
        return solver.step(term, t, t + 1, y, None, memory, made_jump=False)[1]

    x = jnp.zeros(1)
    return eqx.filter_eval_shape(error, x[0], (x, x)) is not None


class Run(NamedTuple):
    """States (201, n), the ending of the run (None: complete), and the time in s it reached."""

    q: np.ndarray
    v: np.ndarray
    ending: Outcome | None
    reached: float


def _equally(solver: Any, scene: Scene, dtype: Any = np.float64) -> Run:
    solver = stepping(solver)
    state = jax.tree.map(lambda x: jnp.asarray(x, dtype), scene.state)
    term: Any
    args: Any
    system = scene.system
    if isinstance(system, Arm):
        args = system.model()
        term, state = motion(args, state, solver, Inputs(_hold))
    else:
        inertia, weight = (jnp.asarray(x, dtype) for x in (system.inertia, system.weight))
        if isinstance(solver, AbstractGroupSolver):
            term, args = system.term(dtype), weight
        else:
            term, args = diffrax.ODETerm(tumbling), (inertia, weight)
    times = {"every": scene.every, "samples": SAMPLES}
    run = long_run(term, solver, state, scene.dt, kept, **times, args=args)
    q, v = (np.asarray(x, np.float64) for x in jax.tree.leaves(run.kept))
    return Run(q, v, _ENDINGS[int(run.ending)], int(run.steps) * scene.dt)


_ENDINGS = {DONE: None, NOT_FINITE: Outcome.BLOWS_UP, NO_ROOT: Outcome.NO_ROOT}


def _adaptively(solver: Any, scene: Scene) -> Run:
    if not isinstance(scene.system, Arm):
        raise InputError("attempt: an adaptive scene of a body, expected one of an arm")
    path = _simulated(scene.system.model(), scene.state, jnp.asarray(scene.ts), solver)
    q, v = np.asarray(path.q), np.asarray(path.v)
    alive = np.isfinite(q).all(1) & np.isfinite(v).all(1)
    last = int(np.argmin(alive)) - 1 if not alive.all() else len(alive) - 1
    ending = None
    if path.result == diffrax.RESULTS.max_steps_reached:
        ending = Outcome.OUT_OF_STEPS
    elif path.result != diffrax.RESULTS.successful:
        ending = Outcome.NO_ROOT
    elif not alive.all():
        ending = Outcome.BLOWS_UP
    q, v = (np.where(np.arange(len(x))[:, None] <= last, x, x[last]) for x in (q, v))
    return Run(q, v, ending, float(scene.ts[last]))


@eqx.filter_jit
def _simulated(model: Model, state: State, ts: jax.Array, solver: Any) -> Trajectory:
    # zero-stability of multistep methods needs steps that grow slowly
    controller = diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE, factormax=2.0)
    return simulate(
        model, state, ts, _hold, solver=solver, dt=1e-4, stepsize_controller=controller,
        adjoint=diffrax.ForwardMode(), throw=False, max_steps=BUDGET,
    )  # fmt: skip


def _hold(t: Any, state: State) -> jax.Array:
    """Servo targets of 0."""
    return jnp.zeros_like(state.v)


def _judged(scene: Scene, run: Run, observed: np.ndarray) -> Verdict:
    ts, system, ending, reached = scene.ts, scene.system, run.ending, run.reached
    fast = np.abs(run.v).max(1) > MOTION * scene.speed
    if fast.any() and ts[fast.argmax()] <= reached:
        ending, reached = Outcome.BLOWS_UP, float(ts[fast.argmax()])
    invariants, manifold = {}, None
    if ending is None and scene.scale:
        energy = system.energy(run.q, run.v)
        invariants["energy"] = (energy - energy[0]) / scene.scale
    if ending is None and isinstance(system, Body):
        manifold = np.abs(np.linalg.norm(run.q, axis=1) - 1)
        if not system.weight:
            momentum = np.linalg.norm(np.array(system.inertia) * run.v, axis=1)
            invariants["momentum"] = momentum / momentum[0] - 1
    xs = deviation(scene, run.q, observed)
    return verdict(
        ts, xs, np.zeros_like(xs), invariants=invariants, manifold=manifold, ending=ending,
        reached=reached,
    )  # fmt: skip
