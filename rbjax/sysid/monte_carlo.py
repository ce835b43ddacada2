"""Monte Carlo of a fit: the same experiment many times over, with other noise.

    recorded_k = reading(motion(p_found)) + noise_k
    p_k = argmin over p of |weights (reading(motion(p)) - recorded_k)|^2
What the p_k scatter is the truth about the fit's errors; the covariance of a fit is its linear
approximation. Intervals hold if a share `level` of those of the repetitions contain p_found.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.progress import progress_line
from rbjax.solvers.arguments import check_whole
from rbjax.sysid.columns import Columns
from rbjax.sysid.identified import Identified
from rbjax.sysid.least_squares import minimise
from rbjax.sysid.statistics import estimates


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """Repetitions of an experiment.

    Fields: names (n,) of the unknowns; truth (n,), what was simulated; values (k, n) that were
    found; sigma (k, n), standard deviations as each repetition says them; inside (k, n), whether
    its intervals hold the truth; level that they claim; seen (n,), whether the data show an unknown
    by itself, without which its interval is infinite; failed, repetitions that did not converge.
    """

    names: tuple[str, ...]
    truth: np.ndarray
    values: np.ndarray
    sigma: np.ndarray
    inside: np.ndarray
    level: float
    seen: np.ndarray
    failed: int

    @property
    def coverage(self) -> float:
        """The share of intervals that hold the truth, of all unknowns that the data show."""
        return float(self.inside[:, self.seen].mean())

    @property
    def by_name(self) -> dict[str, float]:
        """The share for each unknown that the data show."""
        pairs = zip(self.names, self.seen, self.inside.mean(0), strict=True)
        return {name: float(share) for name, seen, share in pairs if seen}

    @property
    def scatter(self) -> np.ndarray:
        """(n,) standard deviations of the values."""
        return np.asarray(self.values.std(0, ddof=1))


def monte_carlo(
    found: Identified,
    repetitions: int = 100,
    *,
    level: float = 0.95,
    seed: int = 0,
    progress: bool = False,
) -> MonteCarlo:
    """Repeats the experiment of a fit with simulated noise, and fits each repetition.

    Args:
        found: a fit by squares, from `identify`.
        repetitions: how many, 2 or more.
        level: of the intervals.
        seed: of the noise, which is normal, independent, and as large as each channel says, or as
            the fit's residuals are.
        progress: whether a line shows the progress.

    Returns:
        `MonteCarlo`.

    Raises:
        InputError: data without noise; a fit with loss="huber"; a level outside of (0, 1).

    Source: Efron & Tibshirani, *An Introduction to the Bootstrap*, 6.5 (the parametric bootstrap).

    Example:
        >>> import rbjax as rb, numpy as np
        >>> from rbjax.sysid import Channel, Recording, Unknown, identify, monte_carlo
        >>> model, t = rb.load("pendulum"), np.arange(51) * 0.02
        >>> q = rb.rollout(model, rb.State(np.ones(1), np.zeros(1)), None, 0.02, steps=50).q
        >>> q = q + 1e-3 * np.random.default_rng(0).normal(size=q.shape)
        >>> found = identify(
        ...     model, Recording("swing", {"q": Channel(t, q)}),
        ...     {"damping": Unknown("joints.damping", 0)}, starts=True,
        ... )
        >>> again = monte_carlo(found, 20)
        >>> again.values.shape
        (20, 1)
    """
    check_whole("monte_carlo", "repetitions", repetitions, 2)
    if not 0 < level < 1:
        raise InputError(f"monte_carlo: level is {level}, expected a number between 0 and 1")
    of, said = found.error, found.estimates
    if of.loss != "squares":
        raise InputError(
            f'monte_carlo: the fit has loss="{of.loss}", expected "squares": with normal noise '
            "there are no outliers to tell"
        )
    if not found.noisy:
        raise InputError(
            "monte_carlo: the fit has no noise, expected channels that say theirs, or residuals "
            "from which it is estimated"
        )
    n = of.shared
    truth = said.values
    read = of.readings(truth)
    rng = np.random.default_rng(seed)
    guess = np.append([*found.guess.values()], np.zeros(of.size - n))
    seen = np.isfinite(said.sigma[:n])
    values, sigma, inside, failed = [], [], [], 0
    with progress_line("monte_carlo", progress) as say:
        for k in range(repetitions):
            say(f"{k} of {repetitions} repetitions")
            noisy = {
                s: _noisy(found.setup.columns(s), x, of.runs.weights[s], rng)
                for s, x in read.items()
            }
            least = minimise(of.on(of.runs._replace(values=noisy)), truth, guess)
            failed += not least.ok
            one = estimates(
                said.names, least.x, least.triangle[:, :-1], np.sqrt(least.cost / said.dof),
                dof=said.dof, bounds=said.bounds,
            )  # fmt: skip
            spans = [one.interval(name, level) for name in said.names[:n]]
            values.append(least.x[:n])
            sigma.append([x.sigma for x in spans])
            inside.append([x.low <= y <= x.high for x, y in zip(spans, truth, strict=False)])
    return MonteCarlo(
        said.names[:n], truth[:n], np.array(values), np.array(sigma), np.array(inside), level,
        seen, failed,
    )  # fmt: skip


def _noisy(
    columns: Columns, reading: jax.Array, weights: jax.Array, rng: np.random.Generator
) -> jax.Array:
    """With noise of 1 / weights, where something was measured."""
    weights = columns.weights(weights)
    sigma = np.where(weights > 0, 1 / np.where(weights > 0, weights, 1.0), 0.0)
    return jax.vmap(jax.vmap(columns.plus))(
        reading, jnp.asarray(sigma * rng.normal(size=sigma.shape))
    )
