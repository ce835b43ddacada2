"""`identify`: numbers of a set-up from recordings, by the error of simulated motions.

    min over p of  sum |weights (reading(motion(p)) - recorded)|^2
Combinations of the unknowns that the data identify are fitted. The others stay at the first guess,
or as near to it as a body's inertia allows. The result names the combinations that were found. The
initial state of each recording is fitted too, unless it is known. A poor fit is tried again from
other starts, and the verdict names each check that fails.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.progress import Say, progress_line
from rbjax.sysid.arguments import check_how, recordings_of, setup_of
from rbjax.sysid.data.recording import Recording, says_its_noise
from rbjax.sysid.estimators.fit_file import read_fit
from rbjax.sysid.estimators.fit_rows import columns_of
from rbjax.sysid.estimators.fits import Fits, Fitted
from rbjax.sysid.estimators.identified import Identified, Options
from rbjax.sysid.estimators.step_length import start_grid
from rbjax.sysid.estimators.verdict import judged
from rbjax.sysid.parameters.unknowns import Parametrisation, Unknowns
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.statistics.fit_statistics import fit_statistics
from rbjax.sysid.statistics.precision import cast, in_double
from rbjax.sysid.statistics.rank import beside_others, combinations


@in_double
def identify(
    model: Model | Setup,
    recordings: Recording | Sequence[Recording],
    unknowns: Mapping[str, Parametrisation],
    *,
    grid: Grid | None = None,
    pieces: float | None = None,
    shooting: float | None = None,
    starts: bool | None = None,
    loss: str = "squares",
    steps: int = 100,
    restarts: int = 4,
    save: str | Path | None = None,
    resume: str | Path | Mapping[str, float] | None = None,
    progress: bool = False,
) -> Identified:
    """Numbers of a model, its sensors and its controller from one or more recordings.

    Args:
        model: the robot with first guesses; or a `Setup`, where sensors, a controller or a delay
            are part of what is simulated.
        recordings: with channels "q", perhaps "v", "ctrl" and those of the set-up's other sensors
            (`Setup.with_sensors`), each on its own clock; each recording is simulated from its
            first sample of "q" and "v", whose other samples may be missing.
        unknowns: name -> `Unknown`, `Inertia`, `Shared`, `FixedTotal`, `Tilt`, `Derived`.
        grid: how motion is integrated. None: steps of RK4 at the finest clock of all channels,
            and shorter ones if steps of half the length change the numbers (`notes` says so); a
            delay may last up to its upper bound, else up to three times its first guess.
            `Grid(period, substeps=0)`: steps are checked in the same way.
        pieces: length in s of pieces that are fitted first, each from its first sample, so that a
            poor first guess does not lose the motion. None: no such fit.
        shooting: length in s of pieces that are fitted first and then tied, end to start, ever more
            stiffly, until they are one motion (`Shooting`): for a long or chaotic motion, which
            `pieces` may not find. Forces and controllers that depend on time see that of a piece.
            None: no such fit.
        starts: whether each recording's initial state is estimated too. None: unless the recording
            says that it is known (`Recording(initial_state=...)`). False: the first readings of q
            and v are the state, exactly; their noise becomes an error of the numbers that no
            interval shows.
        loss: "squares", or "huber", by which outliers count less; then the verdict leaves up to a
            fifth of the samples out as outliers, beyond 4 robust standard deviations.
        steps: evaluations of the residual at most, of each fit.
        restarts: starts that are tried at most if the fit from the first guess is poor (R2 below
            0.99, or errors several times the noise): one that grows from the first part of the
            recordings, and others from other guesses. `notes` says so. 0: none; nor with pieces,
            shooting or resume.
        save: a file that holds the best numbers so far, and at the end the result.
        resume: such a file, or name -> value, from which the fit goes on.
        progress: whether a line shows the progress.

    Returns:
        `Identified`. All is computed in float64, whatever JAX's default is; the set-up has the
        dtype of the model. `success` and `message`: whether the fit converged. `verdict`: whether
        it is good. If a channel does not state its noise, it is estimated from the residuals, a
        number for each column. Intervals follow the residuals: if these are correlated in time, the
        covariance is the sandwich form (`fit_statistics`).

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
    setup, runs = setup_of("identify", model), recordings_of("identify", recordings)
    integer("identify", "steps", steps, least=1)
    integer("identify", "restarts", restarts, least=0)
    check_how("identify", loss, starts, pieces=pieces, shooting=shooting)
    if not (save is None or isinstance(save, (str, Path))):
        raise InputError(f"identify: save is {type(save).__name__}, expected the path of a file")
    dtype, setup = setup.model.gravity.dtype, cast(setup, np.float64)
    sought = Unknowns.of("identify", unknowns, setup)
    how = Options(grid, pieces, shooting, starts, loss, steps, restarts)
    x = None if resume is None else read_fit(resume, sought.names)
    with progress_line("identify", progress) as say:
        identified = fitted(setup, sought, runs, how, x=x, save=save, say=say, dtype=dtype)
    if save is not None:
        identified.save(save)
    return identified


def fitted(
    setup: Setup, sought: Unknowns, runs: Sequence[Recording], how: Options, *,
    x: np.ndarray | None = None, save: str | Path | None = None, say: Say = lambda text: None,
    dtype: Any = np.float64,
) -> Identified:  # fmt: skip
    """All of `identify` without its checks, from the first guess or from x, in float64."""
    grid, chosen = start_grid(setup, sought, runs, how.grid)
    fits = Fits(
        setup, sought, runs, grid, starts=how.starts, loss=how.loss, steps=how.steps, save=save,
        say=say,
    )  # fmt: skip
    given = x is not None or how.pieces is not None or how.shooting is not None
    if chosen:
        fits.stepped()
    if x is None:
        x = fits.first
        if how.pieces is not None:
            x = fits.pieces(x, how.pieces)
        if how.shooting is not None:
            x = fits.shooting(x, how.shooting)
    best = fits.whole(x)
    if not given:
        best = fits.improved(best, how.restarts)
    best = fits.weighed(best)
    if chosen:
        best = fits.finer(best)
    return _said(fits, best, how, dtype)


def _said(fits: Fits, best: Fitted, how: Options, dtype: Any) -> Identified:
    """The result of the last fit: estimates, combinations, covariance, verdict."""
    of, least, n, names = best.error, best.least, fits.shared, fits.sought.names
    stated = {s for s in of.runs.values if says_its_noise(fits.recordings, s)}
    said = fit_statistics(
        [*names, *(f"start[{k}]" for k in range(of.size - n))], least.x,
        columns_of(of, least.x, stated), bounds=fits.sought.limits(fits.setup),
    )  # fmt: skip
    p = least.x[:n]
    values, guess = (dict(zip(names, map(float, x), strict=True)) for x in (p, fits.first))
    return Identified(
        setup=cast(fits.sought.write(fits.setup, jnp.asarray(p)), dtype),
        values=values, guess=guess,
        identifiable=combinations(beside_others(least.triangle, n), names),
        estimates=said.estimates, recordings=tuple(fits.recordings), traces=best.traces,
        evaluations=fits.evaluations, success=least.success, message=least.message, grid=of.grid,
        error=of, noisy=best.estimated or len(stated) == len(of.runs.values), statistics=said,
        verdict=judged(
            least.success, least.message, best.traces, fits.recordings, said.coloured,
            robust=how.loss == "huber",
        ),
        notes=tuple(fits.notes), options=how,
    )  # fmt: skip
