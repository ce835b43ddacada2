"""Unknowns of a set-up as one vector, with bounds, priors, and random first guesses."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from rbjax.arguments import real_array
from rbjax.errors import InputError
from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.parameters.log_cholesky import (
    from_log_cholesky,
    inertial_parameters_of,
    pseudo_inertia_of,
    to_log_cholesky,
)
from rbjax.sysid.parameters.unknowns import FixedTotal, Inertia, Parametrisation, Scalars, Shared


@dataclass(frozen=True)
class Unknowns:
    """Unknowns by name, with their parameters as one vector p in the order of the names."""

    members: Mapping[str, Parametrisation]
    sizes: tuple[int, ...]
    names: tuple[str, ...]

    @classmethod
    def of(cls, where: str, members: Mapping[str, Parametrisation], target: Any) -> Unknowns:
        """Check unknowns against the set-up `target`, and collect their sizes and names."""
        fine = isinstance(members, Mapping) and members
        if not fine or not all(isinstance(u, Parametrisation) for u in members.values()):
            raise InputError(
                f"{where}: unknowns is {members!r}, expected a dict name -> Unknown, Inertia, "
                'Shared, FixedTotal, Tilt or Derived, such as {"mass": Unknown("bodies.mass", 0)}'
            )
        sizes, names = [], []
        for label, u in members.items():
            try:
                called = u.names(label, target)  # raises for an index that does not exist
                p = np.asarray(u.read(target))
            except (IndexError, TypeError) as error:
                raise InputError(f"{where}: {label} is {u!r}, but {error}") from error
            if not np.isfinite(u.divergence(p, p).value):
                raise InputError(
                    f"{where}: {label} is {p.tolist()}, expected a first guess within its range: "
                    "positive where positive=True, between the bounds, an inertia that a body can "
                    "have"
                )
            check_prior(where, label, u)
            sizes.append(p.size)
            names += called
        return cls(dict(members), tuple(sizes), tuple(names))

    def read(self, target: Any) -> jax.Array:
        """Read the parameters p of all unknowns from the set-up."""
        parts = [u.read(target) for u in self.members.values()]
        return jnp.concatenate(parts) if parts else jnp.zeros(0)

    def limits(self, target: Any) -> dict[str, tuple[float, float]]:
        """Return the bounds (low, high), by name, of the bounded parameters."""
        found: dict[str, tuple[float, float]] = {}
        for label, u in self.members.items():
            low, high = getattr(u, "bounds", None) or (-np.inf, np.inf)
            if getattr(u, "positive", False):
                low = max(low, 0.0)
            if low > -np.inf or high < np.inf:
                found |= dict.fromkeys(u.names(label, target), (low, high))
        return found

    def prior_rows(self, p: np.ndarray) -> np.ndarray:
        """Compute rows [J r] (k, n + 1) of the normal priors, with r = (p - mean) / sigma."""
        given = [getattr(u, "prior", None) or (0.0, np.inf) for u in self.members.values()]
        mean, sigma = np.repeat(np.reshape(given, (-1, 2)), self.sizes, axis=0).T
        return np.column_stack([np.diag(1 / sigma), (p - mean) / sigma])[np.isfinite(sigma)]

    def write(self, target: Any, p: jax.Array) -> Any:
        """Write p into the set-up."""
        end = 0
        for u, size in zip(self.members.values(), self.sizes, strict=True):
            target = u.write(target, p[end : end + size])
            end += size
        return target

    def divergence(self, p: np.ndarray, p0: np.ndarray) -> Divergence:
        """Compute the sum of the divergences of all unknowns."""
        if not self.sizes:
            return Divergence.free(p, p0, 1.0)
        parts, end = [], 0
        for u, size in self._joined:
            own = slice(end, end + size)
            parts.append(u.divergence(p[own], p0[own]))
            end += size
        return Divergence.joined(parts)

    @functools.cached_property
    def _joined(self) -> list[tuple[Parametrisation, int]]:
        """The unknowns with their sizes, with successive `Inertia`s merged.

        The divergence of several bodies takes as long as the divergence of one.
        """
        found: list[tuple[Parametrisation, int]] = []
        for u, size in zip(self.members.values(), self.sizes, strict=True):
            if isinstance(u, Inertia) and found and isinstance(found[-1][0], Inertia):
                found[-1] = u, found[-1][1] + size
            else:
                found.append((u, size))
        return found


def check_prior(where: str, label: str, u: Any) -> None:
    """Raise InputError unless a prior is None or a mean with a positive standard deviation."""
    prior = getattr(u, "prior", None)
    if prior is None:
        return
    x = real_array(where, f"the prior of {label}", prior, "(mean, standard deviation)")
    if x.shape != (2,) or not x[1] > 0:
        raise InputError(
            f"{where}: the prior of {label} is {prior}, expected (mean, standard deviation), the "
            "latter above 0"
        )


def draw_guesses(
    unknowns: Unknowns, target: Any, count: int, spread: float, seed: int
) -> np.ndarray:
    """Draw guesses (count, n) by a Sobol sequence. The first guess is read from the set-up.

    With z in (-spread, spread), positive parameters are p exp(z), and free ones p + scale z.
    Parameters with two bounds are uniform between them. The distance to a single bound is
    multiplied by exp(z). Log-Cholesky coordinates of inertias change by z / 2.

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
    """Compute a random guess of one unknown from its parameters p in the set-up.

    z: random numbers in (-spread, spread). even: the same numbers in (0, 1).
    """
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
