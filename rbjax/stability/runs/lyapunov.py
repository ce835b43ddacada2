"""Lyapunov exponents, and the time for which a gradient through a motion is useful.

    lambda = lim 1/t log |Phi(t) u|,    Phi(t) = d y(t) / d y(0), the tangent map
Benettin's method propagates a tangent through the derivative of each step and rescales it to length
1 every few steps. lambda is the mean growth rate of its logarithm. A gradient of a loss at time t
contains Phi(t), which also amplifies rounding of relative size eps. So beyond |Phi| eps = 1 the
gradient is noise in any implementation. (Benettin, Galgani, Giorgilli & Strelcyn, *Meccanica* 15,
1980; Metz, Freeman, Schoenholz & Kachman, *Gradients are not all you need*, 2021.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from rbjax._jax_compat import scan_kind
from rbjax.arguments import integer, real_number
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.solvers import rkmk
from rbjax.stability.methods import Solver, fixed_step_solver
from rbjax.stability.runs.drift import (
    as_floats,
    check_times,
    finite,
    resolve_system,
    steps_of_a_sample,
)

BLOCKS = 16  # number of blocks, whose means give the standard error


@displayed
class Exponent(NamedTuple):
    """A largest Lyapunov exponent.

    Fields:
        value: 1/s.
        error: standard error of the value.
        ts: (K,) s, from the end of the transient.
        running: (K,) estimate from the end of the transient to each time.
        finite: whether the motion stayed finite.
    """

    value: float
    error: float
    ts: np.ndarray
    running: np.ndarray
    finite: bool


@displayed
class GradientGrowth(NamedTuple):
    """The norm of the tangent map over time.

    Fields:
        ts: (K + 1,) s.
        log10_norm: (K + 1,) log10 of the largest singular value of Phi(t).
        f32, f64: time in s at which amplified rounding reaches the size of the gradient; inf if
            later than the run.
        finite: whether the motion stayed finite.
    """

    ts: np.ndarray
    log10_norm: np.ndarray
    f32: float
    f64: float
    finite: bool


def lyapunov(
    system: Model | diffrax.AbstractTerm,
    y0: Any,
    *,
    dt: float,
    steps: int,
    solver: Solver | None = None,
    every: int = 10,
    transient: float = 0.1,
    args: Any = None,
) -> Exponent:
    """Estimate the largest Lyapunov exponent of a motion, by Benettin's method.

    lambda = 1 / (K m h) sum_k log |u_k|, with u_k the tangent m steps after it had length 1.

    Args:
        system: a robot, or a diffrax term.
        y0: `State(q (nq,), v (nv,))` of the robot, or the term's state.
        dt: step, s.
        steps: number of steps.
        solver: as in `drift`, with equal steps; rb.solvers.rkmk(4) if None. It is RK4 for states
            without attitudes, and keeps attitudes and their tangents on the manifold.
        every: number m of steps between two normalizations.
        transient: fraction of the run that is skipped at its start.
        args: arguments of the term. For a robot the model is used.

    Returns:
        `Exponent`. It is about 0 for regular motion (decreasing as log t / t), and negative at a
        sink.

    Raises:
        UnknownName: an unknown solver name.
        InputError: too few steps, or times that the dtype cannot resolve.

    Source: Benettin et al., *Meccanica* 15, 1980.

    Example:
        >>> import rbjax as rb, diffrax, jax.numpy as jnp
        >>> saddle = diffrax.ODETerm(lambda t, y, args: jnp.array([0.5, -2.0]) * y)
        >>> found = rb.stability.lyapunov(saddle, jnp.zeros(2), dt=0.05, steps=1000)
        >>> round(found.value, 6)
        0.5
    """
    integer("lyapunov", "steps", steps, least=1)
    samples = steps // integer("lyapunov", "every", every, least=1)
    transient = real_number("lyapunov", "transient", transient, least=0.0)
    skip = int(transient * samples)
    if transient >= 1 or samples - skip < 16:
        raise InputError(
            f"lyapunov: got {steps} steps, every {every}, transient {transient}; expected at least "
            "16 normalizations after the transient, and a transient from 0 to below 1"
        )
    term, solver, y0, args = _prepared("lyapunov", system, y0, solver, args, dt, steps)
    size = sum(x.size for x in jax.tree.leaves(y0))
    direction = np.random.default_rng(0).normal(size=(size, 1))
    direction /= np.linalg.norm(direction)
    parts, fine = _tangent_factors(term, solver, y0, dt, direction, every, samples, args)
    rates = np.log(np.abs(np.asarray(parts)[skip:, 0, 0])) / (dt * every)
    running = np.cumsum(rates) / np.arange(1, len(rates) + 1)
    blocks = np.array([part.mean() for part in np.array_split(rates, BLOCKS)])
    error = float(blocks.std(ddof=1) / np.sqrt(BLOCKS))
    ts = dt * every * np.arange(skip + 1, samples + 1)
    return Exponent(float(running[-1]), error, ts, running, bool(fine))


def gradient_growth(
    system: Model | diffrax.AbstractTerm,
    y0: Any,
    *,
    dt: float,
    steps: int,
    solver: Solver | None = None,
    samples: int = 100,
    args: Any = None,
) -> GradientGrowth:
    """Measure the growth of a gradient through a motion, and the time after which it is noise.

    |Phi(t)| = |d y(t) / d y(0)|, and T with |Phi(T)| eps = 1.

    Args:
        system: a robot, or a diffrax term.
        y0: `State(q (nq,), v (nv,))` of the robot, or the term's state.
        dt: step, s.
        steps: number of steps, a multiple of `samples`.
        solver: as in `drift`, with equal steps; rb.solvers.rkmk(4) if None.
        samples: number of samples, at which the tangents are orthogonalized.
        args: arguments of the term. For a robot the model is used.

    Returns:
        `GradientGrowth`. The norm mixes the units of the state (rad, rad/s).

    Raises:
        UnknownName: an unknown solver name.
        InputError: `steps` is not a multiple of `samples`, or times that the dtype cannot resolve.

    Source: Metz et al., *Gradients are not all you need*, 2021.

    Example:
        >>> import rbjax as rb, diffrax, jax.numpy as jnp
        >>> saddle = diffrax.ODETerm(lambda t, y, args: jnp.array([1.0, -2.0]) * y)
        >>> found = rb.stability.gradient_growth(saddle, jnp.zeros(2), dt=0.05, steps=1000)
        >>> round(found.f32, 1), round(found.f64, 1)
        (15.9, 36.0)
    """
    every = steps_of_a_sample("gradient_growth", steps, samples)
    term, solver, y0, args = _prepared("gradient_growth", system, y0, solver, args, dt, steps)
    size = sum(x.size for x in jax.tree.leaves(y0))
    parts, fine = _tangent_factors(term, solver, y0, dt, np.eye(size), every, samples, args)
    # Phi = Q R_K ... R_1: normalize the product, and store the logarithm of its norm
    product, lost, norms = np.eye(size), 0.0, [0.0]
    for part in np.asarray(parts, np.float64):
        product = part @ product
        norm = np.linalg.norm(product, 2)
        product, lost = product / norm, lost + np.log10(norm)
        norms.append(lost)
    ts, found = dt * every * np.arange(samples + 1), np.array(norms)
    f32, f64 = (_crossing(ts, found, -np.log10(np.finfo(t).eps)) for t in (np.float32, np.float64))
    return GradientGrowth(ts, found, f32, f64, bool(fine))


def _crossing(ts: np.ndarray, xs: np.ndarray, level: float) -> float:
    """Return the first time at which a series reaches a level, by linear interpolation."""
    above = np.flatnonzero(xs >= level)
    if not len(above):
        return float("inf")
    i = max(above[0], 1)
    return float(np.interp(level, xs[i - 1 : i + 1], ts[i - 1 : i + 1]))


def _prepared(
    where: str, system: Any, y0: Any, solver: Any, args: Any, dt: float, steps: int
) -> tuple:
    """Return the term, a solver that can be differentiated forward, the state and the arguments."""
    solver = rkmk(4) if solver is None else fixed_step_solver(solver)
    term, y0, args = resolve_system(where, system, y0, solver, args)
    y0 = as_floats(where, y0)
    check_times(dt, steps, jnp.result_type(*jax.tree.leaves(y0)))
    if scan_kind(solver) is None:  # Runge-Kutta methods of diffrax
        solver = eqx.tree_at(lambda s: s.scan_kind, solver, "lax", is_leaf=lambda x: x is None)
    return term, solver, y0, args


@eqx.filter_jit
def _tangent_factors(term, solver, y0, dt, directions, every, samples, args):
    """Return the factors R (samples, n, n) of Phi_k Q_{k-1} = Q_k R_k along the motion. Phi_k is
    the tangent map of sample k. Also return whether the final state is finite."""
    flat, unflat = jax.flatten_util.ravel_pytree(y0)
    dt, number = jnp.asarray(dt, flat.dtype), directions.shape[1]
    memory = solver.init(term, 0 * dt, dt, y0, args)
    moving, still = eqx.partition(memory, eqx.is_inexact_array)

    def once(_, carry):
        n, y, moving, still, tangents = carry
        t = n * dt

        def step(y, moving):
            state = eqx.combine(moving, still)
            y1, _, _, state, _ = solver.step(
                term, t, t + dt, unflat(y), args, state, made_jump=False
            )
            moved, rest = eqx.partition(state, eqx.is_inexact_array)
            return (jax.flatten_util.ravel_pytree(y1)[0], moved), rest

        def pushed(tangent):
            return jax.jvp(step, (y, moving), tangent, has_aux=True)

        (y, moving), tangents, still = jax.vmap(pushed, out_axes=(None, 0, None))(tangents)
        return n + 1, y, moving, still, tangents

    def sample(carry, _):
        *state, (rows, past) = jax.lax.fori_loop(0, every, once, carry)
        Q, R = jnp.linalg.qr(rows.T)
        # apply the change of basis to the tangents of the solver's state
        inverse = jnp.linalg.inv(R)
        past = jax.tree.map(lambda x: jnp.tensordot(inverse.T, x, axes=1), past)
        return (*state, (Q.T, past)), R

    rows = jnp.asarray(directions.T, flat.dtype)
    past = jax.tree.map(lambda x: jnp.zeros((number, *x.shape), x.dtype), moving)
    start = (jnp.zeros((), jnp.int32), flat, moving, still, (rows, past))
    (_, y, *_), parts = jax.lax.scan(sample, start, length=samples)
    return parts, finite(y)
