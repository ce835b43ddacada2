"""`prediction_error`: numbers of a set-up where noise drives the motion.

    min over p, Q, R of  sum over samples of  z^T S^-1 z + log det S
z is what a sample is off from its prediction by all samples before it, S its covariance, both by a
Kalman filter (`likelihood`). A push that nobody measured moves a robot off the motion
that `identify` simulates, and never back: its error grows, hangs together over the whole recording
and is no white noise, so estimates scatter far more than their intervals say. A prediction over one
sample forgets the push. How large pushes and noise are is found with the numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer
from rbjax.dynamics import mass_matrix
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.errors import InputError, UnknownName
from rbjax.estimation.kalman import KalmanFiltered, Smoothed, kalman_smoother
from rbjax.model import Model
from rbjax.progress import progress_line
from rbjax.sysid.arguments import names_of, recordings_of, setup_of
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.estimators.least_squares import Tolerances, minimise
from rbjax.sysid.estimators.likelihood import DRIVES, Levels, Likelihood, Series, series_of
from rbjax.sysid.parameters.unknowns import Parametrisation, Unknowns
from rbjax.sysid.simulation.runs import ordered
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.statistics.comparisons import HeldOut, held_out
from rbjax.sysid.statistics.fit_statistics import FitStatistics, fit_statistics
from rbjax.sysid.statistics.intervals import Estimates
from rbjax.sysid.statistics.precision import cast, in_double
from rbjax.sysid.statistics.rank import Combinations, beside_others, combinations

#: weight of the guess relative to the largest curvature; the last steps are without it
PRIOR_WEIGHT = 1e-10
#: decreases of -2 log p: one that ends the search is a step of about 3e-5 standard deviations, that
#: of a maximum a hundredth of one
OF_LIKELIHOOD = Tolerances(flat=1e-9, coarse=1e-9, optimal=1e-4, relative=False, calm=1e-3)
#: first guesses of the drive, as parts of what moves the recording
TRIALS = 10.0 ** np.arange(-4, 2)


@dataclass(frozen=True, eq=False)
class Predicted:
    """The result of an identification with process noise.

    Fields:
        setup: with the estimated numbers.
        values, guess: the estimates and the first guess, by name.
        identifiable: the combinations of the unknowns that the data identify; `found.summary()`.
        estimates: of values and noise levels, with covariance and intervals.
        levels: of the noise: `drive` (nv,) N m (or rad/s^2) and `reading` (rows,).
        recordings: those that were fitted.
        log_likelihood: the maximum.
        evaluations: of the likelihood.
        success, message: whether the fit converged.
        grid: of the filter.
        likelihood, x: the likelihood, and the point that maximises it.
        first: the set-up with the first guess, in float64.
        statistics: of the innovations.
    """

    setup: Setup
    values: dict[str, float]
    guess: dict[str, float]
    identifiable: Combinations
    estimates: Estimates
    levels: Levels
    recordings: tuple[Recording, ...]
    log_likelihood: float
    evaluations: int
    success: bool
    message: str
    grid: Grid
    likelihood: Likelihood
    x: np.ndarray
    first: Setup
    statistics: FitStatistics

    @property
    def model(self) -> Model:
        """The model with the found numbers."""
        return self.setup.model

    @in_double
    def innovations(self, recordings: Sequence[Recording] | None = None) -> dict[str, np.ndarray]:
        """By recording, what one-step predictions are off (samples, rows), nan where nothing was
        measured; of those that were fitted if None."""
        names, series, f = self._filtered(recordings)
        there = np.asarray(series.arrived)
        z = np.where(there, np.asarray(f.innovation), np.nan)
        z[:, 0] = np.nan  # of which the first state was made
        return dict(zip(names, z, strict=True))

    @in_double
    def whitened(self, recordings: Sequence[Recording] | None = None) -> dict[str, np.ndarray]:
        """`innovations` over their standard deviations, L^-1 z: white, of variance 1, if the model
        is true (`whiteness`)."""
        off = self.innovations(recordings)
        S = np.asarray(self._filtered(recordings)[2].innovation_covariance)
        each = np.linalg.solve(np.linalg.cholesky(S), np.nan_to_num(list(off.values()))[..., None])
        return {
            name: np.where(np.isnan(z), np.nan, e[..., 0])
            for (name, z), e in zip(off.items(), each, strict=True)
        }

    @in_double
    def smoothed(self, recordings: Sequence[Recording] | None = None) -> dict[str, Smoothed]:
        """By recording, the states (samples, ...) at the instants of the grid that all samples
        together say, and their covariances."""
        names, _, f = self._filtered(recordings)
        space = self.likelihood.space(cast(self.setup, np.float64))
        found = jax.jit(jax.vmap(lambda f: kalman_smoother(space, f)))(f)
        return {name: jax.tree.map(lambda a: a[k], found) for k, name in enumerate(names)}  # noqa: B023

    def on(self, recordings: Sequence[Recording]) -> HeldOut:
        """The verdict on recordings that the fit never saw: one-step predictions of q there.

        Raises:
            InputError: a recording that was fitted.
        """
        nv = self.setup.model.nv
        seen, unseen = self.innovations(), self.innovations(recordings)
        return held_out(
            {name: z[:, :nv] for name, z in seen.items()},
            {name: z[:, :nv] for name, z in unseen.items()},
        )

    def _filtered(
        self, recordings: Sequence[Recording] | None
    ) -> tuple[list[str], Series, KalmanFiltered]:
        runs = self.recordings if recordings is None else recordings_of("Predicted", recordings)
        of = self.likelihood
        series = of.series if recordings is None else series_of(self.first, runs, self.grid)
        return [run.name for run in runs], series, of.filtered(self.x, series)


@in_double
def prediction_error(
    model: Model | Setup | Identified,
    recordings: Recording | Sequence[Recording],
    unknowns: Mapping[str, Parametrisation],
    *,
    grid: Grid | None = None,
    drive: str = "torque",
    driven: Sequence[str] | None = None,
    steps: int = 60,
    progress: bool = False,
) -> Predicted:
    """Numbers of a model by maximum likelihood, where pushes that nobody measured move the robot.

    Args:
        model: the robot with first guesses; a `Setup`; or what `identify` found, to start from.
        recordings: with channels "q", perhaps "v" and "ctrl", whose samples lie at the instants of
            the grid. A channel that says its noise has it; that of others is found, and so is
            that of configurations with attitudes, in rad. Say it where it is known: fast sensors
            tell little of it.
        unknowns: as for `identify`.
        grid: how motion is integrated; steps of RK4 at the fastest clock if None.
        drive: "torque" or "acceleration": what the noise is, normal, new in each period of the grid
            and held over it. Its standard deviation is found for each coordinate.
        driven: joints that noise drives; all if None.
        steps: evaluations at most.
        progress: whether a line shows the progress.

    Returns:
        `Predicted`. Intervals follow Fisher's information, or the sandwich form if the innovations
        are correlated in time (`fit_statistics`): in the limit of many samples, 95 % of them
        contain the truth. All is computed in float64, as in `identify`.

    Raises:
        InputError: recordings that do not suit the model or the grid; a set-up with delays.
        UnknownName: an unknown names no leaf or body; no such joint.

    Source: Ljung, *System Identification*, 2nd ed., 7.4 and 9.4; Astrom, Automatica 16(5), 1980.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> from rbjax.sysid import Channel, Grid, Recording, Unknown, prediction_error
        >>> model, rng, t = rb.load("pendulum"), np.random.default_rng(0), np.arange(151) * 0.02
        >>> push = 4 * np.sin(3 * t[:-1])[:, None]
        >>> felt = push + 0.3 * rng.normal(size=push.shape)
        >>> seen = rb.rollout(model, model.default_state(), felt, 0.02)
        >>> q = Channel(t, seen.q + 0.001 * rng.normal(size=(151, 1)), noise=[0.001])
        >>> run = Recording("swing", {"q": q, "ctrl": Channel(t[:-1], push)})
        >>> guess = model.replace(bodies=model.bodies.replace(mass=np.array([1.4], "float32")))
        >>> mass = {"mass": Unknown("bodies.mass", 0, positive=True)}
        >>> found = prediction_error(guess, run, mass, grid=Grid(0.02, 1, "semi_implicit_euler"))
        >>> interval = found.estimates.interval("mass")
        >>> bool(interval.low < 1.0 < interval.high), bool(interval.sigma < 0.05)
        (True, True)
    """
    where = "prediction_error"
    setup, grid = _setup(model, grid)
    dtype, setup = setup.model.gravity.dtype, cast(setup, np.float64)
    runs = recordings_of(where, recordings)
    integer(where, "steps", steps, least=1)
    if drive not in DRIVES:
        raise InputError(f"{where}: drive is {drive!r}, expected one of {DRIVES}")
    sought = Unknowns.of(where, unknowns, setup)
    if grid is None:
        clocks = [run[s] for run in runs for s in ("q", "v", "ctrl") if s in run.channels]
        grid = Grid(min((c.step for c in clocks), default=1.0))
    series = series_of(setup, runs, grid)
    levels, reads = _first_levels(setup, runs, series)
    drives = _driven(where, setup.model, driven)
    levels = levels._replace(drive=np.where(drives, _moving(setup, series, grid, drive), 0.0))
    of = Likelihood(
        setup, sought, series, grid, levels=levels, drives=drives, reads=reads, drive=drive
    )
    guess = np.asarray(sought.read(setup), float)
    n, k = len(guess), of.drives.size
    logs = np.log(np.concatenate([levels.drive[of.drives], levels.reading[of.reads]]))
    start = np.concatenate([guess, logs])
    with progress_line(where, progress) as say:
        trials = np.tile(start, (len(TRIALS), 1))
        trials[:, n : n + k] += np.log(TRIALS)[:, None]
        x = min(trials, key=of.cost) if k else start
        best = minimise(
            of, x, prior_weights=(PRIOR_WEIGHT,), max_evaluations=steps, tolerances=OF_LIKELIHOOD,
            watch=lambda k, value, x: say(
                f"evaluation {k} of at most {steps}, -2 log p {value:.6g}"
            ),
        )  # fmt: skip
    x = best.x
    names = [*sought.names, *_level_names(setup.model, of, drive)]
    scale = np.concatenate([np.ones(n), np.exp(x[n:])])  # d log s = d s / s
    bounds = sought.limits(setup) | dict.fromkeys(names[n:], (0.0, np.inf))
    said = fit_statistics(
        names, np.concatenate([x[:n], scale[n:]]), of.columns(x, scale), bounds=bounds
    )
    found = cast(sought.write(setup, jnp.asarray(x[:n])), dtype)
    values, first = (dict(zip(sought.names, map(float, p), strict=True)) for p in (x[:n], guess))
    return Predicted(
        found, values, first, combinations(beside_others(best.triangle, n), sought.names),
        said.estimates,
        Levels(*(np.asarray(a) for a in of.levels_of(x))), tuple(runs), -best.cost / 2,
        best.evaluations + len(TRIALS), best.success, best.message, grid, of, x, setup, said,
    )  # fmt: skip


def _setup(model: Any, grid: Grid | None) -> tuple[Setup, Grid | None]:
    """The set-up and the grid to start from; sensors and controls without delay."""
    if isinstance(model, Identified):
        model, grid = model.setup, model.grid if grid is None else grid
    setup = setup_of("prediction_error", model)
    late = [
        f"{s} {float(sensor.delay):g} s, so Channel(c.t - {float(sensor.delay):g}, ...)"
        for s, sensor in setup.sensors.items() if float(sensor.delay) != 0
    ]  # fmt: skip
    if setup.delay is not None:
        seconds = float(setup.delay)
        late.append(f"ctrl {seconds:g} s, so Channel(c.t + {seconds:g}, ...)")
    if late:
        raise InputError(
            "prediction_error: the set-up has delays, expected none: a filter would need the "
            "states of before. Find them by `identify`, take them out of the set-up (delay=None, "
            f"a sensor's delay 0) and off the recordings' clocks: {'; '.join(late)}. Samples must "
            "lie at instants of the grid, so choose a period of which each delay is a multiple"
        )
    return setup, grid


def _driven(where: str, model: Model, joints: Sequence[str] | None) -> np.ndarray:
    """(nv,) whether noise drives a coordinate."""
    if joints is None:
        return np.ones(model.nv, bool)
    found = np.zeros(model.nv, bool)
    for name in names_of(where, "driven", [joints] if isinstance(joints, str) else joints):
        if name not in model.joint_names:
            raise UnknownName("joint", name, model.joint_names)
        found[model.v_slice(name)] = True
    return found


def _first_levels(
    setup: Setup, runs: Sequence[Recording], series: Series
) -> tuple[Levels, np.ndarray]:
    """Noise of the sensors (rows,): as said, or from third differences, of which smooth motion has
    little; and which of them are sought."""
    model = setup.model
    minus = jax.vmap(lambda a, b: difference(model, a, b))
    sigma, sought = [], []
    for j, sensor in enumerate(series.readings):
        channels = [ordered(model, run)[sensor] for run in runs]
        said = [c.noise for c in channels if c.noise is not None and c.noise.size == model.nv]
        if len(said) == len(runs):
            sigma.append(np.max(said, 0))
            sought.append(np.zeros(model.nv, bool))
            continue
        there = np.asarray(series.arrived)[:, :, j * model.nv : (j + 1) * model.nv]
        steps = []
        for y, seen in zip(np.asarray(series.readings[sensor]), there, strict=True):
            y = y[seen.all(1)]
            moved = minus(y[:-1], y[1:]) if sensor == "q" else np.diff(y, axis=0)
            steps.append(np.asarray(moved))
        rough = np.concatenate([np.diff(d, n=2, axis=0) for d in steps])
        found = np.sqrt((rough**2).mean(0) / 20)
        least = 1e-6 * max(float(np.abs(np.concatenate(steps)).max()), 1e-6)
        sigma.append(np.maximum(found, least))
        sought.append(np.ones(model.nv, bool))
    return Levels(np.zeros(model.nv), np.concatenate(sigma)), np.concatenate(sought)


def _moving(setup: Setup, series: Series, grid: Grid, drive: str) -> np.ndarray:
    """(nv,) about what it takes to move the robot as recorded: the largest speed in a twentieth of
    a second or in five periods, against the inertia of the first configuration."""
    model = setup.model
    rate = np.asarray(series.speed).max(0) / max(0.05, 5 * grid.period)
    if drive == "acceleration":
        return rate
    q = jax.tree.map(lambda a: a[0], series.start).q
    return rate * np.diag(np.asarray(mass_matrix(model, q)))


def _level_names(model: Model, of: Likelihood, drive: str) -> list[str]:
    """Of the noise levels that are sought."""
    single = len(model.joint_names) == model.nv
    where = list(model.joint_names) if single else list(map(str, range(model.nv)))
    driving = [f"{drive} noise[{where[i]}]" for i in of.drives]
    reading = [f"{'qv'[i // model.nv]} noise[{where[i % model.nv]}]" for i in of.reads]
    return [*driving, *reading]
