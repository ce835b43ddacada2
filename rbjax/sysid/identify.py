"""`identify`: numbers of a set-up from recordings, by the error of simulated motions.

    min over p of  sum |weights (reading(motion(p)) - recorded)|^2
What the data show is fitted; what they leave open stays at the first guess, or as near to it as a
body's inertia allows, and the answer says in words which combinations were found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.progress import progress_line
from rbjax.solvers.arguments import check_whole
from rbjax.sysid.comparison import HeldOut, held_out
from rbjax.sysid.fit_file import read_fit, write_fit
from rbjax.sysid.free_run import free_run
from rbjax.sysid.least_squares import Minimum, minimise
from rbjax.sysid.rank import Combinations, combinations
from rbjax.sysid.recording import Recording
from rbjax.sysid.runs import Run, batch_of, grid_of, run_of
from rbjax.sysid.shooting import TIES, Shooting
from rbjax.sysid.simulation import Grid, Setup
from rbjax.sysid.simulation_error import SimulationError
from rbjax.sysid.statistics import Estimates, estimates
from rbjax.sysid.traces import Traces, rms_of, together, traces
from rbjax.sysid.unknowns import Parametrisation, Unknowns

#: an rms below this fraction of a channel's spread is no noise
NOISELESS = 1e-7
#: standard deviation of normal noise over the median of its size
NORMAL = 1.4826
#: pulls of the fit to short pieces, which is only a start
FIRST_PULLS = (1e-4, 1e-7)


@dataclass(frozen=True)
class Identified:
    """What recordings say of a robot.

    Fields: setup with the found numbers; values by name; guess, the first ones; found, the
    combinations of them that the data show, `found.words()`; estimates, their covariance and
    intervals; recordings that were fitted, and traces, what they recorded beside what is simulated;
    evaluations of the residual; ok and message, whether the fit converged; error, the simulation;
    noisy, whether the noise of all channels is known.
    """

    setup: Setup
    values: dict[str, float]
    guess: dict[str, float]
    found: Combinations
    estimates: Estimates
    recordings: tuple[Recording, ...]
    traces: Traces
    evaluations: int
    ok: bool
    message: str
    grid: Grid
    error: SimulationError
    noisy: bool

    @property
    def model(self) -> Model:
        """The model with the found numbers."""
        return self.setup.model

    @property
    def rms(self) -> dict[str, np.ndarray]:
        """By sensor, the error of the simulation, one number a column."""
        return rms_of(self.traces)

    def save(self, path: str | Path) -> None:
        """Writes values, intervals and errors as JSON; `identify(..., resume=path)` goes on."""
        intervals = {name: self.estimates.interval(name) for name in self.values}
        write_fit(
            path, list(self.values), self.estimates.values, ok=self.ok, message=self.message,
            guess=self.guess, evaluations=self.evaluations,
            sigma={n: x.sigma if np.isfinite(x.sigma) else None for n, x in intervals.items()},
            rms={sensor: rms.tolist() for sensor, rms in self.rms.items()},
        )  # fmt: skip

    def simulated(
        self, recordings: Sequence[Recording], *, starts: bool | None = None
    ) -> Traces:
        """Other recordings beside what is simulated from their own first samples, or with `starts`
        from the first states that suit them best (`free_run`). None: as the fit did."""
        starts = self.error.own > 0 if starts is None else starts
        noise = {sensor: np.where(rms > 0, rms, 1.0) for sensor, rms in self.rms.items()}
        return free_run(self.setup, recordings, grid=self.grid, starts=starts, noise=noise)

    def on(self, recordings: Sequence[Recording], *, starts: bool | None = None) -> HeldOut:
        """The verdict on recordings that the fit never saw, simulated as `simulated` does.

        Raises:
            InputError: a recording that was fitted.
        """
        seen, unseen = self.traces, self.simulated(recordings, starts=starts)
        return held_out(
            {name: sensors["q"].residual for name, sensors in seen.items()},
            {name: sensors["q"].residual for name, sensors in unseen.items()},
            measured={name: sensors["q"].recorded for name, sensors in unseen.items()},
        )


def identify(
    model: Model | Setup,
    recordings: Recording | Sequence[Recording],
    unknowns: Mapping[str, Parametrisation],
    *,
    grid: Grid | None = None,
    pieces: float | None = None,
    shooting: float | None = None,
    starts: bool = False,
    loss: str = "squares",
    steps: int = 100,
    save: str | Path | None = None,
    resume: str | Path | Mapping[str, float] | None = None,
    progress: bool = False,
) -> Identified:
    """Numbers of a model, its sensors and its controller from one or more recordings.

    Args:
        model: the robot with first guesses; or a `Setup`, where sensors, a controller or a delay
            are part of what is simulated.
        recordings: with channels "q", perhaps "v" and "ctrl"; each is simulated from its first
            sample.
        unknowns: name -> `Unknown`, `Inertia`, `Shared`, `FixedTotal`, `Tilt`, `Derived`.
        grid: how motion is integrated; steps of RK4 at the clock of the commands (of "q" without
            them) if None.
        pieces: length in s of pieces that are fitted first, each from its first sample, so that a
            poor first guess does not lose the motion. None: no such fit.
        shooting: length in s of pieces that are fitted first and then tied, end to start, ever more
            stiffly, until they are one motion (`Shooting`): for a long or chaotic motion, which
            `pieces` may not find. Forces and controllers that depend on time see that of a piece.
            None: no such fit.
        starts: whether each recording's first state is sought too, from what was recorded. It must
            be where sensors are noisy.
        loss: "squares", or "huber", by which outliers count less.
        steps: evaluations of the residual at most, of each fit.
        save: a file that holds the best numbers so far, and at the end the result.
        resume: such a file, or name -> value, from which the fit goes on.
        progress: whether a line shows the progress.

    Returns:
        `Identified`. Channels that do not say their noise get that of their residuals, a number for
        each column.

    Raises:
        InputError: recordings that do not suit the model; no unknowns, one outside of its range, or
            one that moves nothing.
        UnknownName: an unknown names no leaf or body.

    Source: Ljung, *System Identification*, 2nd ed., 7; Lee, Wensing & Park, IEEE T-RO 36(2), 2020.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> from rbjax.sysid import Channel, Recording, Unknown, identify
        >>> model, t = rb.load("pendulum"), np.arange(101) * 0.01
        >>> heavier = model.replace(bodies=model.bodies.replace(mass=np.array([1.3])))
        >>> push = np.ones((100, 1))
        >>> seen = rb.rollout(heavier, model.default_state(), push, 0.01, integrator="rk4")
        >>> run = Recording("swing", {"q": Channel(t, seen.q), "ctrl": Channel(t[:-1], push)})
        >>> found = identify(model, run, {"mass": Unknown("bodies.mass", 0, positive=True)})
        >>> round(found.values["mass"], 2)
        1.3
    """
    setup = model if isinstance(model, Setup) else Setup.of(model)
    runs = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if not runs or not all(isinstance(r, Recording) for r in runs):
        raise InputError(f"identify: recordings is {recordings!r}, expected one Recording or more")
    check_whole("identify", "steps", steps, 1)
    if loss not in ("squares", "huber"):
        raise InputError(f'identify: loss is {loss!r}, expected "squares" or "huber"')
    sought = Unknowns.of("identify", unknowns, setup)
    grid = grid_of(runs) if grid is None else grid
    start = np.asarray(sought.read(setup), float)
    evaluations = 0
    with progress_line("identify", progress) as say:

        def fit(
            of: SimulationError | Shooting, x: np.ndarray, *, last: bool = True, **how: Any
        ) -> Minimum:
            nonlocal evaluations
            say("simulating")
            x, near = (np.append(a, np.zeros(of.size))[: of.size] for a in (x, prior))
            first = of.triangle(x)
            _check_moves(sought, first[:, : len(start)])
            least_cost = np.inf

            def watch(k: int, cost: float, x: np.ndarray) -> None:
                nonlocal least_cost
                say(f"evaluation {k} of at most {steps}, squares {cost:.4g}")
                if save is not None and cost < least_cost:
                    least_cost = cost
                    kept = x if last else x[: len(start)]  # the starts of pieces serve no other fit
                    write_fit(save, sought.names, kept, ok=False, message="not ended")

            least = minimise(of, x, near, triangle=first, steps=steps, watch=watch, **how)
            evaluations += least.evaluations
            return least

        def error(runs: Sequence[Recording]) -> SimulationError:
            data = batch_of(setup, runs, grid)
            return SimulationError(setup, sought, data, grid, starts=starts, loss=loss)

        prior = start
        x = start if resume is None else read_fit(resume, sought.names)
        if pieces is not None and resume is None:
            short = [piece for run in runs for piece in run.pieces(pieces)]
            x = fit(error(short), x, last=False, pulls=FIRST_PULLS).x[: len(start)]
        if shooting is not None and resume is None:
            single = [run_of(setup, run, grid) for run in runs]
            tied = Shooting(setup, sought, single, grid, shooting, loss=loss)
            for tied.tie in TIES:  # stiff ties must not make the prior's pull stronger
                pulls = tuple(w / max(tied.tie, 1.0) ** 2 for w in FIRST_PULLS)
                x = fit(tied, x, last=False, pulls=pulls).x
            # one chaotic motion is so steep that any pull to the first guess would lose it
            x = prior = tied.began(x) if starts else x[: len(start)]
        of = error(runs)
        least = fit(of, x)
        seen = traces(setup.model, of, least.x, runs)
        estimated = _weighed(of.runs, seen, runs, robust=loss == "huber")
        if estimated is not None:
            of = of.on(estimated)
            least = fit(of, least.x)
            seen = traces(setup.model, of, least.x, runs)
    n = len(start)
    p = least.x[:n]
    names = sought.names
    more = [f"start[{k}]" for k in range(of.size - n)]
    samples = sum(int((np.asarray(w) > 0).sum()) for w in of.runs.weights.values())
    noise = np.sqrt(least.cost / max(samples - of.size, 1)) if estimated is None else 1.0
    said = estimates(
        [*names, *more], least.x, least.triangle[:, :-1], max(noise, np.finfo(float).tiny),
        dof=max(samples - of.size, 1), bounds=sought.limits(setup),
    )  # fmt: skip
    found = sought.write(setup, jnp.asarray(p, setup.model.gravity.dtype))
    values, guess = (dict(zip(names, map(float, x), strict=True)) for x in (p, start))
    shown = combinations(least.triangle[:, :n], names)
    identified = Identified(
        found, values, guess, shown, said, tuple(runs), seen, evaluations, least.ok, least.message,
        grid, of, estimated is not None or all(_says_its_noise(runs, s) for s in of.runs.values),
    )  # fmt: skip
    if save is not None:
        identified.save(save)
    return identified


def _weighed(data: Run, seen: Traces, runs: Sequence[Recording], *, robust: bool) -> Run | None:
    """The data weighed by the noise of the residuals, where no channel says its own; None where
    all say it, or there is none. Outliers do not count for `robust`."""
    weights, changed = dict(data.weights), False
    for sensor in data.values:
        if _says_its_noise(runs, sensor):
            continue
        r, spread = together(seen, sensor), np.asarray(data.values[sensor]).std(axis=(0, 1))
        if (~np.isnan(r)).sum(0).max() <= len(runs):  # only the starts, which are no measurement
            continue
        sigma = NORMAL * np.nanmedian(np.abs(r), 0) if robust else np.sqrt(np.nanmean(r**2, 0))
        if not (sigma > NOISELESS * spread).all():
            return None
        weights[sensor] = jnp.asarray((np.asarray(weights[sensor]) > 0) / sigma)
        changed = True
    return data._replace(weights=weights) if changed else None


def _says_its_noise(runs: Sequence[Recording], sensor: str) -> bool:
    return all(run[sensor].noise is not None for run in runs)


def _check_moves(sought: Unknowns, J: np.ndarray) -> None:
    """`InputError` for an unknown none of whose numbers moves anything."""
    ends = np.cumsum(sought.sizes)
    largest = np.abs(J).max()
    for (name, u), end, size in zip(sought.members.items(), ends, sought.sizes, strict=True):
        if np.isfinite(largest) and not np.abs(J[:, end - size : end]).max() > 1e-12 * largest:
            raise InputError(
                f"identify: {name} ({u!r}) moves nothing that was recorded, expected unknowns that "
                "do: leave it out, or record a motion or a sensor that shows it"
            )
