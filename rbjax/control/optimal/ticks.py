"""What model predictive control keeps of a tick: its status, memory and record."""

from __future__ import annotations

import enum
from typing import Any, NamedTuple

import jax

from rbjax.control.optimal.objective import ConstraintMultipliers
from rbjax.control.optimal.problem import Knot
from rbjax.display import displayed


class TickStatus(enum.IntEnum):
    """The source of the control of a tick."""

    PLANNED = 0  # from the plan of this tick
    KEPT = 1  # the plan failed; from the last plan
    FALLBACK = 2  # from the fallback: plans failed for longer than patience
    VIOLATED = 3  # the plan violates a constraint; raise iterations or violation


PLANNED, KEPT, FALLBACK, VIOLATED = map(int, TickStatus)


@displayed
class PlannedControl(NamedTuple):
    """The control of a future tick.

    u: control, (nu,).
    K: gains, (nu, n).
    state: planned state.
    status: a `TickStatus`, ().
    """

    u: jax.Array
    K: jax.Array
    state: Any
    status: jax.Array


@displayed
class Memory(NamedTuple):
    """The memory of a controller between ticks: the last plan, of N steps.

    knots: states and parameters, with a leading axis N + 1.
    ctrl: controls, (N, nu).
    K: gains of du = K dx, (N, nu, n).
    multipliers: of the last plan; None without constraints.
    pending: controls of the ticks of delay; None without delay.
    failures: number of plans that failed in a row, ().
    search_status: `Status` of the last search, ().
    cost, violation: of the plan, ().
    gap: largest gap between a step and the next state, (); None without constraints.
    """

    knots: Knot
    ctrl: jax.Array
    K: jax.Array
    multipliers: ConstraintMultipliers | None
    pending: PlannedControl | None
    failures: jax.Array
    search_status: jax.Array
    cost: jax.Array
    violation: jax.Array
    gap: jax.Array | None


@displayed
class ClosedLoop(NamedTuple):
    """The record of a closed loop of T ticks.

    ts: times, (T + 1,), s.
    states: with a leading axis T + 1.
    ctrl: controls, (T, nu).
    statuses: a `TickStatus` each, (T,).
    search_statuses: a `Status` each, (T,).
    costs: of the plans, (T,).
    """

    ts: jax.Array
    states: Any
    ctrl: jax.Array
    statuses: jax.Array
    search_statuses: jax.Array
    costs: jax.Array
