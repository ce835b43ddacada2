"""`solver`: choose a solver and a step for a motion of a robot, by trial runs.

    1. compute the motion by an adaptive method with a much smaller error than requested
    2. linearise along the path: the fastest eigenvalue, and the largest step at which the
       explicit candidate is stable
    3. run each candidate with several steps and compare with 1: error(h) ~ C h^p predicts the step
       with the requested error, and a run with this step confirms it
    4. choose the candidate with the fewest evaluations of forward dynamics per second of motion
Implicit candidates are tried if stability limits the step of the explicit one. A symplectic one is
tried for a conservative motion whose horizon is longer than the trial run. In that case errors grow
with t for symplectic methods and with t^2 for others (Hairer, Lubich & Wanner, *Geometric Numerical
Integration*, X.3). Otherwise they are assumed to grow with t.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax import solvers
from rbjax.display import displayed
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.dynamics.arguments import check_arrays
from rbjax.errors import InputError
from rbjax.forces.inputs import Source
from rbjax.model import Model, State, with_constants
from rbjax.motion.simulate import simulate
from rbjax.progress import Say, progress_line
from rbjax.recommend.recommendation import Recommendation, check_request, double
from rbjax.stability.runs.largest_step import stable_step
from rbjax.stability.runs.linearisation import motion_matrices

TRIAL = 10.0  # the longest trial run, s
RADIANS = 5e4  # the largest phase of the fastest mode in a trial run: about 100,000 steps
POINTS = 17  # times at which motions are compared
LOOKS = 9  # times at which the motion is linearised
MOST_STEPS = 2_000_000
LOOSE = 1e-3  # the accuracy above which order three is enough for stiff motion
TRIES = 14  # the largest number of runs of a candidate
ROLLED_ABOVE = 6  # dofs above which the rolled driver compiles faster
BRIEF = 1e4  # phase of the fastest mode, rad, up to which the rolled driver saves time


class SolverTrial(NamedTuple):
    """A measured candidate."""

    name: str  # of the solver
    dt: float  # the largest accurate step, s
    error: float  # at this step
    cost: float  # evaluations of forward dynamics per second of motion
    success: bool  # whether there is an accurate step


@displayed
@dataclass(frozen=True)
class SolverRecommendation(Recommendation):
    """A solver and a step for `rb.simulate(model, state, ts, solver=r.solver, dt=r.dt)`.

    Fields, in addition to the fields of `Recommendation` (cost: evaluations of forward dynamics per
    second of motion):
        solver: a solver of `rb.solvers.all()`.
        dt: the step, s.
        predicted_error: the largest deviation of a configuration coordinate over the horizon, m or
            rad.
    """

    solver: diffrax.AbstractSolver
    dt: float
    predicted_error: float


@dataclass(frozen=True)
class Candidate:
    """A solver with its order, its evaluations per step, and the power of t by which its error
    grows."""

    name: str
    solver: diffrax.AbstractSolver
    order: int
    evaluations: float
    growth: float = 1.0


@eqx.filter_jit
def _reference(
    model: Model, state: State, ts: jax.Array, ctrl: Any, solver: Any, tolerance: Any
) -> Any:
    return simulate(
        model, state, ts, ctrl, solver=solver, throw=False, max_steps=MOST_STEPS,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        adjoint=diffrax.ForwardMode(),
    )  # fmt: skip


@eqx.filter_jit
def _error(
    model: Model, state: State, ts: jax.Array, ctrl: Any, solver: Any, dt: Any, truth: jax.Array
) -> jax.Array:
    """Compute the largest deviation of a coordinate from a reference motion (T, nq)."""
    path = simulate(
        model, state, ts, ctrl, solver=solver, dt=dt, throw=False, max_steps=MOST_STEPS,
        adjoint=diffrax.ForwardMode(),
    )  # fmt: skip
    gap = jax.vmap(lambda a, b: difference(model, a, b))(truth, path.q)
    return jnp.where(path.success, jnp.abs(gap).max(), jnp.inf)


def _controls(ctrl: Source | None, ts: np.ndarray, states: State) -> jax.Array | None:
    if ctrl is None:
        return None
    return jnp.stack([ctrl(t, State(q, v)) for t, q, v in zip(ts, states.q, states.v, strict=True)])


def _largest_step(
    error: Callable[[float], float], start: float, most: float, order: int, target: float
) -> tuple[float, float] | None:
    """Find the largest step whose error is at most the target. Return the step and its error, or
    None."""
    good: tuple[float, float] | None = None
    bad, h = math.inf, min(start, most)
    for _ in range(TRIES):
        e = error(h)
        factor = (0.6 * target / max(e, 1e-3 * target)) ** (1 / order) if math.isfinite(e) else 0.0
        if e <= target:
            good = (h, e)
            if e > 0.4 * target or h >= most:
                break
            new = min(h * min(factor, 4.0), most)
            new = math.sqrt(h * bad) if new >= bad else new
            if new < 1.05 * h:
                break
        else:
            bad = h
            new = h * min(max(factor, 1 / 8), 0.8)
            if good is not None:
                new = math.sqrt(good[0] * h)
                if new < 1.05 * good[0]:
                    break
        h = new
    return good


def _explicit(model: Model) -> Candidate:
    if model.topology.quaternion_starts:
        return Candidate("rkmk4", solvers.rkmk(4), 4, 7.0, 2.0)  # two for the dense output
    return Candidate("rk4", solvers.RK4(), 4, 4.0, 2.0)


def _implicit(nv: int, accuracy: float) -> Candidate:
    """Choose an implicit candidate. Its evaluations are the stages, 2 nv for a Jacobian, and about
    five iterations for Radau."""
    if accuracy >= LOOSE:
        return Candidate("ros34pw2", solvers.ros34pw2(), 3, 6.0 + 2 * nv, 2.0)
    return Candidate("radau_iia3", solvers.radau_iia(3), 5, 17.0 + 2 * nv, 2.0)


def _symplectic(nv: int, free_of_v: bool) -> Candidate:
    if free_of_v:
        return Candidate("yoshida4", solvers.yoshida4(velocity_forces=False), 4, 6.0)
    return Candidate("variational_midpoint", solvers.VariationalMidpoint(), 2, 10.0 + 3 * nv)


def solver(
    model: Model,
    state: State,
    accuracy: float,
    *,
    horizon: float = 1.0,
    ctrl: Source | None = None,
    progress: bool = True,
) -> SolverRecommendation:
    """Recommend a solver and a constant step for the motion of a robot from a state.

    error(h) ~ C h^p is fitted and confirmed by a run. Of the stable steps that are accurate enough,
    the recommendation is the one with the fewest evaluations per second of motion.

    Args:
        model: the robot.
        state: initial q (nq,), v (nv,).
        accuracy: the largest deviation of a configuration coordinate over the horizon, in m and
            rad, at least 1e-10.
        horizon: duration of the motion, s. Only the first 10 s are run, and the error is
            extrapolated.
        ctrl: (t, state) -> (nu,), as for `rb.simulate`; None for no actuation.
        progress: whether to display the progress on the terminal.

    Returns:
        `SolverRecommendation`.

    Raises:
        InputError: a state of the wrong type or shape, or not finite; an accuracy or a horizon that
            is not a number, not positive, or too fine; a motion that is not finite, or that no
            candidate reproduces with this accuracy.

    It compiles one program for the reference, one for the linearisation and one for each candidate
    (one to three). It always computes in f64.

    Source: Hairer & Wanner, *Solving ODEs II*, IV.2 (stiffness as a limit of stability).

    Example:
        >>> import rbjax as rb, numpy as np
        >>> model = rb.load("pendulum")
        >>> r = rb.recommend.solver(model, rb.State(np.array([0.5]), np.zeros(1)), 1e-6)
        >>> r.name, "accuracy decides" in r.reason, r.predicted_error <= 1e-6
        ('rk4', True, True)
    """
    check_request(accuracy, progress, horizon=horizon)
    with jax.enable_x64(True):
        state = check_arrays("recommend", model, {"state": state})["state"]
        if not model.nv:
            raise InputError("recommend: the model has no joints, so nothing moves")
        model = with_constants(jax.tree.map(double, model), jnp.float64)
        state = State(*(jnp.asarray(x, jnp.float64) for x in (state.q, state.v)))
        with progress_line("recommend", progress) as say:
            return _recommended(model, state, float(accuracy), float(horizon), ctrl, say)


def _light(model: Model) -> Model:
    """Return the model with the driver that compiles fastest."""
    rolls = model.driver == "auto" and model.nv > ROLLED_ABOVE
    return model.replace(driver="rolled") if rolls else model


def _recommended(
    model: Model, state: State, accuracy: float, horizon: float, ctrl: Source | None, say: Say
) -> SolverRecommendation:
    light = _light(model)
    say("linearising the motion")
    start = State(*(jnp.tile(x, (LOOKS, 1)) for x in (state.q, state.v)))
    A = motion_matrices(light, start, _controls(ctrl, np.zeros(LOOKS), start))
    fastest = _fastest(A)
    trial = min(horizon, TRIAL)
    # oscillations must be resolved; for pure decay an implicit reference is sufficient
    following = abs(fastest.imag) * trial <= RADIANS
    trial = trial if following else RADIANS / abs(fastest)
    stiff = abs(fastest) * trial > RADIANS
    method = solvers.radau_iia(3) if stiff else diffrax.Dopri8()
    model = light if abs(fastest) * trial < BRIEF else model
    say(f"the motion itself, by {type(method).__name__}")
    ts = jnp.linspace(0.0, trial, POINTS)
    longer = horizon / trial
    tolerance = jnp.asarray(max(1e-13, 1e-4 * accuracy / longer**2))
    truth = _reference(model, state, ts, ctrl, method, tolerance)
    if not bool(truth.success):
        raise InputError(
            f"recommend: the motion over {trial:.3g} s could not be followed by "
            f"{type(method).__name__} at tolerance {float(tolerance):.0e}; look at it with "
            "rb.simulate(..., throw=False)"
        )
    looks = np.linspace(0, POINTS - 1, LOOKS).astype(int)
    along = State(truth.q[looks], truth.v[looks])
    A = motion_matrices(light, along, _controls(ctrl, np.asarray(ts[looks]), along))
    fastest = _fastest(A)

    nv = model.nv
    conservative = ctrl is None and not np.asarray(model.joints.damping).any()

    def measured(c: Candidate, most: float) -> tuple[float, float, Candidate] | None:
        scale = longer ** (c.growth if conservative else 1.0)

        def error(h: float) -> float:
            say(f"{c.name} with steps of {h:.2g} s")
            return scale * float(_error(model, state, ts, ctrl, c.solver, jnp.asarray(h), truth.q))

        found = _largest_step(error, min(most / 2, trial / 32), most, c.order, accuracy)
        return None if found is None else (*found, c)

    explicit = _explicit(model)
    limit = stable_step("rk4", A)
    most = min(0.95 * limit, trial / 4)
    found = {explicit.name: measured(explicit, most)}
    held = found[explicit.name]
    by_stability = held is None or (held[0] > 0.9 * limit * 0.95 and held[1] < 0.4 * accuracy)
    others: list[Candidate] = []
    if by_stability and limit < math.inf:
        others.append(_implicit(nv, accuracy))
    if conservative and longer > 1:
        free_of_v = bool(np.abs(A[:, nv:, nv:]).max() == 0)
        others.append(_symplectic(nv, free_of_v))
    for c in others:
        found[c.name] = measured(c, trial / 4)
    good = [x for x in found.values() if x is not None]
    if not good:
        raise InputError(
            f"recommend: none of {list(found)} keeps within {accuracy:.1e} over {horizon:g} s "
            f"in {TRIES} tries each (fastest eigenvalue {abs(fastest):.2g} 1/s); give a larger "
            "accuracy or a shorter horizon"
        )
    h, e, best = min(good, key=lambda x: x[2].evaluations / x[0])
    trials = tuple(_trial(name, x) for name, x in found.items())
    why = _reason(best, h, e, accuracy, horizon, explicit, held, limit, abs(fastest), by_stability)
    return SolverRecommendation(best.name, best.evaluations / h, trials, why, best.solver, h, e)


def _trial(name: str, found: tuple[float, float, Candidate] | None) -> SolverTrial:
    if found is None:
        return SolverTrial(name, math.nan, math.inf, math.inf, False)
    h, error, candidate = found
    return SolverTrial(name, h, error, candidate.evaluations / h, True)


def _fastest(A: np.ndarray) -> complex:
    eigenvalues = np.linalg.eigvals(A).ravel()
    return complex(eigenvalues[np.abs(eigenvalues).argmax()])


def _reason(
    best: Candidate, h: float, e: float, accuracy: float, horizon: float, explicit: Candidate,
    held: tuple[float, float, Candidate] | None, limit: float, fastest: float, by_stability: bool,
) -> str:  # fmt: skip
    """Explain the choice by the deciding criterion and its number."""
    met = (
        f"{best.name} with steps of {h:.2g} s has an error of {e:.1e} (requested: {accuracy:.1e}) "
        f"over {horizon:g} s, with {best.evaluations / h:.2g} evaluations a second"
    )
    if best.growth == 1.0:
        return (
            f"the horizon decides: over {horizon:g} s the error of a symplectic method grows "
            f"with t, the error of {explicit.name} with t^2; {met}"
        )
    if by_stability:
        there = "no step was found" if held is None else f"its error is only {held[1]:.1e}"
        return (
            f"stability decides: the fastest eigenvalue, {fastest:.2g} 1/s, limits {explicit.name} "
            f"to steps of {limit:.2g} s, where {there}; {met}"
        )
    allowed = "any step" if limit == math.inf else f"steps of {limit:.2g} s"
    return (
        f"accuracy decides: stability would allow {explicit.name} {allowed} (fastest eigenvalue "
        f"{fastest:.2g} 1/s); {met}"
    )
