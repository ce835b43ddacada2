"""Trials of solvers on scenes, and the verdict on a run: it holds, or one of six failures.

    blows up             a state is not finite, or far larger than the motion
    root not found       the equations of an implicit step were not solved
    runs out of steps    the controller rejected or shortened steps until the budget was spent
    leaves the manifold  a quaternion's length, or a constraint, has a large error
    drifts               an invariant has a slope (`trend`) that is not small
    loses the motion     no other failure, but the error is a tenth of the motion or more
The verdict is the first failure in this order. A run without a failure holds. Its value is then its
largest error.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rbjax.arguments import real_array
from rbjax.errors import InputError
from rbjax.forces.inputs import Inputs
from rbjax.model import Model, State
from rbjax.motion.simulate import simulate
from rbjax.motion.term import make_term
from rbjax.motion.trajectory import Trajectory
from rbjax.solvers import AbstractGroupSolver, RigidBodySplitting
from rbjax.stability.methods import Solver, fixed_step_solver, solver_of
from rbjax.stability.runs.drift import DONE, NO_ROOT, NOT_FINITE, long_run, trend
from rbjax.stability.runs.scenes import (
    SAMPLES,
    Arm,
    Scene,
    Top,
    Truth,
    deviation,
    kept,
    truth,
    tumbling,
)

MOTION = 1e3  # a state has blown up if it exceeds this multiple of the motion's size
LOSS = 0.1  # the motion is lost if its error reaches this fraction of its size


class Outcome(enum.Enum):
    """The possible outcomes of a run."""

    HOLDS = "holds"
    BLOWS_UP = "blows up"
    NO_ROOT = "root not found"
    OUT_OF_STEPS = "runs out of steps"
    OFF_MANIFOLD = "leaves the manifold"
    DRIFTS = "drifts"
    LOST = "loses the motion"


class Verdict(NamedTuple):
    """The outcome of a run, with a number that measures it.

    Fields:
        outcome: an `Outcome`.
        value: largest error (holds, loses the motion); time in s of the end (blows up, root not
            found, runs out of steps); distance (leaves the manifold); or relative change of the
            invariant (drifts).
        what: name of the invariant that drifts, else "".
        error: largest error while the state was sound, or None without a reference.
    """

    outcome: Outcome
    value: float
    what: str = ""
    error: float | None = None


def verdict(
    ts: ArrayLike,
    xs: ArrayLike,
    reference: ArrayLike | None = None,
    *,
    invariants: Mapping[str, ArrayLike] | None = None,
    manifold: ArrayLike | None = None,
    ending: Outcome | None = None,
    reached: float | None = None,
    size: float = 1.0,
    tolerance: float = 1e-3,
) -> Verdict:
    """Judge the outcome of a run.

    The error is max_k |x_k - r_k| while the state is sound: finite, and |x| at most 1000 size.

    Args:
        ts: (T,) s.
        xs: (T,) or (T, n) states, or the part of them to compare.
        reference: true values of xs, or None.
        invariants: name -> (T,) quantities that should be constant, each divided by its scale.
        manifold: (T,) distances from the manifold, such as | |quaternion| - 1 |.
        ending: failure that the solver reports, `Outcome.NO_ROOT`, `Outcome.OUT_OF_STEPS` or
            `Outcome.BLOWS_UP`; None if the run reached the end.
        reached: time in s that the run reached; None for the whole time.
        size: size of the motion, in the units of xs.
        tolerance: largest distance from the manifold, and largest change of an invariant.

    Returns:
        `Verdict`. Its numbers are finite even if the numbers of the run are not.

    Raises:
        InputError: wrong shapes; a reference or times that are not finite; a run without samples.

    Source: the failures in Hairer, Norsett & Wanner, *Solving ODEs*, I and II, and in Hairer,
    Lubich & Wanner, *Geometric Numerical Integration*.

    Example:
        >>> import numpy as np, rbjax as rb
        >>> t = np.linspace(0, 10, 101)
        >>> rb.stability.verdict(t, np.cos(t) + 1e-4 * t, np.cos(t)).outcome
        <Outcome.HOLDS: 'holds'>
        >>> found = rb.stability.verdict(t, np.exp(t), np.cos(t))
        >>> found.outcome.value, round(found.value, 1)
        ('blows up', 7.0)
    """
    t, x, r = _checked(ts, xs, reference)
    sound = np.isfinite(x).all(1)
    with np.errstate(invalid="ignore", over="ignore"):
        sound &= np.abs(x).max(1) <= MOTION * size
    end = len(t) if sound.all() else int(np.argmin(sound))  # first unsound sample
    last = t[-1] if reached is None else float(reached)
    alive = min(end, int(np.searchsorted(t, last, side="right")))
    error = None if r is None else float(np.abs(x - r)[:alive].max(initial=0.0))
    if (end < len(t) and t[end] <= last) or ending is Outcome.BLOWS_UP:
        return Verdict(Outcome.BLOWS_UP, float(min(last, t[min(end, len(t) - 1)])), "", error)
    if ending is not None:
        return Verdict(ending, last, "", error)
    off = 0.0 if manifold is None else _largest("manifold", manifold, len(t))
    if off > tolerance:
        return Verdict(Outcome.OFF_MANIFOLD, off, "", error)
    for name, series in (invariants or {}).items():
        found = trend(t, series)
        if found.drifts and abs(found.change) > tolerance:
            return Verdict(Outcome.DRIFTS, found.change, name, error)
    if error is not None and error >= LOSS * size:
        return Verdict(Outcome.LOST, error, "", error)
    return Verdict(Outcome.HOLDS, 0.0 if error is None else error, "", error)


def _checked(ts: ArrayLike, xs: ArrayLike, reference: ArrayLike | None) -> tuple:
    t, x = (
        real_array("verdict", name, y, "an array of numbers", finite=False)
        for name, y in (("ts", ts), ("xs", xs))
    )
    if t.ndim != 1 or not len(t) or x.shape[:1] != t.shape or x.ndim > 2:
        raise InputError(
            f"verdict: got ts {t.shape} and xs {x.shape}, expected (T,), and (T,) or (T, n)"
        )
    if not np.isfinite(t).all():
        raise InputError(
            "verdict: got times that are not finite, expected finite times; a run of `drift` that "
            "ended early has nan times: give the times of the whole run, and its `ending`"
        )
    r = None
    if reference is not None:
        r = real_array("verdict", "reference", reference, "an array of numbers", finite=False)
    if r is not None and r.shape != x.shape:
        raise InputError(f"verdict: got a reference {r.shape}, expected the shape of xs, {x.shape}")
    if r is not None and not np.isfinite(r).all():
        raise InputError("verdict: got a reference that is not finite, expected finite values")
    rows = (len(t), -1)
    return t, x.reshape(rows), None if r is None else r.reshape(rows)


def _largest(name: str, series: ArrayLike, length: int) -> float:
    x = real_array("verdict", "a series", series, "an array of numbers", finite=False)
    if x.shape != (length,) or not np.isfinite(x).all():
        raise InputError(f"verdict: {name} has shape {x.shape}, expected ({length},), all finite")
    return float(np.abs(x).max())


# -------------------------------------------------------------------- trials

TOLERANCE, BUDGET = 1e-6, 10_000


def attempt(solver: Solver, scene: Scene, true: Truth | None = None) -> Verdict | None:
    """Run a solver on a scene and judge the result; None if the solver cannot run the scene.

    The verdict has the largest error max_k |x_k - r_k| at 201 samples, or the kind of failure.

    Args:
        solver: a name of `rb.solvers.all()`, a solver of rbjax or diffrax, or an
            `rb.solvers.Tableau`.
        scene: one of `rb.stability.scenes()`.
        true: the scene's `truth`, if already computed.

    Returns:
        `Verdict`. Errors are angles in rad, or m near gimbal lock. None if a controller needs an
        error estimate that the solver lacks, or for an arm with `RigidBodySplitting`.

    Raises:
        UnknownName: an unknown solver name.
        InputError: f64 is disabled, or `solver` is not a solver.

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
    one = solver_of(solver)
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
    """Return whether a solver estimates the error of its steps, which a controller needs."""
    term = diffrax.ODETerm(lambda t, y, args: (y[1], y[0]))

    def error(t, y):
        memory = solver.init(term, t, t + 1, y, None)
        return solver.step(term, t, t + 1, y, None, memory, made_jump=False)[1]

    x = jnp.zeros(1)
    return eqx.filter_eval_shape(error, x[0], (x, x)) is not None


class SceneRun(NamedTuple):
    """A run of a solver on a scene."""

    q: np.ndarray  # (201, n), as v
    v: np.ndarray
    ending: Outcome | None  # failure that ended the run; None if it is complete
    reached: float  # time in s that the run reached


def _equally(solver: Any, scene: Scene, dtype: Any = np.float64) -> SceneRun:
    solver = fixed_step_solver(solver)
    state = jax.tree.map(lambda x: jnp.asarray(x, dtype), scene.state)
    term: Any
    args: Any
    system = scene.system
    if isinstance(system, Arm):
        args = system.model()
        term, state = make_term(args, state, solver, Inputs(_hold))
    else:
        inertia, weight = (jnp.asarray(x, dtype) for x in (system.inertia, system.weight))
        if isinstance(solver, AbstractGroupSolver):
            term, args = system.term(dtype), weight
        else:
            term, args = diffrax.ODETerm(tumbling), (inertia, weight)
    times = {"every": scene.every, "samples": SAMPLES}
    run = long_run(term, solver, state, scene.dt, kept, **times, args=args)
    q, v = (np.asarray(x, np.float64) for x in jax.tree.leaves(run.kept))
    return SceneRun(q, v, _ENDINGS[int(run.ending)], int(run.steps) * scene.dt)


_ENDINGS = {DONE: None, NOT_FINITE: Outcome.BLOWS_UP, NO_ROOT: Outcome.NO_ROOT}


def _adaptively(solver: Any, scene: Scene) -> SceneRun:
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
    return SceneRun(q, v, ending, float(scene.ts[last]))


@eqx.filter_jit
def _simulated(model: Model, state: State, ts: jax.Array, solver: Any) -> Trajectory:
    # zero-stability of multistep methods needs steps that grow slowly
    controller = diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE, factormax=2.0)
    return simulate(
        model, state, ts, _hold, solver=solver, dt=1e-4, stepsize_controller=controller,
        adjoint=diffrax.ForwardMode(), throw=False, max_steps=BUDGET,
    )  # fmt: skip


def _hold(t: Any, state: State) -> jax.Array:
    """Return servo targets of 0."""
    return jnp.zeros_like(state.v)


def _judged(scene: Scene, run: SceneRun, observed: np.ndarray) -> Verdict:
    ts, system, ending, reached = scene.ts, scene.system, run.ending, run.reached
    fast = np.abs(run.v).max(1) > MOTION * scene.speed
    if fast.any() and ts[fast.argmax()] <= reached:
        ending, reached = Outcome.BLOWS_UP, float(ts[fast.argmax()])
    invariants, manifold = {}, None
    if ending is None and scene.scale:
        energy = system.energy(run.q, run.v)
        invariants["energy"] = (energy - energy[0]) / scene.scale
    if ending is None and isinstance(system, Top):
        manifold = np.abs(np.linalg.norm(run.q, axis=1) - 1)
        if not system.weight:
            momentum = np.linalg.norm(np.array(system.inertia) * run.v, axis=1)
            invariants["momentum"] = momentum / momentum[0] - 1
    xs = deviation(scene, run.q, observed)
    return verdict(
        ts, xs, np.zeros_like(xs), invariants=invariants, manifold=manifold, ending=ending,
        reached=reached,
    )  # fmt: skip
