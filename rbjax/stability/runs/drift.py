"""Drift of invariants over a million steps, and a test of their slope.

    x_k = a + s t_k + oscillation;    s by least squares over the means of B blocks,
    its error from the residuals,    sigma^2 = (1 + r) / (1 - r) sum e^2 / (B - 2) / sum (t - t_)^2
with r the correlation of neighbours. If r is near 1, the residual may be a random walk, as from
rounding. The variance of its slope is then 6/5 B var(dx) / T^2, dx the steps from block to block.
A symplectic method keeps the energy within an oscillation that does not grow for exponentially long
times (backward error analysis; Hairer, Lubich & Wanner, *Geometric Numerical Integration*, IX.8).
Other methods drift at a constant rate.
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

from rbjax.arguments import integer, real_array
from rbjax.dynamics import (
    center_of_mass,
    centroidal_momentum,
    kinetic_energy,
    potential_energy,
)
from rbjax.errors import InputError
from rbjax.forces import elastic_energy
from rbjax.model import Model, State, Topology
from rbjax.motion.term import motion, unit
from rbjax.stability.methods import Solver, stepping
from rbjax.stability.runs.long_run import March, check_state, long_run

BLOCKS = 64  # block means of a series, to which the slope is fitted
SIGNIFICANT = 4.0  # standard errors beyond which a slope is a trend
WALK = 0.7  # correlation of neighbours beyond which residuals may be a random walk


class Trend(NamedTuple):
    """The slope of a series.

    Fields: slope, a second; error, its standard error; change, slope times the whole time;
    amplitude, half of the spread about the line; drifts, whether the slope is more than four
    standard errors and its change more than the amplitude.
    """

    slope: float
    error: float
    change: float
    amplitude: float
    drifts: bool


def trend(ts: ArrayLike, xs: ArrayLike) -> Trend:
    """Least-squares slope of a series, with a standard error that accounts for oscillation.

    s = sum (t - t_) x / sum (t - t_)^2 over the means of 64 blocks.

    Args:
        ts: (T,) increasing times. After an early end of a run of `drift` they are nan.
        xs: (T,) the series.

    Raises:
        InputError: wrong shapes, values that are not finite, times that do not increase, fewer than
            16 samples.

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


class Invariants(eqx.Module):
    """The invariants of a free robot, as (t, state, model) -> dict.

    energy (), J, springs included; momentum (6,), angular about the world's origin, then linear;
    manifold (), the largest | |quaternion| - 1 |. Not all are constant for every robot: a fixed
    base and gravity change the momentum, dampers take energy.
    """

    def __call__(self, t: Any, y: State, model: Model) -> dict[str, jax.Array]:
        q, v = unit(model.topology, y.q), y.v
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
    """The largest deviation of a quaternion's length from 1."""
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
) -> March:
    """Invariants along a run of equal steps, in memory that does not grow with their number.

    y_{n+1} = step(t_n, h, y_n); keep(t, y, args) at the start and at `samples` later times.

    Args:
        system: a robot, or a diffrax term (`diffrax.ODETerm`, `rb.solvers.OnGroup`, ...).
        y0: `State(q (nq,), v (nv,))` of the robot, or the term's state. The whole run has its
            dtype, f32 or f64.
        keep: (t, y, args) -> any arrays. If None, energy, momentum and manifold of a robot
            (`rb.stability.Invariants`).
        solver: a name of `rb.solvers.all()`, any solver of rbjax or diffrax, or an
            `rb.solvers.Tableau`, with equal steps.
        dt: step, s. In f32 over more than a few thousand steps it must be a power of two.
        steps: the number of steps, a multiple of `samples`.
        samples: the number of samples.
        args: those of the term; for a robot, the model is used.

    Returns:
        `March`: ts (samples + 1,), kept, y, steps, ending. After an early end (ending is not
        `DONE`) ts is nan, which `trend` does not accept.

    Raises:
        UnknownName: an unknown name of a solver.
        InputError: `steps` is no multiple of `samples`; times that the dtype cannot resolve; a
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
    integer("drift", "samples", samples, least=1)
    integer("drift", "steps", steps, least=1)
    if steps < samples or steps % samples:
        raise InputError(
            f"drift: got {steps} steps and {samples} samples, expected a multiple of the samples"
        )
    one = stepping(solver)
    if isinstance(system, Model):
        check_state("drift", system, y0)
        term, y0 = motion(system, y0, one)
        args, keep = system, Invariants() if keep is None else keep
    elif not isinstance(system, diffrax.AbstractTerm):
        raise InputError(
            f"drift: system is {type(system).__name__}, expected a Model or a term of diffrax"
        )
    elif keep is None:
        raise InputError("drift: keep is None, expected (t, y, args) -> arrays for a term")
    else:
        term = system
    return long_run(term, one, y0, dt, keep, every=steps // samples, samples=samples, args=args)
