"""`select`: selection among nested linear models by F tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.sysid.statistics.comparisons import Comparison, Scored, compare
from rbjax.sysid.torque.regression import regress
from rbjax.sysid.torque.torque_equations import ROUNDING, Regression


@displayed
@dataclass(frozen=True, eq=False)
class Selected:
    """The result of `select`.

    Fields:
        name: name of the selected model.
        regression: fit of the selected model.
        comparisons: comparisons with each larger model, in order.
    """

    name: str
    regression: Regression
    comparisons: tuple[Comparison, ...]


def select(candidates: Mapping[str, tuple[Any, Sequence[str]]], tau: Any) -> Selected:
    """Select among nested linear models by F tests, from the smallest to the largest.

    Each model is compared with the last accepted one (`compare`). All fits use the same noise for
    each channel, estimated by weighted least squares of the largest model. Therefore a larger model
    never fits worse.

    Args:
        candidates: name -> (W, names), an observation matrix (N, k, p) and the names of its
            columns. Each model is a special case of all later ones. If successive errors are
            correlated, average the rows of W over the correlation time.
        tau: (N, k) measured torques.

    Returns:
        `Selected`.

    Raises:
        InputError: no candidates, or invalid arrays or models (`regress`, `compare`).

    Source: Seber & Wild, *Nonlinear Regression*, 5.3.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid.torque import select
        >>> t, noise = np.linspace(0, 1, 50), np.random.default_rng(1).normal(size=50)
        >>> powers = [t**k for k in range(4)]
        >>> lines = {f"degree {n}": (np.stack(powers[: n + 1], 1), "abcd"[: n + 1])
        ...     for n in range(4)}
        >>> select(lines, 1 + 2 * t + 0.1 * noise).name
        'degree 1'
    """
    if not isinstance(candidates, Mapping) or not candidates:
        raise InputError(
            "select: no candidates, expected at least one, as a dict name -> (W, names)"
        )
    for name, candidate in candidates.items():
        if not isinstance(candidate, (tuple, list)) or len(candidate) != 2:
            raise InputError(
                f"select: candidate {name} is {type(candidate).__name__}, expected (W, names): an "
                "observation matrix and the names of its columns"
            )
    largest = [*candidates.values()][-1]
    last = regress(largest[0], tau, largest[1])
    sigma = np.maximum(last.noise, ROUNDING * max(float(np.abs(tau).max()), 1e-300))
    fits = {name: regress(W, tau, names, noise=sigma) for name, (W, names) in candidates.items()}
    samples = last.residual.size

    def scored(name: str) -> Scored:
        fit = fits[name]
        squares = float(((fit.residual / sigma) ** 2).sum())
        # the residual of exact torques is rounding, which must not decide
        return Scored(name, max(squares, 1.0), fit.combinations.rank)

    kept, *others = fits
    comparisons = []
    for name in others:
        if fits[name].combinations.rank > fits[kept].combinations.rank:
            comparisons.append(compare(scored(kept), scored(name), samples))
            kept = name if comparisons[-1].significant else kept
    return Selected(kept, fits[kept], tuple(comparisons))
