"""First guesses of unknowns, spread over their ranges."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from rbjax.errors import InputError
from rbjax.sysid.parameters.log_cholesky import (
    from_log_cholesky,
    inertial_parameters_of,
    pseudo_inertia_of,
    to_log_cholesky,
)
from rbjax.sysid.parameters.unknowns import (
    FixedTotal,
    Inertia,
    Parametrisation,
    Scalars,
    Shared,
    Unknowns,
)


def draw_guesses(
    unknowns: Unknowns, target: Any, count: int, spread: float, seed: int
) -> np.ndarray:
    """Draw guesses (count, n) by a Sobol sequence; the first is that of the set-up.

    With z in (-spread, spread): positive numbers are p exp(z), and free ones p + scale z. Numbers
    between two bounds are uniform. The distance to a single bound is scaled by exp(z). Bodies
    change by z / 2 in the log-Cholesky parameters of their inertia.

    Raises:
        InputError: an unknown of another kind.

    Source: Sobol, USSR Comput. Math. Math. Phys. 7(4), 1967; Owen, J. Complexity 14(4), 1998.
    """
    n = sum(unknowns.sizes)
    many = 1 << (count - 1).bit_length()  # a Sobol sequence is balanced for powers of two
    even = qmc.Sobol(n, rng=np.random.default_rng(seed)).random(many)[:count]
    z = spread * (2 * even - 1)
    ends = np.cumsum(unknowns.sizes)[:-1]
    columns = np.split(z, ends, 1), np.split(even, ends, 1)
    found = [
        [_one(label, u, np.asarray(u.read(target), float), *at) for at in zip(a, b, strict=True)]
        for (label, u), a, b in zip(unknowns.members.items(), *columns, strict=True)
    ]
    guesses = np.concatenate(found, 1)
    guesses[0] = np.asarray(unknowns.read(target), float)
    return guesses


def _one(label: str, u: Parametrisation, p: np.ndarray, z: np.ndarray, even: Any) -> np.ndarray:
    """A guess of one unknown, whose parameters are p in the set-up."""
    if isinstance(u, Inertia):
        theta = to_log_cholesky(pseudo_inertia_of(jnp.asarray(p)))
        return np.asarray(inertial_parameters_of(from_log_cholesky(theta + z / 2)))
    if isinstance(u, FixedTotal):
        parts = np.append(p, u.total - p.sum()) * np.exp(np.append(z, 0.0))
        return (parts * u.total / parts.sum())[:-1]
    if isinstance(u, Shared):
        factor = 1.0 if u.factors is None else u.factors[0]
        return _one(label, u.members[0], factor * p, z, even) / factor
    if not isinstance(u, Scalars):
        raise InputError(
            f"many_starts: {label} is {u!r}, of a kind that cannot be drawn; expected Unknown, "
            "Inertia, Shared, FixedTotal, Tilt or Derived, or guesses as an array"
        )
    low, high = u.bounds or (-np.inf, np.inf)
    if np.isfinite(low) and np.isfinite(high):
        return low + (high - low) * (0.001 + 0.998 * even)
    if np.isfinite(low):
        return low + (p - low) * np.exp(z)
    if np.isfinite(high):
        return high - (high - p) * np.exp(z)
    return p * np.exp(z) if u.positive else p + u.scale * z
