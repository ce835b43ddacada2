"""Motion linearised about its states, and the largest step that each method stands there.

    d/dt [dq; dv] = A [dq; dv],    A = [[-[w]x, 1], [da/dq, da/dv]],    control held
with dq on the tangent space (body axes for attitudes, hence -[w]x) and a = FD(q, v, applied
forces), so that springs, dampers and the gains of servos are in it. A method is stable at a step h
where every decaying mode of A decays: h lambda lies in its region, for every eigenvalue lambda. A
method for q' = v, v' = K q + D v is asked itself: its step's matrix on that pair has no root
outside the unit circle. Modes that grow by nature do not count.
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
from rbjax.dynamics.arguments import algorithm
from rbjax.dynamics.forward import acceleration
from rbjax.dynamics.manifold import difference, integrate
from rbjax.errors import InputError
from rbjax.forces.applied import applied
from rbjax.model import Model, State
from rbjax.rollout import INTEGRATORS, rollout
from rbjax.simulate import simulate
from rbjax.stability.multistep_roots import characteristic
from rbjax.stability.oscillator import DOUBLE, matrices_of_pair
from rbjax.stability.stability_function import Solver, made

#: an integrator of `rb.rollout` -> the solver that takes the same step
ROLLOUT = {"semi_implicit_euler": "symplectic_euler", "rk4": "rk4"}
PAIRS = (
    solvers.GeneralizedAlpha, solvers.CentralDifferences, solvers.SemiImplicitEuler,
    solvers.VariationalMidpoint, solvers.Splitting,
)  # fmt: skip
SLACK = 1e-9  # of a growth factor over one
NEAR, FAR, POINTS = 1e-3, 1e4, 600  # |h lambda| looked at
SMALL, GROWN = 1e-9, 1e5  # a deviation, and what it grows by where a step is too large


@algorithm("state", "ctrl")
def state_matrix(model: Model, state: State, ctrl: jax.Array | None = None) -> jax.Array:
    """A (2 nv, 2 nv) of the linearised motion d/dt [dq; dv] = A [dq; dv], the control held.

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))` about which to linearise.
        ctrl: (nu,) controls; None for no actuation.

    Returns:
        (2 nv, 2 nv) in 1/s and 1/s^2; dq on the tangent space, in the coordinates of v.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite.

    Source: Carpentier & Mansard, *Analytical derivatives of rigid body dynamics*, RSS 2018.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rb.stability.state_matrix(model, model.default_state()).shape
        (4, 4)
    """
    return _linearised(model, state, ctrl)[1]


def _linearised(model: Model, state: State, ctrl: Any) -> tuple[jax.Array, jax.Array]:
    """The acceleration (nv,), and A."""
    n = model.nv

    def rate(x):
        q, v = integrate(model, state.q, x[:n]), state.v + x[n:]
        a = acceleration(model, q, v, applied(model, q, v, ctrl))
        return a, a

    lower, a = jax.jacfwd(rate, has_aux=True)(jnp.zeros(2 * n, state.q.dtype))
    turning = jnp.zeros((n, n), state.q.dtype)
    for start in model.topology.turn_starts:
        rows = slice(start, start + 3)
        turning = turning.at[rows, rows].set(-jnp.cross(state.v[rows], jnp.eye(3)).T)
    upper = jnp.concatenate([turning, jnp.eye(n, dtype=state.q.dtype)], 1)
    return a, jnp.concatenate([upper, lower])


@jax.jit
def _matrices(model: Model, q: jax.Array, v: jax.Array, ctrl: jax.Array | None) -> jax.Array:
    axis = None if ctrl is None or ctrl.ndim == 1 else 0
    along = jax.vmap(lambda q, v, u: state_matrix(model, State(q, v), u), (0, 0, axis))
    return along(q, v, ctrl)


def motion_matrices(model: Model, states: State, ctrl: Any = None) -> np.ndarray:
    """`state_matrix` (T, 2 nv, 2 nv) at states q (T, nq), v (T, nv); ctrl (nu,), (T, nu) or None.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> model = rb.load("pendulum")
        >>> state = rb.State(np.zeros((3, 1)), np.zeros((3, 1)))
        >>> np.linalg.eigvals(rb.stability.motion_matrices(model, state)).shape
        (3, 2)
    """
    q, v = jnp.asarray(states.q), jnp.asarray(states.v)
    if q.ndim != 2 or v.ndim != 2 or len(q) != len(v):
        raise InputError(
            f"motion_matrices: q has shape {q.shape} and v {v.shape}, expected (T, nq), (T, nv)"
        )
    ctrl = None if ctrl is None else jnp.asarray(ctrl, q.dtype)
    return np.asarray(_matrices(model, q, v, ctrl), np.float64)


def stable_step(method: Solver, matrices: Any) -> float:
    """The largest step up to which every decaying mode decays, as theory predicts it.

    Args:
        method: a name of `rb.solvers.all()`, or a solver. `ROLLOUT[integrator]` is that of
            `rb.rollout`.
        matrices: A (2 nv, 2 nv) or (T, 2 nv, 2 nv), of `state_matrix` or `motion_matrices`.

    Returns:
        Seconds; inf where no step is too large, 0 where none is small enough.

    Raises:
        InputError: solvers without linear theory.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> A = rb.stability.state_matrix(model, model.default_state())
        >>> h = rb.stability.stable_step("stoermer_verlet", A)
        >>> bool(abs(h * abs(np.linalg.eigvals(A)).max() - 2) < 0.02)
        True
    """
    A = np.asarray(matrices, np.float64).reshape(-1, *np.shape(matrices)[-2:])
    solver = made(method)
    if isinstance(solver, PAIRS):
        return min(_of_pair(solver, a) for a in A)
    phi = characteristic(solver)
    eigenvalues = np.linalg.eigvals(A).ravel()
    size = np.abs(eigenvalues)
    counts = (size > 1e-7 * size.max()) & (eigenvalues.real < 1e-9 * size)
    found = np.unique(eigenvalues[counts].round(12))
    found = found[found.imag >= 0]
    return min((_along_ray(phi.radius, x) for x in found), default=math.inf)


def _along_ray(radius: Callable[[Any], np.ndarray], eigenvalue: complex) -> float:
    """The h up to which h lambda stays in the region."""

    def unstable(h):
        return ~(radius(h * eigenvalue) <= 1 + SLACK)

    return _first(unstable, 1 / abs(eigenvalue))


def _of_pair(solver: Any, A: np.ndarray) -> float:
    n = len(A) // 2
    K, D = A[n:, :n], A[n:, n:]
    eigenvalues = np.linalg.eigvals(A)
    natural = max(eigenvalues.real.max(), 0.0)

    def unstable(h):
        h = np.atleast_1d(h)[:, None, None]
        grown = np.abs(np.linalg.eigvals(matrices_of_pair(solver, h * h * K, h * D))).max(-1)
        return ~(grown <= np.exp(natural * h[:, 0, 0]) + DOUBLE)

    return _first(unstable, 1 / max(np.abs(eigenvalues).max(), 1e-12))


def _first(unstable: Callable[[np.ndarray], np.ndarray], scale: float) -> float:
    """The first h at which a method is unstable, on nested grids of one size, in `scale`."""
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
    model: Model, state: State, beside: State, ctrl: Any, dt: Any, method: Any, steps: int
) -> jax.Array:
    """How far from `state` the motion from beside it ends after so many steps, by where it began.

    The state is at rest; a second motion from there would be lost to rounding like the first.
    """
    if isinstance(method, str):
        ctrls = None if ctrl is None else jnp.broadcast_to(ctrl, (steps, *ctrl.shape))
        path = rollout(
            model, beside, ctrls, dt, integrator=method, steps=steps, save_every=steps,
            kernel=False,
        )  # fmt: skip
    else:
        control = None if ctrl is None else (lambda t, _: ctrl)
        ts = jnp.array([0.0, 1.0]) * dt * steps * (1 - 1e-12)
        path = simulate(
            model, beside, ts, control, solver=method, dt0=dt, throw=False, max_steps=steps + 1,
            adjoint=diffrax.ForwardMode(),
        )  # fmt: skip

    def away(x):
        return jnp.linalg.norm(jnp.concatenate([difference(model, state.q, x.q), x.v - state.v]))

    return away(path.state(-1)) / away(beside)


def measured_stable_step(
    method: Solver,
    model: Model,
    state: State,
    ctrl: Any = None,
    *,
    near: float,
    steps: int = 2000,
) -> float:
    """The largest step at which a small deviation from an equilibrium does not grow, by running.

    A motion starts 1e-9 beside it and takes `steps` steps; the interval between a step that is
    stable and one that is not is halved: sharp to about 10 / steps.

    Args:
        method: "rollout semi_implicit_euler" or "rollout rk4", the integrators of `rb.rollout`;
            or a name of `rb.solvers.all()` or a solver, run by `rb.simulate`.
        model: the robot.
        state: an equilibrium under ctrl.
        ctrl: (nu,) held control, or None.
        near: a step to search around, from a quarter of it to four times it.
        steps: of each run.

    Returns:
        Seconds; 0 where a quarter of `near` is unstable, inf where four times it is stable.

    Raises:
        InputError: an unknown integrator; what `rb.simulate` refuses.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> found = rb.stability.measured_stable_step(
        ...     "rollout semi_implicit_euler", model, model.default_state(), near=0.5, steps=400)
        >>> 0.3 < found < 0.7
        True
    """
    run: Any = method
    if isinstance(method, str) and method.startswith("rollout "):
        run = method.removeprefix("rollout ")
        if run not in INTEGRATORS:
            raise InputError(
                f"measured_stable_step: integrator {run!r}, expected one of {list(INTEGRATORS)}"
            )
    else:
        run = made(method)
    rng = np.random.default_rng(0)
    q, v = jnp.asarray(state.q), jnp.asarray(state.v)
    kick = SMALL * rng.normal(size=(2, model.nv))
    beside = State(integrate(model, q, jnp.asarray(kick[0], q.dtype)), v + kick[1])
    ctrl = None if ctrl is None else jnp.asarray(ctrl, q.dtype)

    def stable(dt: float) -> bool:
        found = _deviation(model, State(q, v), beside, ctrl, jnp.asarray(dt, q.dtype), run, steps)
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


def equilibrium(model: Model, state: State, ctrl: Any = None, *, steps: int = 50) -> State:
    """The state at rest beside `state` where nothing accelerates under a held control.

    Newton's method on a(q, 0) = 0, least squares where the equilibrium is not isolated.

    Args:
        model: the robot.
        state: where to begin; its velocity is not used.
        ctrl: (nu,), or None.
        steps: at most so many.

    Raises:
        InputError: if no such state is found.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> model = rb.load("pendulum")
        >>> rest = rb.stability.equilibrium(model, rb.State(np.array([0.3]), np.zeros(1)))
        >>> bool(abs(rest.q[0]) < 1e-9)
        True
    """
    q, v = jnp.asarray(state.q), jnp.zeros_like(jnp.asarray(state.v))
    ctrl = None if ctrl is None else jnp.asarray(ctrl, q.dtype)
    n, find = model.nv, jax.jit(_linearised)
    for _ in range(steps):
        a, A = map(np.asarray, find(model, State(q, v), ctrl))
        if np.abs(a).max() < 1e3 * np.finfo(q.dtype).eps * (1 + np.abs(A).max()):
            return State(q, v)
        dq = np.linalg.lstsq(A[n:, :n], -a, rcond=1e-10)[0]
        dq = dq * min(1.0, 0.5 / max(np.abs(dq).max(), 1e-300))
        q = integrate(model, q, jnp.asarray(dq, q.dtype))
    raise InputError(
        f"equilibrium: an acceleration of {np.abs(a).max():.1e} is left after {steps} steps; "
        "begin nearer to a state of rest, if there is one"
    )


