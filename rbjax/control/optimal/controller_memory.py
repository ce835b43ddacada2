"""The memory of a model predictive controller, the status of its ticks, and its closed loop."""

from __future__ import annotations

import enum
from typing import Any, NamedTuple

import jax

from rbjax.control.optimal.objective import Multipliers
from rbjax.control.optimal.problem import Knot


class TickStatus(enum.IntEnum):
    """Where the control of a tick comes from."""

    PLANNED = 0  # from the plan of this tick
    KEPT = 1  # the plan failed, the last plan is continued
    FALLBACK = 2  # plans failed for longer than patience
    VIOLATED = 3  # the plan violates a constraint; raise iterations or violation


PLANNED, KEPT, FALLBACK, VIOLATED = map(int, TickStatus)


class PlannedControl(NamedTuple):
    """A control of a coming tick: u (nu,), gains K (nu, n), the state that the plan expects, and
    its `TickStatus` ()."""

    u: jax.Array
    K: jax.Array
    state: Any
    status: jax.Array


class Memory(NamedTuple):
    """The memory of a controller.

    knots (N + 1, ...), ctrls (N, nu), K (N, nu, n): the last plan and its gains du = +K dx.
    multipliers: of the last plan; None for a method without multipliers.
    pending: the controls of the ticks of delay; None without delay.
    failures: (), the plans that failed in a row.
    search_status: (), of the last search.
    cost, violation: (), of the plan.
    gap: (), the largest between a step of the plan and its next state; 0 without constraints.
    """

    knots: Knot
    ctrls: jax.Array
    K: jax.Array
    multipliers: Multipliers | None
    pending: PlannedControl | None
    failures: jax.Array
    search_status: jax.Array
    cost: jax.Array
    violation: jax.Array
    gap: jax.Array


class Run(NamedTuple):
    """A closed loop of T ticks.

    ts: (T + 1,) s.
    states: with a leading axis T + 1.
    ctrls: (T, nu).
    statuses: (T,), a `TickStatus` each.
    search_statuses: (T,), a `Status` each.
    costs: (T,), of the plans.
    """

    ts: jax.Array
    states: Any
    ctrls: jax.Array
    statuses: jax.Array
    search_statuses: jax.Array
    costs: jax.Array
