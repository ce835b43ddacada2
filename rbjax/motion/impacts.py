"""`simulate_impacts`: rigid contacts by events, with exact times of impact.

A motion is a sequence of phases. In a phase each contact is open, sliding or sticking, and

    M a + b = tau + J^T f,   J a + J' v = 0 in the rows that are kept,   |f_t| = mu f_n if sliding
An event ends it: an open contact closes (an impact, `rb.contact.impulse`), a kept contact pulls (it
opens), slip stops (it sticks), or friction exceeds mu f_n (it slides). Derivatives include the
saltation of each event (`rbjax.solvers.events`). The order of events is constant under
differentiation.

Source: Brogliato, *Nonsmooth Mechanics*, ch. 7; Leine & Nijmeijer 2004; Pfeiffer & Glocker,
*Multibody Dynamics with Unilateral Contacts*, 1996.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike, integer, real_number
from rbjax.compiling import compiled, inside_jit
from rbjax.contact.impacts.impulses import check_coefficients, check_pairs
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_arrays, check_moves
from rbjax.errors import InputError
from rbjax.forces.inputs import Inputs, Source
from rbjax.lanes.arrays import select
from rbjax.model import Model, State, with_constants
from rbjax.motion.contact_modes import ContactSystem, Mode, initial_mode, transition
from rbjax.motion.field import Dynamics, dynamics_of, free_motion
from rbjax.motion.inputs import inputs_between
from rbjax.motion.term import unit_quaternions
from rbjax.motion.trajectory import check_times
from rbjax.solvers.events import carry_back, integrate_until

#: results of a motion with impacts
DONE, TOO_MANY, FAILED = 0, 1, 2


@displayed
class ImpactTrajectory(eqx.Module):
    """States of a motion with rigid impacts.

    Fields:
        ts: (T,) times in s.
        q, v: (T, nq) and (T, nv); NaN after the last event if the motion did not end.
        x: (T, nx) states of force elements, or None.
        times: (max_impacts,) times of the events in s; infinite for those that did not occur.
        impacts: (max_impacts, n) the candidate contacts that closed in each event.
        after: states after each event, with a leading axis (max_impacts,), for return maps; those
            of events that did not occur are the last state.
        kept: (n,) contacts that are kept at the end.
        count: number of events.
        status: 0 (DONE): the motion reached the last time. 1 (TOO_MANY): it has more than
            max_impacts events, as at an accumulation of impacts (Zeno). 2 (FAILED): a solve failed.
        residual: m/s, largest violation of the laws of impact.
    """

    ts: jax.Array
    q: jax.Array
    v: jax.Array
    x: jax.Array | None
    times: jax.Array
    impacts: jax.Array
    after: State
    kept: jax.Array
    count: jax.Array
    status: jax.Array
    residual: jax.Array

    @property
    def success(self) -> jax.Array:
        """Whether the motion reached the last time."""
        return self.status == DONE

    def state(self, i: int) -> State:
        """Return the state at ts[i]."""
        return State(self.q[i], self.v[i], None if self.x is None else self.x[i])


def simulate_impacts(
    model: Model,
    state: State,
    ts: ArrayLike,
    ctrl: ArrayLike | Source | None = None,
    *,
    tau: ArrayLike | Source | None = None,
    wrenches: ArrayLike | Source | None = None,
    pairs: Any = None,
    restitution: Any = 0.0,
    friction: Any = None,
    max_impacts: int = 20,
    rest_speed: Any = 0.0,
    law: str = "newton",
    constraints: Any = None,
    dynamics: Dynamics = free_motion,
    tolerance: float | None = None,
    max_steps: int = 256,
    throw: bool = True,
) -> ImpactTrajectory:
    """Integrate a motion with rigid contacts from ts[0] to ts[-1], impact by impact.

    Use it for few contacts, with derivatives that are right through each impact: bouncing balls,
    walkers, cradles. `rb.contact.MoreauContact` has no events and takes many contacts.

    A contact with restitution above zero bounces. One without is kept: it slides or sticks with
    friction until it opens.

    Args:
        model: the robot, with `model.geoms`.
        state: `State(q (nq,), v (nv,))` at ts[0]. Contacts that touch with a normal velocity of
            zero are kept.
        ts: (T,) increasing times in s.
        ctrl, tau, wrenches: as in `simulate`.
        pairs: names or indices of the geoms, two each; the pairs of the file if None.
        restitution: e, one number or one a pair (pairs,).
        friction: mu, one number or one a pair; 0, finite, or jnp.inf to stick; the friction of the
            geoms if None.
        max_impacts: largest number of events.
        rest_speed: m/s, closing speed below which a contact has no restitution and is kept. Above
            zero it ends an accumulation of impacts.
        law: "newton", or "energetic" for impacts of one contact.
        constraints, dynamics: as in `simulate`.
        tolerance: of a step; 1e-10 in f64 or 1e-5 in f32 if None.
        max_steps: largest number of steps of a phase.
        throw: raise if the motion does not reach ts[-1], outside of traced code. If False, `status`
            reports it.

    Returns:
        `ImpactTrajectory`. An accumulation of impacts has the status TOO_MANY.

    Raises:
        InputError: bad arguments, or with `throw` a motion that did not reach ts[-1].

    Source: Brogliato, *Nonsmooth Mechanics*, ch. 7; Leine & Nijmeijer 2004, ch. 7.

    Example: a ball that bounces once
        >>> import rbjax as rb, jax.numpy as jnp
        >>> ball = '''<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 1.1">
        ...     <joint type="slide" axis="0 0 1"/><geom size="0.1"/></body></worldbody></mujoco>'''
        >>> model = rb.load(ball)
        >>> path = rb.simulate_impacts(
        ...     model, model.default_state(), jnp.array([0.0, 0.6]), restitution=0.5, max_impacts=2
        ... )
        >>> int(path.count), round(float(path.times[0]), 3)
        (1, 0.452)
    """
    where = "simulate_impacts"
    state = check_arrays(where, model, {"state": state})["state"]
    check_moves(where, model)
    model = model.replace(contact=None)  # rigid contacts replace the law of the model
    dtype = state.q.dtype
    ts, elapsed = check_times(where, ts, dtype)
    inputs = inputs_between(where, model, Inputs(ctrl, tau, wrenches), ts)
    dynamics = dynamics_of(where, model, dynamics, constraints)
    chosen = check_pairs(where, model, pairs)
    e, mu = check_coefficients(where, model, chosen, restitution, friction, dtype)
    integer(where, "max_impacts", max_impacts, least=1)
    integer(where, "max_steps", max_steps, least=1)
    rest = real_number(where, "rest_speed", rest_speed, least=0.0, traced=True)
    if law not in ("newton", "energetic"):
        raise InputError(f"{where}: law is {law!r}, expected 'newton' or 'energetic'")
    if tolerance is not None:
        real_number(where, "tolerance", tolerance, "a number above zero", above=0.0)
    model = with_constants(
        model, dtype
    )  # once for all phases; zeros of a constant model are static
    system = ContactSystem(model, inputs, dynamics, mu, ts[0], chosen)
    start = State(state.q, state.v, state.x)
    run = _solve if inside_jit() else _compiled
    given = (system, start, elapsed, e, jnp.asarray(rest, dtype))
    path, times, impacts, after, kept, count, status, residual = run(
        *given, law, int(max_impacts), tolerance, int(max_steps)
    )
    if throw and not isinstance(status, jax.core.Tracer) and int(status) != DONE:
        last = float(jnp.where(jnp.isfinite(times), times, 0).max())
        why = (
            f"it has more than {max_impacts} events until {last:.6g} s. Give more max_impacts, or "
            "rest_speed if impacts accumulate"
            if int(status) == TOO_MANY
            else f"a phase failed after {last:.6g} s. Give more max_steps or a larger tolerance, "
            "and check that the contacts do not overlap at the start"
        )
        raise InputError(
            f"{where}: the motion did not reach its last time: {why}; throw=False returns the "
            "states so far"
        )
    return ImpactTrajectory(
        ts, path.q, path.v, path.x, ts[0] + times, impacts, after, kept, count, status, residual
    )


class _Carry(NamedTuple):
    """The state of the loop over phases between events: time, state, mode, and the
    results so far."""

    t: jax.Array
    y: State
    mode: Mode
    leaving: jax.Array
    path: State
    events: jax.Array
    status: jax.Array
    done: jax.Array
    residual: jax.Array


def _solve(
    system: ContactSystem, state: State, ts: jax.Array, e: jax.Array, rest: jax.Array, law: str,
    max_impacts: int, tolerance: float | None, max_steps: int,
) -> tuple:  # fmt: skip
    """Integrate all phases; return the saved states and the events."""
    dtype = ts.dtype
    empty = jax.tree.map(lambda x: jnp.full((len(ts), *x.shape), jnp.nan, dtype), state)
    # functions of the one system, whose program all loops share; a method would be of a copy
    field, guard = (lambda *at: system.field(*at)), (lambda *at: system.guard(*at))

    def phase(now: _Carry, _: Any) -> tuple[_Carry, tuple]:
        end = integrate_until(
            field, now.y, guard, ts[-1], now.mode, t0=now.t, ts=ts,
            leaving=now.leaving, tolerance=tolerance, max_steps=max_steps,
        )  # fmt: skip
        inside = (ts >= now.t) & (ts <= end.located) & ~now.done
        path = jax.tree.map(
            lambda new, old: jnp.where(inside.reshape(-1, *(1,) * (old.ndim - 1)), new, old),
            end.ys, now.path,
        )  # fmt: skip
        y, mode, closed, residual, fine = transition(system, end.t, end.y, now.mode, e, rest, law)
        after = y
        y = carry_back(field, end.t, y, mode, end.located)
        event = end.reached & ~now.done
        failed = ~now.done & ~(end.success & (fine | ~end.reached))
        done = now.done | ~end.reached | failed
        status = jnp.where(failed, FAILED, jnp.where(~now.done & ~end.reached, DONE, now.status))
        keep = now.done | failed
        new = _Carry(
            jnp.where(now.done, now.t, end.located),
            select(keep, now.y, y),
            select(now.done, now.mode, mode),
            jnp.asarray(True),
            path,
            now.events + event,
            status,
            done,
            jnp.maximum(now.residual, jnp.where(event, residual, 0)),
        )
        return new, (jnp.where(event, end.t, jnp.inf), closed & event, system.unit(after))

    mode, leaving = initial_mode(system, state)
    zero = jnp.zeros((), int)
    start = _Carry(
        ts[0], state, mode, leaving, empty, zero, zero + TOO_MANY,
        jnp.asarray(False), jnp.zeros((), dtype),
    )  # fmt: skip
    # the last phase has no event: one more than the events
    last, (times, impacts, after) = jax.lax.scan(phase, start, None, length=max_impacts + 1)
    q = jax.vmap(lambda q: unit_quaternions(system.model.topology, q))(last.path.q)
    path = State(q, last.path.v, last.path.x)
    return (
        path, times[:max_impacts], impacts[:max_impacts],
        jax.tree.map(lambda x: x[:max_impacts], after), last.mode.kept,
        jnp.minimum(last.events, max_impacts), last.status, last.residual,
    )  # fmt: skip


_compiled = compiled(_solve, jit=eqx.filter_jit)
