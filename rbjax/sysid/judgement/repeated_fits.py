"""`monte_carlo`: repetitions of a fit to simulated recordings with random noise.

    recorded_k = reading(motion(p_found)) + noise_k,        p_k = identify(guess, recorded_k)
Each repetition is a complete `identify` from the first guess, with the options of the fit. If the
intervals of the fit are right, the p_k scatter with the covariance of the fit, and a share `level`
of their intervals contains p_found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance, integer
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.progress import progress_line
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.estimators.identification import fit_in_stages
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.simulation.runs import order_columns, start_time
from rbjax.sysid.simulation.traces import Trace
from rbjax.sysid.statistics.intervals import student_quantile
from rbjax.sysid.statistics.precision import in_double


@displayed
@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """The result of `monte_carlo`.

    Fields:
        names: (n,) names of the unknowns.
        truth: (n,) values in the simulation.
        values: (k, n) estimates of the repetitions.
        sigma: (k, n) standard deviations, as estimated by each repetition.
        inside: (k, n) whether each interval contains the true value.
        level: nominal share of intervals that contain the true value.
        identifiable: (n,) whether the data identify each unknown by itself; otherwise its interval
            is infinite.
        failed: number of repetitions that did not converge.
        good: number of repetitions with a good verdict.
    """

    names: tuple[str, ...]
    truth: np.ndarray
    values: np.ndarray
    sigma: np.ndarray
    inside: np.ndarray
    level: float
    identifiable: np.ndarray
    failed: int
    good: int = 0

    @property
    def coverage(self) -> float:
        """The share of intervals that contain the true value, over all identifiable unknowns."""
        return float(self.inside[:, self.identifiable].mean())

    @property
    def by_name(self) -> dict[str, float]:
        """The share of intervals that contain the true value, for each identifiable unknown."""
        pairs = zip(self.names, self.identifiable, self.inside.mean(0), strict=True)
        return {name: float(share) for name, known, share in pairs if known}

    @property
    def scatter(self) -> np.ndarray:
        """The sample standard deviations (n,) of the estimates."""
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
    """Repeat a fit with random noise to test its confidence intervals.

    Args:
        found: result of `identify`.
        repetitions: number of repetitions, at least 2.
        level: confidence level of the intervals.
        seed: seed of the noise, which is independent between samples. For loss="squares" it is
            normal, with the standard deviation that each channel states, or else of the fit's
            residuals. For "huber" it is drawn from the residuals of the fit, with their outliers.
        progress: show a progress line.

    Returns:
        `MonteCarlo`.

    Raises:
        InputError: data without noise, or a level outside of (0, 1).

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
    instance("monte_carlo", "found", found, Identified, "Identified: the result of `identify`")
    integer("monte_carlo", "repetitions", repetitions, least=2)
    integer("monte_carlo", "seed", seed, least=0)
    student_quantile("monte_carlo", level, np.inf)  # checks the level
    of, estimates = found.error, found.estimates
    if not found.noise_known:
        raise InputError(
            "monte_carlo: the fit has no noise, expected channels that state theirs, or residuals "
            "from which it is estimated"
        )
    how = found.options._replace(grid=found.grid)
    n = of.shared
    truth, names = estimates.values[:n], estimates.names[:n]
    rng = np.random.default_rng(seed)
    known = np.isfinite(estimates.sigma[:n])
    values, sigma, inside, failed, good = [], [], [], 0, 0
    with progress_line("monte_carlo", progress) as say:
        for k in range(repetitions):
            say(f"{k} of {repetitions} repetitions")
            runs = [_repeat_recording(found, j, rng) for j in range(len(found.recordings))]
            one = fit_in_stages(of.setup, of.unknowns, runs, how)
            failed += not one.success
            good += one.verdict.success
            spans = [one.estimates.interval(name, level) for name in names]
            values.append([*one.values.values()])
            sigma.append([x.sigma for x in spans])
            inside.append([x.low <= y <= x.high for x, y in zip(spans, truth, strict=True)])
    return MonteCarlo(
        names, truth, np.array(values), np.array(sigma), np.array(inside), level, known, failed,
        good,
    )  # fmt: skip


def _repeat_recording(found: Identified, j: int, rng: np.random.Generator) -> Recording:
    """Simulate recording j at the estimates, and add new noise."""
    recording, of = found.recordings[j], found.error
    traces = found.traces[recording.name]
    first = found.options.estimate_initial_state is False or (
        recording.start_is_known and recording.initial_state is None
    )  # the first readings are the exact initial state
    begins = start_time(found.setup, recording)
    channels = dict(recording.channels)
    for sensor, trace in traces.items():
        columns = trace.columns
        there = ~np.isnan(trace.recorded)
        weights = np.asarray(of.runs.weights[sensor])[j][: len(trace.t)]
        if of.loss == "huber" and trace.measured:
            pool = [t[sensor] for t in found.traces.values()]
            noise = _draw_residuals(pool, len(trace.t), rng)
        else:
            w = np.asarray(columns.weights(jnp.asarray(weights)))
            noise = np.where(w > 0, 1 / np.where(w > 0, w, 1.0), 0.0) * rng.normal(size=w.shape)
        if first and sensor in ("q", "v"):
            noise[0] = 0.0
        seen = np.asarray(jax.vmap(columns.plus)(jnp.asarray(trace.simulated), jnp.asarray(noise)))
        old = order_columns(found.setup.model, recording)[sensor]
        whole = np.full(old.values.shape, np.nan)
        at = int(np.searchsorted(old.t, begins - 1e-9))
        whole[at : at + len(seen)] = np.where(there, seen, np.nan)
        channels[sensor] = old.replace(old.t, whole)
    return dataclasses.replace(recording, channels=channels)


def _draw_residuals(pool: Sequence[Trace], count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw residuals (count, columns) at random with replacement, independently for each column."""
    off = []
    for trace in pool:
        there = ~np.isnan(trace.recorded).any(1)
        minus = jax.vmap(trace.columns.minus)
        off.append(np.asarray(minus(jnp.asarray(trace.recorded[there]), trace.simulated[there])))
    every = np.concatenate(off)
    return np.stack([rng.choice(column, count) for column in every.T], 1)
