"""Equal steps of any solver, in one compiled program whose memory does not grow with their number.

    y_{n+1} = step(t_n, h, y_n),    t_n = n h;    keep(t, y, args) after every `every` steps
The steps are the solver's own, without interpolation, controller or checkpoints. A run stops before
a state that is not finite, or if the root of an implicit step is not found; `ending` says which.
The remaining samples repeat the last finite one, at times that are nan.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer, real_array, real_number
from rbjax.errors import InputError
from rbjax.model import Model, State

#: the endings of a run, by the number in `March.ending`
DONE, NOT_FINITE, NO_ROOT = ENDINGS = range(3)

Keep = Callable[[Any, Any, Any], Any]  # (t, y, args) -> arrays to keep


class March(eqx.Module):
    """The result of a run.

    Fields: ts (K + 1,) s, nan after an early end; kept, the results of `keep`, each leaf
    (K + 1, ...), of the last state y where ts is nan; y, the last state; steps (), their number;
    ending (), one of `DONE`, `NOT_FINITE`, `NO_ROOT` of `rb.stability`.
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
) -> March:
    """samples * every steps of dt from t = 0. One program serves all dt, `every`, y0 and args."""
    y0 = as_floats("a run", y0)
    dtype = jnp.result_type(*jax.tree.leaves(y0))
    check_times(dt, every * samples, dtype)
    return _run(term, solver, y0, jnp.asarray(dt, dtype), keep, jnp.asarray(every), samples, args)


@eqx.filter_jit
def _run(term, solver, y0, dt, keep, every, samples, args) -> March:
    def sound(state):
        _, ending, _, _ = state
        return ending == DONE

    def once(state):
        n, _, y, memory = state
        t = n * dt
        y1, _, _, memory, result = solver.step(term, t, t + dt, y, args, memory, made_jump=False)
        found = result == diffrax.RESULTS.successful
        ending = jnp.where(found, jnp.where(finite(y1), DONE, NOT_FINITE), NO_ROOT)
        y1 = jax.tree.map(lambda new, old: jnp.where(ending == DONE, new, old), y1, y)
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
    ts, kept = jax.tree.map(
        lambda a, b: jnp.concatenate([jnp.asarray(a)[None], b]), first, later
    )
    return March(ts, kept, y, steps, ending)


def finite(y: Any) -> jax.Array:
    """Whether all numbers of a state are finite."""
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(y)]).all()


def check_state(where: str, model: Model, y0: Any) -> None:
    """Reject what is not the state of a robot."""
    if not isinstance(y0, State):
        raise InputError(f"{where}: y0 is {type(y0).__name__}, expected State(q, v) of the robot")
    if jnp.shape(y0.q) != (model.nq,) or jnp.shape(y0.v) != (model.nv,):
        raise InputError(
            f"{where}: y0 has q {jnp.shape(y0.q)} and v {jnp.shape(y0.v)}, expected ({model.nq},) "
            f"and ({model.nv},)"
        )


def as_floats(where: str, y: Any) -> Any:
    """A state as finite arrays of one float type."""
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
    """`InputError` for times that the dtype cannot resolve: t + h - t would differ from h."""
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
