"""Monte Carlo of a fit: the same experiment many times over, with other noise.

    recorded_k = reading(motion(p_found)) + noise_k,        p_k = identify(guess, recorded_k)
Each repetition is a whole call of `identify` with its options: from the user's first guess, with
its own initial states, weights, intervals, and other starts if the fit is poor. The scatter of p_k
is the error of the fit; the fit's covariance approximates it. Intervals are right if a share
`level` of them contains p_found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer
from rbjax.errors import InputError
from rbjax.progress import progress_line
from rbjax.sysid.arguments import check_kind
from rbjax.sysid.data.recording import Channel, Recording
from rbjax.sysid.estimators.identification import fitted
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.simulation.runs import ordered, start_of
from rbjax.sysid.simulation.traces import Trace
from rbjax.sysid.statistics.precision import in_double


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """Repetitions of an experiment.

    Fields:
        names: (n,) of the unknowns.
        truth: (n,) values of the simulation.
        values: (k, n) estimates.
        sigma: (k, n) standard deviations, as estimated by each repetition.
        inside: (k, n), whether its intervals contain the truth.
        level: the nominal share of intervals that do.
        seen: (n,), whether the data identify an unknown by itself; otherwise its interval is
            infinite.
        failed: the number of repetitions that did not converge.
        good: the number of repetitions whose verdict is good.
    """

    names: tuple[str, ...]
    truth: np.ndarray
    values: np.ndarray
    sigma: np.ndarray
    inside: np.ndarray
    level: float
    seen: np.ndarray
    failed: int
    good: int = 0

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


@in_double
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
        found: a fit, from `identify`.
        repetitions: how many, 2 or more.
        level: of the intervals.
        seed: of the noise, which is independent. For loss="squares" it is normal, with the standard
            deviation that each channel states, or of the fit's residuals. For "huber" it is drawn
            from the residuals of the fit, with their outliers.
        progress: whether a line shows the progress.

    Returns:
        `MonteCarlo`.

    Raises:
        InputError: data without noise; a level outside of (0, 1).

    Source: Efron & Tibshirani, *An Introduction to the Bootstrap*, 6.5 (the parametric bootstrap)
    and 9.4 (bootstrapping residuals).

    Example:
        >>> import rbjax as rb, numpy as np
        >>> from rbjax.sysid import Channel, Recording, Unknown, identify, monte_carlo
        >>> model, t = rb.load("pendulum"), np.arange(51) * 0.02
        >>> q = rb.rollout(model, rb.State(np.ones(1), np.zeros(1)), None, 0.02, steps=50).q
        >>> q = q + 1e-3 * np.random.default_rng(0).normal(size=q.shape)
        >>> found = identify(
        ...     model, Recording("swing", {"q": Channel(t, q)}),
        ...     {"damping": Unknown("joints.damping", 0)},
        ... )
        >>> again = monte_carlo(found, 20)
        >>> again.values.shape
        (20, 1)
    """
    check_kind("monte_carlo", "found", found, Identified, "the result of `identify`")
    integer("monte_carlo", "repetitions", repetitions, least=2)
    integer("monte_carlo", "seed", seed, least=0)
    if not isinstance(level, (int, float)) or not 0 < level < 1:
        raise InputError(f"monte_carlo: level is {level}, expected a number between 0 and 1")
    of, said = found.error, found.estimates
    if not found.noisy:
        raise InputError(
            "monte_carlo: the fit has no noise, expected channels that say theirs, or residuals "
            "from which it is estimated"
        )
    how = found.options._replace(grid=found.grid)
    n = of.shared
    truth, names = said.values[:n], said.names[:n]
    rng = np.random.default_rng(seed)
    seen = np.isfinite(said.sigma[:n])
    values, sigma, inside, failed, good = [], [], [], 0, 0
    with progress_line("monte_carlo", progress) as say:
        for k in range(repetitions):
            say(f"{k} of {repetitions} repetitions")
            runs = [_repeated(found, j, rng) for j in range(len(found.recordings))]
            one = fitted(of.setup, of.unknowns, runs, how)
            failed += not one.success
            good += one.verdict.good
            spans = [one.estimates.interval(name, level) for name in names]
            values.append([*one.values.values()])
            sigma.append([x.sigma for x in spans])
            inside.append([x.low <= y <= x.high for x, y in zip(spans, truth, strict=True)])
    return MonteCarlo(
        names, truth, np.array(values), np.array(sigma), np.array(inside), level, seen, failed, good
    )  # fmt: skip


def _repeated(found: Identified, j: int, rng: np.random.Generator) -> Recording:
    """Recording j with the readings of the simulation at the estimates, and other noise."""
    recording, of = found.recordings[j], found.error
    traces = found.traces[recording.name]
    first = found.options.starts is False or (
        recording.start_is_known and recording.initial_state is None
    )  # its first readings are the state
    begins = start_of(found.setup, recording)
    channels = dict(recording.channels)
    for sensor, trace in traces.items():
        columns = trace.columns
        there = ~np.isnan(trace.recorded)
        weights = np.asarray(of.runs.weights[sensor])[j][: len(trace.t)]
        if of.loss == "huber" and trace.measured:
            pool = [t[sensor] for t in found.traces.values()]
            noise = _drawn(pool, len(trace.t), rng)
        else:
            w = np.asarray(columns.weights(jnp.asarray(weights)))
            noise = np.where(w > 0, 1 / np.where(w > 0, w, 1.0), 0.0) * rng.normal(size=w.shape)
        if first and sensor in ("q", "v"):
            noise[0] = 0.0
        seen = np.asarray(jax.vmap(columns.plus)(jnp.asarray(trace.simulated), jnp.asarray(noise)))
        old = ordered(found.setup.model, recording)[sensor]
        whole = np.full(old.values.shape, np.nan)
        at = int(np.searchsorted(old.t, begins - 1e-9))
        whole[at : at + len(seen)] = np.where(there, seen, np.nan)
        channels[sensor] = Channel(old.t, whole, old.names, noise=old.noise, dropped="nan")
    return dataclasses.replace(recording, channels=channels)


def _drawn(pool: Sequence[Trace], count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, columns): recorded minus simulated values of random samples, drawn by column."""
    off = []
    for trace in pool:
        there = ~np.isnan(trace.recorded).any(1)
        minus = jax.vmap(trace.columns.minus)
        off.append(np.asarray(minus(jnp.asarray(trace.recorded[there]), trace.simulated[there])))
    every = np.concatenate(off)
    return np.stack([rng.choice(column, count) for column in every.T], 1)
