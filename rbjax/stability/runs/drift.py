"""Long runs of equal steps in constant memory, drift of invariants, and a test of its slope.

    y_{n+1} = step(t_n, h, y_n),    t_n = n h;    keep(t, y, args) after every `every` steps
One compiled program runs any number of steps. They are the solver's own steps, without
interpolation, controller or checkpoints. A run stops before a state that is not finite, or if the
root of an implicit step is not found; `ending` is the reason. The remaining samples repeat the last
finite one, at times that are nan.

    x_k = a + s t_k + oscillation;    s by least squares over the means of B blocks,
    its error from the residuals,    sigma^2 = (1 + r) / (1 - r) sum e^2 / (B - 2) / sum (t - t_)^2
r is the correlation of neighbours. If r is near 1, the residual may be a random walk, as from
rounding. The variance of its slope is then 6/5 B var(dx) / T^2, with dx the differences between
blocks. A symplectic method keeps the energy within an oscillation that does not grow for
exponentially long times (backward error analysis; Hairer, Lubich & Wanner, *Geometric Numerical
Integration*, IX.8). Other methods drift at a constant rate.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rbjax.arguments import instance, integer, real_array, real_number
from rbjax.display import displayed
from rbjax.dynamics import (
    center_of_mass,
    centroidal_momentum,
    kinetic_energy,
    potential_energy,
)
from rbjax.errors import InputError
from rbjax.forces import elastic_energy
from rbjax.lanes.arrays import select
from rbjax.model import Model, State, Topology
from rbjax.motion.term import make_term, unit_quaternions
from rbjax.stability.methods import Solver, fixed_step_solver

BLOCKS = 64  # number of block means of a series, to which the slope is fitted
SIGNIFICANT = 4.0  # standard errors beyond which a slope is a trend
WALK = 0.7  # correlation of neighbours beyond which residuals may be a random walk


#: values of `LongRun.ending`
DONE, NOT_FINITE, NO_ROOT = ENDINGS = range(3)

Keep = Callable[[Any, Any, Any], Any]  # (t, y, args) -> arrays to keep


@displayed
class LongRun(eqx.Module):
    """Samples along a long run, and how it ended.

    Fields:
        ts: (K + 1,) s; nan after an early end.
        kept: results of `keep`, each leaf (K + 1, ...); of the last state if ts is nan.
        y: last state.
        steps: () number of steps.
        ending: () `DONE`, `NOT_FINITE` or `NO_ROOT` of `rb.stability`.
    """

    ts: jax.Array
    kept: Any
    y: Any
    steps: jax.Array
    ending: jax.Array


def long_run(
    term: diffrax.AbstractTerm,
    solver: diffrax.AbstractSolver,
    y0: Any,
    dt: Any,
    keep: Keep,
    *,
    every: int,
    samples: int,
    args: Any = None,
) -> LongRun:
    """Run samples * every steps of dt from t = 0. One program serves all dt, `every`, y0 and
    args."""
    y0 = as_floats("a run", y0)
    dtype = jnp.result_type(*jax.tree.leaves(y0))
    check_times(dt, every * samples, dtype)
    return _run(term, solver, y0, jnp.asarray(dt, dtype), keep, jnp.asarray(every), samples, args)


@eqx.filter_jit
def _run(term, solver, y0, dt, keep, every, samples, args) -> LongRun:
    def sound(state):
        _, ending, _, _ = state
        return ending == DONE

    def once(state):
        n, _, y, memory = state
        t = n * dt
        y1, _, _, memory, result = solver.step(term, t, t + dt, y, args, memory, made_jump=False)
        found = result == diffrax.RESULTS.successful
        ending = jnp.where(found, jnp.where(finite(y1), DONE, NOT_FINITE), NO_ROOT)
        y1 = select(ending == DONE, y1, y)
        return n + (ending == DONE), ending, y1, memory

    def sample(state, _):
        until = state[0] + every
        state = jax.lax.while_loop(lambda s: (s[0] < until) & sound(s), once, state)
        t = state[0] * dt
        reached = jnp.where(sound(state), t, jnp.nan)
        return state, (reached, keep(t, state[2], args))

    memory = solver.init(term, 0 * dt, dt, y0, args)
    start = (jnp.zeros((), jnp.int32), jnp.full((), DONE), y0, memory)
    (steps, ending, y, _), later = jax.lax.scan(sample, start, length=samples)
    first = (0 * dt, keep(0 * dt, y0, args))
    ts, kept = jax.tree.map(lambda a, b: jnp.concatenate([jnp.asarray(a)[None], b]), first, later)
    return LongRun(ts, kept, y, steps, ending)


def finite(y: Any) -> jax.Array:
    """Return whether all numbers of a state are finite."""
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(y)]).all()


def as_floats(where: str, y: Any) -> Any:
    """Convert a state to finite arrays of one float dtype."""
    leaves = jax.tree.leaves(y)
    if not leaves or not all(hasattr(x, "dtype") or isinstance(x, (int, float)) for x in leaves):
        raise InputError(f"{where}: y0 is {y!r}, expected arrays of numbers")
    if not any(isinstance(x, jax.core.Tracer) for x in leaves):
        for x in leaves:
            real_array(where, "y0", x)
    dtype = jnp.result_type(*leaves)
    dtype = dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.result_type(float)
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), y)


def check_times(dt: Any, steps: int, dtype: Any) -> None:
    """Raise InputError for times that the dtype cannot resolve, with t + h - t different from h."""
    h = np.asarray(real_number("a run", "dt", dt, above=0.0), dtype)
    steps = integer("a run", "steps", steps, least=1)
    if not (np.isfinite(h) and h > 0):
        raise InputError(f"a run: dt is {dt} s, which is {h} in {np.dtype(dtype).name}")
    exact = np.frexp(h)[0] == 0.5 and steps * np.finfo(dtype).eps <= 1
    if not exact and steps * np.finfo(dtype).eps > 1e-3:
        power = float(2.0 ** np.round(np.log2(float(h))))
        raise InputError(
            f"got {steps} steps of dt = {dt} s in {np.dtype(dtype).name}, which cannot resolve "
            f"times of so many steps; take a power of two, dt = {power!r}, or float64"
        )


def resolve_system(
    where: str, system: Any, y0: Any, solver: Any, args: Any
) -> tuple[diffrax.AbstractTerm, Any, Any]:
    """Return the term, its state and its arguments, from a robot or a term.

    Raises:
        InputError: a system of another type, or a state of another shape.
    """
    if isinstance(system, Model):
        if not isinstance(y0, State):
            kind = type(y0).__name__
            raise InputError(f"{where}: y0 is {kind}, expected State(q, v) of the robot")
        if jnp.shape(y0.q) != (system.nq,) or jnp.shape(y0.v) != (system.nv,):
            raise InputError(
                f"{where}: y0 has q {jnp.shape(y0.q)} and v {jnp.shape(y0.v)}, expected "
                f"({system.nq},) and ({system.nv},)"
            )
        return *make_term(system, y0, solver), system
    instance(where, "system", system, diffrax.AbstractTerm, "a Model or a term of diffrax")
    return system, y0, args


def steps_of_a_sample(where: str, steps: Any, samples: Any) -> int:
    """Return the number of steps between two samples.

    Raises:
        InputError: `steps` is not a multiple of `samples`.
    """
    integer(where, "samples", samples, least=1)
    integer(where, "steps", steps, least=1)
    if steps % samples:
        raise InputError(
            f"{where}: got {steps} steps and {samples} samples, expected steps to be a multiple of "
            "samples"
        )
    return steps // samples


@displayed
class Trend(NamedTuple):
    """The slope of a series.

    Fields:
        slope: 1/s.
        error: standard error of the slope.
        change: slope times the whole time.
        amplitude: half of the spread about the line.
        drifts: whether the slope exceeds four standard errors and the change exceeds the amplitude.
    """

    slope: float
    error: float
    change: float
    amplitude: float
    drifts: bool


def trend(ts: ArrayLike, xs: ArrayLike) -> Trend:
    """Fit the slope of a series, with a standard error that accounts for oscillation.

    s = sum (t - t_) x / sum (t - t_)^2 over the means of 64 blocks.

    Args:
        ts: (T,) increasing times. After an early end of a run of `drift` they are nan.
        xs: (T,) the series.

    Returns:
        `Trend`, in the unit of xs per second.

    Raises:
        InputError: wrong shapes, values that are not finite, times that do not increase, or fewer
            than 16 samples.

    Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, IX.8.

    Example:
        >>> import numpy as np, rbjax as rb
        >>> t = np.linspace(0, 100, 1001)
        >>> rb.stability.trend(t, np.sin(7 * t)).drifts
        False
        >>> found = rb.stability.trend(t, np.sin(7 * t) + 0.05 * t)
        >>> found.drifts, round(found.slope, 3)
        (True, 0.05)
    """
    expected = "an array (T,) of numbers"
    t = real_array("trend", "ts", ts, expected, finite=False)
    x = real_array("trend", "xs", xs, expected, finite=False)
    if t.ndim != 1 or t.shape != x.shape or len(t) < 16:
        raise InputError(
            f"trend: got ts {t.shape} and xs {x.shape}, expected one shape (T,), T at least 16"
        )
    bad = int(np.sum(~(np.isfinite(t) & np.isfinite(x))))
    if bad:
        raise InputError(
            f"trend: {bad} of {len(t)} samples are not finite, expected all of ts and xs; after an "
            "early end of a run of drift (its ending is not DONE) times are nan: select with "
            "np.isfinite(ts)"
        )
    if not (np.diff(t) > 0).all():
        raise InputError("trend: ts must increase from the first to the last")
    blocks = min(BLOCKS, len(t) // 4)
    bt, bx = (np.array([part.mean() for part in np.array_split(a, blocks)]) for a in (t, x))
    away = bt - bt.mean()
    slope = float(away @ bx / (away @ away))
    rest = bx - bx.mean() - slope * away
    square = rest @ rest
    r = float(np.clip(rest[1:] @ rest[:-1] / square, 0.0, 0.99)) if square > 0 else 0.0
    error = float(np.sqrt(square / (blocks - 2) / (away @ away) * (1 + r) / (1 - r)))
    if r > WALK:
        whole = float(bt[-1] - bt[0])
        error = max(error, float(np.sqrt(1.2 * blocks * np.var(np.diff(bx))) / whole))
    change = slope * float(t[-1] - t[0])
    about = x - slope * t
    amplitude = float(np.ptp(about)) / 2
    drifts = abs(slope) > SIGNIFICANT * error and abs(change) > amplitude
    return Trend(slope, error, change, amplitude, bool(drifts))


@displayed
class Invariants(eqx.Module):
    """Function (t, state, model) -> dict of the invariants of a free robot.

    A fixed base and gravity change the momentum, and dampers take energy.

    Entries:
        energy: () J, including springs.
        momentum: (6,) angular about the world's origin, then linear.
        manifold: () largest | |quaternion| - 1 |.
    """

    def __call__(self, t: Any, y: State, model: Model) -> dict[str, jax.Array]:
        q, v = unit_quaternions(model.topology, y.q), y.v
        energy = kinetic_energy(model, q, v) + potential_energy(model, q) + elastic_energy(model, q)
        about = centroidal_momentum(model, q, v)
        linear = about[3:]
        angular = about[:3] + jnp.cross(center_of_mass(model, q), linear)
        return {
            "energy": energy,
            "momentum": jnp.concatenate([angular, linear]),
            "manifold": off_manifold(model.topology, y.q),
        }


def off_manifold(top: Topology, q: jax.Array) -> jax.Array:
    """Return the largest deviation of a quaternion's length from 1."""
    lengths = [jnp.sqrt((q[i : i + 4] ** 2).sum()) for i in top.quaternion_starts]
    return jnp.abs(jnp.stack(lengths) - 1).max() if lengths else jnp.zeros((), q.dtype)


def drift(
    system: Model | diffrax.AbstractTerm,
    y0: Any,
    keep: Callable[[Any, Any, Any], Any] | None = None,
    *,
    solver: Solver,
    dt: float,
    steps: int,
    samples: int = 1000,
    args: Any = None,
) -> LongRun:
    """Sample invariants along a run of equal steps, in memory that does not grow with the steps.

    y_{n+1} = step(t_n, h, y_n). keep(t, y, args) is sampled at the start and at `samples` later
    times.

    Args:
        system: a robot, or a diffrax term (`diffrax.ODETerm`, `rb.solvers.OnGroup`, ...).
        y0: `State(q (nq,), v (nv,))` of the robot, or the term's state. Its dtype, f32 or f64, is
            the dtype of the run.
        keep: (t, y, args) -> any arrays. If None, `rb.stability.Invariants` of a robot: energy,
            momentum and manifold.
        solver: a name of `rb.solvers.all()`, a solver of rbjax or diffrax, or an
            `rb.solvers.Tableau`, with equal steps.
        dt: step, s. In f32 over more than a few thousand steps it must be a power of two.
        steps: number of steps, a multiple of `samples`.
        samples: number of samples.
        args: arguments of the term. For a robot the model is used.

    Returns:
        `LongRun`: ts (samples + 1,), kept, y, steps, ending. After an early end (ending is not
        `DONE`) ts is nan, which `trend` does not accept.

    Raises:
        UnknownName: an unknown solver name.
        InputError: `steps` is not a multiple of `samples`; times that the dtype cannot resolve; a
            system or a solver of the wrong kind.

    Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, IX.8, X.

    Example:
        >>> import rbjax as rb, diffrax, jax.numpy as jnp
        >>> swing = diffrax.ODETerm(lambda t, y, args: (y[1], -jnp.sin(y[0])))
        >>> energy = lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0])
        >>> for solver in "rk4", "stoermer_verlet":
        ...     run = rb.stability.drift(
        ...         swing, (2.0, 0.0), energy, solver=solver, dt=0.1, steps=10_000)
        ...     print(rb.stability.trend(run.ts, run.kept).drifts)
        True
        False
    """
    every = steps_of_a_sample("drift", steps, samples)
    one = fixed_step_solver(solver)
    term, y0, args = resolve_system("drift", system, y0, one, args)
    if keep is None and not isinstance(system, Model):
        raise InputError("drift: keep is None, expected (t, y, args) -> arrays for a term")
    keep = Invariants() if keep is None else keep
    return long_run(term, one, y0, dt, keep, every=every, samples=samples, args=args)
