"""The result of `identify`, with its file and validation, and simulation by `free_run`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, instance, real_array
from rbjax.display import Display, displayed, number, plural
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.status import HasStatus, Status
from rbjax.sysid.arguments import check_options, positive_numbers, recordings_of, setup_of
from rbjax.sysid.data.recording import HELD, Recording
from rbjax.sysid.estimators.least_squares import minimise
from rbjax.sysid.estimators.verdict import Verdict, without_outliers
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation.runs import default_grid, make_batch
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError
from rbjax.sysid.simulation.traces import Traces, make_traces, rms_of
from rbjax.sysid.statistics.comparisons import HeldOut, held_out
from rbjax.sysid.statistics.fit_statistics import FitStatistics
from rbjax.sysid.statistics.intervals import Estimates
from rbjax.sysid.statistics.precision import cast, in_double
from rbjax.sysid.statistics.rank import Combinations


class FitOptions(NamedTuple):
    """The options of a fit, with the meaning of the arguments of `identify`."""

    grid: Grid | None = None
    segments: float | None = None
    multiple_shooting: float | None = None
    estimate_initial_state: bool | None = None
    loss: str = "squares"
    max_evaluations: int = 100
    restarts: int = 4
    difference_step: float | None = None


@displayed
@dataclass(frozen=True)
class Identified(HasStatus):
    """The result of an identification.

    Fields:
        setup: set-up with the estimated parameters.
        values: name -> estimate.
        guess: name -> first guess.
        identifiable: identifiable combinations of the unknowns.
        estimates: values, covariance and intervals.
        recordings: fitted recordings.
        traces: recorded and simulated values.
        evaluations: number of evaluations of the residual.
        status: a `Status`.
        grid: grid of the simulation.
        error: simulation error, in float64.
        noise_known: whether the noise of all channels is stated or estimated.
        statistics: statistics of the residuals.
        verdict: verdict on the fit, with each failed check.
        notes: sentences on default choices, such as other starts and shorter steps.
        options: options of the fit.
    """

    setup: Setup
    values: dict[str, float]
    guess: dict[str, float]
    identifiable: Combinations
    estimates: Estimates
    recordings: tuple[Recording, ...]
    traces: Traces
    evaluations: int
    status: Status
    grid: Grid
    error: SimulationError
    noise_known: bool
    statistics: FitStatistics
    verdict: Verdict
    notes: tuple[str, ...]
    options: FitOptions

    @property
    def model(self) -> Model:
        """The model with the estimated parameters."""
        return self.setup.model

    def summary(self) -> str:
        """Return status, verdict, notes and intervals of the unknowns, one sentence a line."""
        first = [f"{self.status.text} in {self.evaluations} evaluations", self.verdict.summary()]
        return "\n".join([*first, *self.notes, *self.estimates.sentences()[: len(self.values)]])

    def _display_(self) -> Display:
        title = f"Identified: {self.status.text} in {plural(self.evaluations, 'evaluation')}"
        rows = []
        for name in self.values:
            x = self.estimates.interval(name)
            ends = (number(self.guess[name]), number(x.low), number(x.high))
            rows.append((name, number(x.value), *ends) if np.isfinite(x.sigma) else
                        (name, number(x.value), ends[0], "not identified", ""))  # fmt: skip
        columns = ("unknown", "estimate", "guess", "95 % from", "to")
        rms = (f"{s} {', '.join(map(number, x[:6]))}" for s, x in self.rms.items())
        notes = [self.verdict.summary(), f"rms error: {'; '.join(rms)}"]
        return Display(title, rows, columns, notes)

    @property
    def rms(self) -> dict[str, np.ndarray]:
        """The root mean square of the residual (n,), by sensor."""
        return rms_of(self.traces)

    def save(self, path: str | Path) -> None:
        """Write values, intervals and errors as JSON, for `identify(..., resume=path)`."""
        intervals = {name: self.estimates.interval(name) for name in self.values}
        write_fit(
            path, list(self.values), self.estimates.values, success=self.success,
            status=self.status.text, guess=self.guess, evaluations=self.evaluations,
            sigma={n: x.sigma if np.isfinite(x.sigma) else None for n, x in intervals.items()},
            rms={sensor: rms.tolist() for sensor, rms in self.rms.items()},
        )  # fmt: skip

    @in_double
    def simulated(
        self, recordings: Sequence[Recording], *, estimate_initial_state: bool | None = None
    ) -> Traces:
        """Simulate other recordings with the estimates.

        Args:
            recordings: recordings, for example for a validation.
            estimate_initial_state: whether each motion starts from the best-fitting initial state
                (`free_run`), or from the first samples. None: as in the fit.
        """
        recordings = recordings_of("simulated", recordings)
        if estimate_initial_state is None:
            estimate_initial_state = self.options.estimate_initial_state
        of = self.error
        p = jnp.asarray(self.estimates.values[: of.shared])
        setup: Setup = of.unknowns.write(of.setup, p)
        sigma = {sensor: setup.columns(sensor).noise(rms) for sensor, rms in self.rms.items()}
        noise = {sensor: np.where(rms > 0, rms, 1.0) for sensor, rms in sigma.items()}
        return free_run(
            setup, recordings, grid=self.grid, estimate_initial_state=estimate_initial_state,
            noise=noise,
        )  # fmt: skip

    @property
    def judged_sensor(self) -> str:
        """The sensor that `validate` uses by default.

        It is "q", or the first sensor that depends on an unknown if q has too few samples.
        """
        sensors = next(iter(self.traces.values()))
        if sensors["q"].measured:
            return "q"
        still = self.insensitive_sensors
        return next((s for s in sensors if sensors[s].measured and s not in still), "q")

    @property
    @in_double
    def insensitive_sensors(self) -> tuple[str, ...]:
        """The sensors with readings that depend on no unknown, and contain no information."""
        still = self.error.insensitive(self.estimates.values)
        seen = self.traces.values()
        return tuple(s for s in still if any(sensors[s].measured for sensors in seen))

    @property
    def unused_channels(self) -> tuple[str, ...]:
        """The recorded channels that were not fitted, since the set-up has no such sensor."""
        recorded = dict.fromkeys(channel for run in self.recordings for channel in run)
        return tuple(s for s in recorded if s not in self.error.runs.values and s != HELD)

    def validate(
        self,
        recordings: Sequence[Recording],
        *,
        estimate_initial_state: bool | None = None,
        sensor: str | None = None,
    ) -> HeldOut:
        """Judge the model by recordings that were not fitted.

        Args:
            recordings: recordings for `simulated`. Outliers are ignored if loss="huber".
            estimate_initial_state: whether to fit initial states, as in `simulated`.
            sensor: sensor whose error counts. None: `judged_sensor`.

        Raises:
            InputError: a recording that was fitted.
            UnknownName: a sensor that was not fitted.
        """
        recordings = recordings_of("validate", recordings)
        sensor = self.judged_sensor if sensor is None else sensor
        choice("sensor", sensor, self.rms)
        seen = self.traces
        unseen = self.simulated(recordings, estimate_initial_state=estimate_initial_state)
        if self.options.loss == "huber":
            seen, unseen = (without_outliers(x)[0] for x in (seen, unseen))
        return held_out(
            {name: sensors[sensor].residual for name, sensors in seen.items()},
            {name: sensors[sensor].residual for name, sensors in unseen.items()},
            measured={name: sensors[sensor].recorded for name, sensors in unseen.items()},
            noise=_stated_noise(recordings, sensor),
            unit=self.setup.unit(sensor),
        )


@in_double
def free_run(
    model: Model | Setup,
    recordings: Sequence[Recording],
    *,
    grid: Grid | None = None,
    estimate_initial_state: bool | None = False,
    noise: Mapping[str, np.ndarray] | None = None,
) -> Traces:
    """Simulate recordings with a model, for a comparison with the recordings or with another model.

    Args:
        model: robot, or a `Setup`.
        recordings: recordings with channels "q", optional "v" and "ctrl".
        grid: steps of the integration. None: the finest clock of all channels.
        estimate_initial_state: whether each motion starts from the initial state that fits the
            whole recording best (least squares), instead of the first readings, which are noisy.
            None: yes, except for known initial states.
        noise: sensor -> standard deviation (n,), the weights of that fit. None: the stated noise,
            or 1.

    Returns:
        Recording -> sensor -> `Trace`, with `residual`, in SI units.

    Raises:
        InputError: recordings that do not match the model, or noise without a recorded sensor.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> from rbjax.sysid import Channel, Recording, free_run
        >>> model, t = rb.load("pendulum"), np.arange(51) * 0.01
        >>> still = Channel(t, np.zeros(51))
        >>> hangs = Recording("hangs", {"q": still, "v": still})
        >>> float(abs(free_run(model, [hangs])["hangs"]["q"].residual).max())
        0.0
    """
    setup = cast(setup_of("free_run", model), np.float64)
    recordings = recordings_of("free_run", recordings)
    check_options("free_run", estimate_initial_state=estimate_initial_state)
    grid = default_grid(recordings, setup) if grid is None else grid
    data = make_batch(setup, recordings, grid)
    if noise is not None:
        weights = {s: (w > 0) / _noise_of(noise, s, w) for s, w in data.weights.items()}
        data = data._replace(weights=weights)
    none = Unknowns({}, (), ())
    of = SimulationError(setup, none, data, grid, estimate_initial_state=estimate_initial_state)
    x = minimise(of, np.zeros(of.size)).x if of.own else np.zeros(0)
    return make_traces(setup, of, x, recordings)


def _noise_of(noise: Any, sensor: str, weights: Any) -> np.ndarray:
    """Check the standard deviations of a sensor and return them."""
    if not isinstance(noise, Mapping) or sensor not in noise:
        raise InputError(
            f"free_run: noise has no sensor {sensor}, expected a dict with the standard deviations "
            "of each sensor that was recorded"
        )
    name = f"noise[{sensor!r}]"
    return positive_numbers("free_run", name, noise[sensor], weights.shape[-1], "column")


def _stated_noise(recordings: Sequence[Recording], sensor: str) -> float | None:
    """Return the root mean square of the stated noise of a sensor, or None if it is not stated."""
    noise = [run[sensor].noise for run in recordings if sensor in run.channels]
    if not noise or any(sigma is None for sigma in noise):
        return None
    return float(np.sqrt(np.mean(np.concatenate(noise) ** 2)))


def write_fit(path: str | Path, names: Sequence[str], x: np.ndarray, **more: Any) -> None:
    """Write a fit as JSON: the unknowns `names`, corrections of initial states, and `more`.

    The file is replaced in one operation, so an interrupted write does not damage it.
    """
    values = dict(zip(names, map(float, x), strict=False))
    corrections = np.asarray(x[len(names) :]).tolist()
    path = Path(path)
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps({"values": values, "starts": corrections, **more}, indent=1))
    part.replace(path)


def read_fit(fit: str | Path | Mapping[str, float], names: Sequence[str]) -> np.ndarray:
    """Read x from a file of `write_fit`, or from values by name.

    Raises:
        InputError: no such file, or a fit of other unknowns.
    """
    fix = "the file of a fit, or a dict name -> value"
    instance("identify", "resume", fit, (str, Path, Mapping), fix)
    values: Any = fit
    where, corrections = "resume", []
    if not isinstance(fit, Mapping):
        where = str(fit)
        try:
            held = json.loads(Path(fit).read_text(encoding="utf-8"))
            values, corrections = held["values"], held["starts"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"identify: cannot go on from {fit} ({error!r}), expected a file that a fit wrote"
            ) from error
    if list(values) != list(names):
        other = sorted(set(values) ^ set(names))
        raise InputError(
            f"identify: {where} is a fit of {len(values)} parameters, expected the same "
            f"{len(names)} in the same order; only one of the two has: {', '.join(other) or 'none'}"
        )
    x = [*values.values(), *corrections]
    return real_array("identify", where, x, "a fit of finite numbers")
