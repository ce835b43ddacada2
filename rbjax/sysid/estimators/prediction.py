"""`prediction_error`: maximum likelihood of parameters of a motion with process noise.

    min over p, Q, R of  sum over samples of  z^T S^-1 z + log det S
z is the difference between a sample and its prediction from all earlier samples, and S is its
covariance, both from a Kalman filter (`likelihood`). An unmeasured disturbance changes all later
motion. Therefore the simulation error of `identify` is correlated over the whole recording, and its
intervals are too narrow. The error of a one-step prediction is not correlated. The covariances Q of
the process noise and R of the sensors are estimated too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, integer
from rbjax.display import displayed
from rbjax.dynamics import mass_matrix
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.errors import InputError
from rbjax.estimation.kalman import KalmanFiltered, Smoothed, kalman_smoother
from rbjax.model import Model
from rbjax.progress import progress_line
from rbjax.status import HasStatus, Status
from rbjax.sysid.arguments import names_of, recordings_of, setup_of
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.estimators.least_squares import Tolerances, minimise
from rbjax.sysid.estimators.likelihood import DRIVES, Likelihood, NoiseLevels, Series, make_series
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.parameters.unknowns import Parametrisation
from rbjax.sysid.simulation.runs import order_columns
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.statistics.comparisons import HeldOut, held_out
from rbjax.sysid.statistics.fit_statistics import FitStatistics, fit_statistics
from rbjax.sysid.statistics.intervals import Estimates
from rbjax.sysid.statistics.precision import cast, in_double
from rbjax.sysid.statistics.rank import Combinations, combinations, project_out_others

#: weight of the prior relative to the largest curvature, except in the last steps
PRIOR_WEIGHT = 1e-10
#: decreases of -2 log p: 1e-9 is a step of 3e-5 standard deviations, 1e-4 a step of 0.01
OF_LIKELIHOOD = Tolerances(flat=1e-9, coarse=1e-9, optimal=1e-4, relative=False, calm=1e-3)
#: first guesses of the process noise, relative to the torque of the recorded motion
TRIALS = 10.0 ** np.arange(-4, 2)


@displayed
@dataclass(frozen=True, eq=False)
class Predicted(HasStatus):
    """The result of `prediction_error`.

    Fields:
        setup: set-up with the estimated parameters.
        values: name -> estimate.
        guess: name -> first guess.
        identifiable: identifiable combinations of the unknowns.
        estimates: unknowns and noise levels, with covariance and intervals.
        levels: noise levels, `drive` (nv,) in N m (or rad/s^2) and `reading` (rows,).
        recordings: fitted recordings.
        log_likelihood: maximum of the log likelihood.
        evaluations: number of evaluations of the likelihood.
        status: a `Status`.
        grid: grid of the filter.
        likelihood: the likelihood as a function of x.
        x: unknowns and logarithms of the noise levels at the maximum.
        first: set-up with the first guess, in float64.
        statistics: statistics of the innovations.
    """

    setup: Setup
    values: dict[str, float]
    guess: dict[str, float]
    identifiable: Combinations
    estimates: Estimates
    levels: NoiseLevels
    recordings: tuple[Recording, ...]
    log_likelihood: float
    evaluations: int
    status: Status
    grid: Grid
    likelihood: Likelihood
    x: np.ndarray
    first: Setup
    statistics: FitStatistics

    @property
    def model(self) -> Model:
        """The model with the estimated parameters."""
        return self.setup.model

    def summary(self) -> str:
        """Return the status and the 95 % interval of each estimate, one sentence a line."""
        first = f"{self.status.text} in {self.evaluations} evaluations"
        return "\n".join([first, *self.estimates.sentences()])

    @in_double
    def innovations(self, recordings: Sequence[Recording] | None = None) -> dict[str, np.ndarray]:
        """Compute the errors of one-step predictions (samples, rows) by recording.

        The default are the fitted recordings. Missing samples are nan.
        """
        names, series, f = self._filter(recordings)
        z = np.where(np.asarray(series.arrived), np.asarray(f.innovation), np.nan)
        z[:, 0] = np.nan  # the initial state
        return dict(zip(names, z, strict=True))

    @in_double
    def whitened(self, recordings: Sequence[Recording] | None = None) -> dict[str, np.ndarray]:
        """Compute the whitened innovations L^-1 z by recording (variance 1 for a true model)."""
        off = self.innovations(recordings)
        S = np.asarray(self._filter(recordings)[2].innovation_covariance)
        each = np.linalg.solve(np.linalg.cholesky(S), np.nan_to_num(list(off.values()))[..., None])
        return {
            name: np.where(np.isnan(z), np.nan, e[..., 0])
            for (name, z), e in zip(off.items(), each, strict=True)
        }

    @in_double
    def smoothed(self, recordings: Sequence[Recording] | None = None) -> dict[str, Smoothed]:
        """Compute smoothed states (samples, ...) with covariances, at grid instants, by recording.

        The default are the fitted recordings.
        """
        names, _, f = self._filter(recordings)
        space = self.likelihood.space(cast(self.setup, np.float64))
        found = jax.jit(jax.vmap(lambda f: kalman_smoother(space, f)))(f)
        return {name: jax.tree.map(lambda a: a[k], found) for k, name in enumerate(names)}  # noqa: B023

    def validate(self, recordings: Sequence[Recording]) -> HeldOut:
        """Judge the model by one-step predictions of q on recordings that were not fitted.

        Raises:
            InputError: a recording that was fitted.
        """
        nv = self.setup.model.nv
        seen, unseen = self.innovations(), self.innovations(recordings)
        return held_out(
            {name: z[:, :nv] for name, z in seen.items()},
            {name: z[:, :nv] for name, z in unseen.items()},
        )

    def _filter(
        self, recordings: Sequence[Recording] | None
    ) -> tuple[list[str], Series, KalmanFiltered]:
        runs = self.recordings if recordings is None else recordings_of("Predicted", recordings)
        of = self.likelihood
        series = of.series if recordings is None else make_series(self.first, runs, self.grid)
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
    max_evaluations: int = 60,
    progress: bool = False,
) -> Predicted:
    """Estimate parameters by maximum likelihood, for a robot with unmeasured disturbances.

    Use it if the residuals of `identify` are correlated because of process noise. All computations
    are in float64.

    Args:
        model: robot with first guesses; a `Setup`; or a result of `identify` to start from.
        recordings: recordings with channels "q", optional "v" and "ctrl", and samples at the
            instants of the grid. Noise that a channel does not state is estimated. The noise of
            attitudes (in rad) is always estimated. State known noise, since fast sensors contain
            little information on it.
        unknowns: name -> unknown, as for `identify`.
        grid: steps of the integration. None: RK4 steps at the fastest clock.
        drive: kind of process noise, "torque" or "acceleration". It is normal, constant over each
            period of the grid and independent between periods, with an estimated standard deviation
            for each coordinate.
        driven: names of the joints with process noise. None: all.
        max_evaluations: largest number of evaluations of the likelihood.
        progress: show a progress line.

    Returns:
        `Predicted`. The covariance is the inverse Fisher information, or a sandwich estimate if the
        innovations are correlated in time.

    Raises:
        InputError: recordings that do not match the model or the grid, or a set-up with delays.
        UnknownName: an unknown drive, leaf, body or joint.

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
    integer(where, "max_evaluations", max_evaluations, least=1)
    choice("drive", drive, DRIVES)
    sought = Unknowns.of(where, unknowns, setup)
    if grid is None:
        clocks = [run[s] for run in runs for s in ("q", "v", "ctrl") if s in run.channels]
        grid = Grid(min((c.step for c in clocks), default=1.0))
    series = make_series(setup, runs, grid)
    levels, reads = _first_levels(setup, runs, series)
    drives = _driven(where, setup.model, driven)
    levels = levels._replace(drive=np.where(drives, _moving_drive(setup, series, grid, drive), 0.0))
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
            of, x, prior_weights=(PRIOR_WEIGHT,), max_evaluations=max_evaluations,
            tolerances=OF_LIKELIHOOD, watch=lambda k, value, x: say(
                f"evaluation {k} of at most {max_evaluations}, -2 log p {value:.6g}"
            ),
        )  # fmt: skip
    x = best.x
    names = [*sought.names, *_level_names(setup.model, of, drive)]
    scale = np.concatenate([np.ones(n), np.exp(x[n:])])  # d log s = d s / s
    bounds = sought.limits(setup) | dict.fromkeys(names[n:], (0.0, np.inf))
    statistics = fit_statistics(
        names, np.concatenate([x[:n], scale[n:]]), of.columns(x, scale), bounds=bounds
    )
    found = cast(sought.write(setup, jnp.asarray(x[:n])), dtype)
    values, first = (dict(zip(sought.names, map(float, p), strict=True)) for p in (x[:n], guess))
    return Predicted(
        found, values, first, combinations(project_out_others(best.triangle, n), sought.names),
        statistics.estimates,
        NoiseLevels(*(np.asarray(a) for a in of.levels_of(x))), tuple(runs), -best.cost / 2,
        best.evaluations + len(TRIALS), best.status, grid, of, x, setup, statistics,
    )  # fmt: skip


def _setup(model: Any, grid: Grid | None) -> tuple[Setup, Grid | None]:
    """Return the initial set-up and grid, and check that sensors and controls have no delay."""
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
    """Return the mask (nv,) of the coordinates with process noise."""
    if joints is None:
        return np.ones(model.nv, bool)
    found = np.zeros(model.nv, bool)
    for name in names_of(where, "driven", [joints] if isinstance(joints, str) else joints):
        found[model.v_slice(choice("joint", name, model.joint_names))] = True
    return found


def _first_levels(
    setup: Setup, runs: Sequence[Recording], series: Series
) -> tuple[NoiseLevels, np.ndarray]:
    """Return the noise of the sensors (rows,), and the mask of the unknown entries.

    Noise that is not stated is estimated from third differences.
    """
    model = setup.model
    minus = jax.vmap(lambda a, b: difference(model, a, b))
    sigma, sought = [], []
    for j, sensor in enumerate(series.readings):
        channels = [order_columns(model, run)[sensor] for run in runs]
        stated = [c.noise for c in channels if c.noise is not None and c.noise.size == model.nv]
        if len(stated) == len(runs):
            sigma.append(np.max(stated, 0))
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
    return NoiseLevels(np.zeros(model.nv), np.concatenate(sigma)), np.concatenate(sought)


def _moving_drive(setup: Setup, series: Series, grid: Grid, drive: str) -> np.ndarray:
    """Estimate the torque (nv,), or the acceleration, of the recorded motion.

    The estimate assumes that the largest speed is reached within 0.05 s or five periods, whichever
    is longer, with the mass matrix of the first configuration.
    """
    model = setup.model
    rate = np.asarray(series.speed).max(0) / max(0.05, 5 * grid.period)
    if drive == "acceleration":
        return rate
    q = jax.tree.map(lambda a: a[0], series.start).q
    return rate * np.diag(np.asarray(mass_matrix(model, q)))


def _level_names(model: Model, of: Likelihood, drive: str) -> list[str]:
    """Return the names of the unknown noise levels."""
    single = len(model.joint_names) == model.nv
    where = list(model.joint_names) if single else list(map(str, range(model.nv)))
    driving = [f"{drive} noise[{where[i]}]" for i in of.drives]
    reading = [f"{'qv'[i // model.nv]} noise[{where[i % model.nv]}]" for i in of.reads]
    return [*driving, *reading]
