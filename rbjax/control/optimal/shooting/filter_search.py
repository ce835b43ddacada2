"""Acceptance of line search steps by a filter of pairs (infeasibility, cost).

A trial step is accepted if neither the current pair nor one of the filter is better in both
components. Near feasibility the cost must decrease as its slope predicts (Armijo). The current pair
is added to the filter after a step that was not accepted for its decrease of the cost.
Source: Waechter & Biegler, Math. Program. 106, 2006, eqs. 18 to 22.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes.arrays import select

KEPT = 64
SHARE = 1e-5  # gamma: a margin relative to the infeasibility
ARMIJO = 1e-4
POWER_SLOPE, POWER_THETA = 2.3, 1.1
MOST, NEAR = 10.0, 1e-4  # bounds of the infeasibility, relative to max(1, its first value)
ROUNDING = 10.0  # units in the last place


class CostFilter(NamedTuple):
    """A filter of pairs.

    theta, phi: infeasibilities and costs, (KEPT,), infinite in unused entries.
    used: number of pairs added, ().
    most: upper bound of the infeasibility, ().
    near: infeasibility below which the Armijo condition can apply, ().
    """

    theta: jax.Array
    phi: jax.Array
    used: jax.Array
    most: jax.Array
    near: jax.Array


def empty_filter(theta: jax.Array) -> CostFilter:
    """Return a filter without pairs. theta: the infeasibility of the first guess."""
    none = jnp.full(KEPT, jnp.inf, theta.dtype)
    size = jnp.maximum(1.0, theta)
    return CostFilter(none, none, jnp.asarray(0), MOST * size, NEAR * size)


def without_pairs(filter_: CostFilter) -> CostFilter:
    """Remove all pairs, because the cost function has changed."""
    none = jnp.full_like(filter_.theta, jnp.inf)
    return filter_._replace(theta=none, phi=none, used=jnp.zeros_like(filter_.used))


def rounding(cost: jax.Array) -> jax.Array:
    """Return a bound of the rounding error of a cost."""
    return ROUNDING * jnp.finfo(cost.dtype).eps * jnp.abs(cost)


class FilterPair(NamedTuple):
    """A pair of infeasibility and cost, each ()."""

    theta: jax.Array
    phi: jax.Array


def must_decrease(
    filter_: CostFilter, now: FilterPair, slope: jax.Array, a: jax.Array
) -> jax.Array:
    """Return whether a step of length a must satisfy the Armijo condition."""
    falls = jnp.maximum(-slope, 0.0)
    switch = a * falls**POWER_SLOPE > now.theta**POWER_THETA
    return (now.theta <= filter_.near) & (slope < 0) & switch


def accepts(
    filter_: CostFilter, now: FilterPair, trial: FilterPair, slope: jax.Array, a: jax.Array
) -> jax.Array:
    """Return whether a trial step of length a is acceptable."""
    slack, trial_slack = rounding(now.phi), rounding(trial.phi)
    armijo = trial.phi - now.phi - slack <= ARMIJO * a * slope
    less = (trial.theta <= (1 - SHARE) * now.theta) | (
        trial.phi - slack <= now.phi - SHARE * now.theta
    )
    good = jnp.isfinite(trial.phi) & jnp.isfinite(trial.theta) & (trial.theta <= filter_.most)
    outside = (trial.theta < filter_.theta) | (trial.phi - trial_slack <= filter_.phi)
    return good & outside.all() & jnp.where(must_decrease(filter_, now, slope, a), armijo, less)


def updated_filter(
    filter_: CostFilter, now: FilterPair, trial: FilterPair, slope: jax.Array, a: jax.Array
) -> CostFilter:
    """Return the filter after an accepted step of length a from the pair `now` to `trial`."""
    armijo = trial.phi - now.phi <= ARMIJO * a * slope
    enters = ~(must_decrease(filter_, now, slope, a) & armijo)
    at = filter_.used % KEPT
    new = filter_._replace(
        theta=filter_.theta.at[at].set((1 - SHARE) * now.theta),
        phi=filter_.phi.at[at].set(now.phi - SHARE * now.theta),
        used=filter_.used + 1,
    )
    return select(enters, new, filter_)
