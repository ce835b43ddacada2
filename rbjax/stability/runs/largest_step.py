"""The largest step at which a method is stable on a robot's motion: predicted, and measured.

A method is stable at a step h if every mode that grows also grows in the exact linearised motion.
So h lambda must lie in the stability region for every eigenvalue lambda of A (`linearisation`) with
Re lambda <= 0. For methods for q' = v, v' = K q + D v the matrix of the method's own step is used.
It must not have more eigenvalues outside the unit circle than the pair has growing modes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax import solvers
from rbjax.arguments import integer, real_array, real_number
from rbjax.dynamics.algorithms.manifold import difference, integrate
from rbjax.errors import InputError
from rbjax.model import Model, State
from rbjax.motion.integrators import INTEGRATORS
from rbjax.motion.rollout import rollout
from rbjax.motion.simulate import simulate
from rbjax.solvers.tableau import DOP853
from rbjax.stability.methods import Solver, fixed_step_solver, solver_of
from rbjax.stability.runs.linearisation import at_rest
from rbjax.stability.theory.multistep_roots import Method, Theory, characteristic
from rbjax.stability.theory.oscillator import matrices_of_pair
from rbjax.stability.theory.regions import imaginary_limit

#: integrator of `rb.rollout` -> the solver that computes the same step
ROLLOUT: dict[str, Solver] = {
    "semi_implicit_euler": "symplectic_euler",
    "rk4": "rk4",
    "tsit5": diffrax.Tsit5(),
    "dopri8": diffrax.Dopri8(),
    "dop853": solvers.MuntheKaas(DOP853),
}
PAIRS = (
    solvers.GeneralizedAlpha, solvers.CentralDifferences, solvers.SemiImplicitEuler,
    solvers.VariationalMidpoint, solvers.Splitting,
)  # fmt: skip
AXIS = 1e-9  # largest |Re lambda| / |lambda| of an undamped vibration, from rounding
SLACK = 1e-12  # allowed excess of a growth factor over one
GREW = 1e-6  # allowed excess for a step's matrix; its double roots have errors of sqrt(rounding)
ROUNDING = 1e-14  # error of the smaller factors, relative to the largest
NEAR, FAR, POINTS = 1e-3, 1e4, 600  # range and number of |h lambda| on the first grid
SMALL, GROWN = 1e-9, 1e5  # initial deviation, and its growth beyond which a step is unstable


def stable_step(method: Method, matrices: Any) -> float:
    """Predict the largest step at which no mode grows that does not also grow in the exact motion.

    zeta is the factor by which a mode grows in a step. Undamped vibrations are included. For them
    the limit of a method for y' = f is exact, `imaginary_limit` / |lambda|. It is 0 for methods
    such as Heun's, with which every vibration grows, however slowly (`spectral_radius` returns the
    growth). For damped modes |zeta| may exceed one by 1e-12. Steps of methods for q' = v, v' = a
    are measured without the rotation of a body's axes, [w]x in A, and |zeta| may exceed one by
    1e-6.

    Args:
        method: a name, a solver, a tableau or a polynomial, as for `linear_analysis`; or a solver
            of q' = v, v' = a. `ROLLOUT[integrator]` is the method of `rb.rollout`.
        matrices: A (2 nv, 2 nv) or (T, 2 nv, 2 nv), from `state_matrix` or `motion_matrices`.

    Returns:
        Step in seconds; inf if no step is too large, 0 if none is small enough.

    Raises:
        InputError: a solver without linear theory, or matrices of another shape or not finite.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> A = rb.stability.state_matrix(model, model.default_state())
        >>> h = rb.stability.stable_step("stoermer_verlet", A)
        >>> bool(abs(h * abs(np.linalg.eigvals(A)).max() - 2) < 0.02)
        True
    """
    A = _square(matrices)
    solver = method if isinstance(method, Theory) else solver_of(method)
    if isinstance(solver, PAIRS):
        return min(_of_pair(solver, a) for a in A)
    phi = characteristic(solver)
    eigenvalues = np.linalg.eigvals(A).ravel()
    size = np.abs(eigenvalues)
    counts = (size > 1e-7 * size.max()) & (eigenvalues.real <= AXIS * size)
    found = np.unique(eigenvalues[counts].round(12))
    found = found[found.imag >= 0]
    on_axis = np.abs(found.real) <= AXIS * np.abs(found)
    limits = [_along_ray(phi.radius, x) for x in found[~on_axis]]
    if on_axis.any():
        limits.append(imaginary_limit(phi) / float(np.abs(found[on_axis]).max()))
    return min(limits, default=math.inf)


def _square(matrices: Any) -> np.ndarray:
    """Return the matrices as an array (T, 2 nv, 2 nv)."""
    expected = "an array (2 nv, 2 nv) or (T, 2 nv, 2 nv)"
    A = real_array("stable_step", "matrices", matrices, expected, finite=False)
    if A.ndim not in (2, 3) or A.shape[-1] != A.shape[-2] or A.shape[-1] % 2 or not A.size:
        raise InputError(
            f"stable_step: matrices have shape {A.shape}, expected (2 nv, 2 nv) or "
            "(T, 2 nv, 2 nv), of state_matrix or motion_matrices"
        )
    if not np.isfinite(A).all():
        raise InputError(
            "stable_step: matrices are not finite; check the motion that they come from"
        )
    return A.reshape(-1, *A.shape[-2:])


def _along_ray(radius: Callable[[Any], np.ndarray], eigenvalue: complex) -> float:
    """Return the largest h such that h lambda stays in the stability region."""

    def unstable(h):
        return ~(radius(h * eigenvalue) <= 1 + SLACK)

    return _first(unstable, 1 / abs(eigenvalue))


def _of_pair(solver: Any, A: np.ndarray) -> float:
    """Return the smallest h at which the solver has more growth factors above 1 than growing modes.

    The modes are those of q' = v, v' = K q + D v. Factors are only counted, because at long steps
    they cannot be matched with modes.
    """
    n = len(A) // 2
    K, D = A[n:, :n], A[n:, n:]
    rates = np.linalg.eigvals(np.block([[np.zeros((n, n)), np.eye(n)], [K, D]]))

    def unstable(h):
        h = h[:, None, None]
        step = matrices_of_pair(solver, h * h * K, h * D)
        broken = ~np.isfinite(step).all((-2, -1))
        step = np.where(broken[:, None, None], 0, step)
        factors = np.abs(np.linalg.eigvals(step))
        rounding = ROUNDING * factors.max(-1, keepdims=True)  # of the smaller factors
        natural = h[:, 0] * rates.real > GREW / 2
        return broken | ((factors > 1 + GREW + rounding).sum(-1) > natural.sum(-1))

    return _first(unstable, 1 / max(np.abs(rates).max(), 1e-12))


def _first(unstable: Callable[[np.ndarray], np.ndarray], scale: float) -> float:
    """Return the first h at which a method is unstable, on nested grids. `scale` is the unit of
    h."""
    grid = np.geomspace(NEAR, FAR, POINTS) * scale
    bad = unstable(grid)
    if not bad.any():
        return math.inf
    if bad[0]:
        return 0.0
    while grid[-1] - grid[0] > 1e-9 * grid[-1]:
        first = int(bad.argmax())
        grid = np.linspace(grid[first - 1], grid[first], POINTS)
        bad = unstable(grid)
        bad[0], bad[-1] = False, True
    return float(grid[0])


@eqx.filter_jit
def _deviation(
    model: Model, state: State, nearby: State, ctrl: Any, dt: Any, method: Any, steps: int
) -> jax.Array:
    """Return the deviation of a motion from the equilibrium `state` at its end, divided by the
    deviation of its initial state `nearby`.

    The reference is `state` itself, not a simulated motion from it.
    """
    if isinstance(method, str):
        ctrls = None if ctrl is None else jnp.broadcast_to(ctrl, (steps, *ctrl.shape))
        path = rollout(
            model, nearby, ctrls, dt, integrator=method, steps=steps, save_every=steps,
            kernel=False,
        )  # fmt: skip
    else:
        control = None if ctrl is None else (lambda t, _: ctrl)
        ts = jnp.array([0.0, 1.0]) * dt * steps * (1 - 1e-12)
        path = simulate(
            model, nearby, ts, control, solver=method, dt=dt, throw=False, max_steps=steps + 1,
            adjoint=diffrax.ForwardMode(),
        )  # fmt: skip

    def away(x):
        return jnp.linalg.norm(jnp.concatenate([difference(model, state.q, x.q), x.v - state.v]))

    return away(path.state(-1)) / away(nearby)


def measured_stable_step(
    method: Solver,
    model: Model,
    state: State,
    ctrl: Any = None,
    *,
    near: float,
    steps: int = 2000,
) -> float:
    """Measure the largest step at which a small deviation from an equilibrium does not grow.

    A motion starts at a deviation of 1e-9 and takes `steps` steps. The interval between a stable
    and an unstable step is bisected. A step is unstable if the deviation grows by 1e5, that is
    |zeta| > 1 + 12 / steps. The result is accurate to about 10 / steps if |zeta| crosses one at a
    slope. A weak instability is not detected: for Tsit5 on a pendulum without friction the measured
    step is 1.61 / omega, but by theory the motion grows from 0.478 / omega.

    Args:
        method: "rollout rk4" or another integrator of `rb.rollout`; or a name of
            `rb.solvers.all()`, a solver or an `rb.solvers.Tableau`, run by `rb.simulate`.
        model: the robot.
        state: a stable equilibrium under ctrl (`equilibrium` finds one).
        ctrl: (nu,) constant control, or None.
        near: expected step, s. The search covers steps from near / 4 to 4 near.
        steps: number of steps of each run, at least 10.

    Returns:
        Step in seconds; 0 if near / 4 is unstable, inf if 4 near is stable.

    Raises:
        InputError: an unknown integrator or method; a state that is not a stable equilibrium;
            `near` not positive, too few `steps`, or wrong shapes.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> found = rb.stability.measured_stable_step(
        ...     "rollout semi_implicit_euler", model, model.default_state(), near=0.5)
        >>> round(found, 2)
        0.52
    """
    run: Any = method
    if isinstance(method, str) and method.startswith("rollout "):
        run = method.removeprefix("rollout ")
        if run not in INTEGRATORS:
            raise InputError(
                f"measured_stable_step: integrator {run!r}, expected one of {list(INTEGRATORS)}"
            )
    else:
        run = fixed_step_solver(method)
    real_number("measured_stable_step", "near", near, "a time above zero, in s", above=0.0)
    integer("measured_stable_step", "steps", steps, least=10)
    state = at_rest("measured_stable_step", model, state, ctrl)
    rng = np.random.default_rng(0)
    q, v = state.q, state.v
    kick = SMALL * rng.normal(size=(2, model.nv))
    nearby = State(integrate(model, q, jnp.asarray(kick[0], q.dtype)), v + kick[1])
    ctrl = None if ctrl is None else jnp.asarray(ctrl, q.dtype)

    def stable(dt: float) -> bool:
        found = _deviation(model, State(q, v), nearby, ctrl, jnp.asarray(dt, q.dtype), run, steps)
        return bool(found < GROWN)

    low, high = near / 4, near * 4
    if not stable(low):
        return 0.0
    if stable(high):
        return math.inf
    while high - low > low / steps:
        mid = math.sqrt(low * high)
        low, high = (mid, high) if stable(mid) else (low, mid)
    return low
