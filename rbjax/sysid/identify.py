"""`identify`: numbers of a set-up from recordings, by the error of simulated motions.

    min over p of  sum |weights (reading(motion(p)) - recorded)|^2
What the data show is fitted; what they leave open stays at the first guess, or as near to it as a
body's inertia allows, and the answer says in words which combinations were found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.progress import progress_line
from rbjax.solvers.arguments import check_whole
from rbjax.sysid.fit_file import read_fit
from rbjax.sysid.fits import Fits, Fitted, says_its_noise
from rbjax.sysid.identified import Identified
from rbjax.sysid.rank import combinations
from rbjax.sysid.recording import Recording
from rbjax.sysid.runs import grid_of
from rbjax.sysid.simulation import Grid, Setup
from rbjax.sysid.statistics import estimates
from rbjax.sysid.unknowns import Parametrisation, Unknowns


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
        recordings: with channels "q", perhaps "v", "ctrl" and those of the set-up's other sensors
            (`Setup.with_sensors`), each on its own clock; each recording is simulated from its
            first sample of "q" and "v", whose other samples may be missing.
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
    with progress_line("identify", progress) as say:
        fits = Fits(
            setup, sought, runs, grid, starts=starts, loss=loss, steps=steps, save=save, say=say
        )
        x = fits.first if resume is None else read_fit(resume, sought.names)
        if pieces is not None and resume is None:
            x = fits.pieces(x, pieces)
        if shooting is not None and resume is None:
            x = fits.shooting(x, shooting)
        identified = _said(fits, fits.weighed(fits.whole(x)))
    if save is not None:
        identified.save(save)
    return identified


def _said(fits: Fits, fitted: Fitted) -> Identified:
    """What the last fit says: numbers, what the data show of them, and their covariance."""
    of, least, n, names = fitted.error, fitted.least, fits.shared, fits.sought.names
    samples = sum(int((np.asarray(w) > 0).sum()) for w in of.runs.weights.values())
    dof = max(samples - of.size, 1)
    noise = 1.0 if fitted.estimated else np.sqrt(least.cost / dof)
    said = estimates(
        [*names, *(f"start[{k}]" for k in range(of.size - n))], least.x, least.triangle[:, :-1],
        max(noise, np.finfo(float).tiny), dof=dof, bounds=fits.sought.limits(fits.setup),
    )  # fmt: skip
    p = least.x[:n]
    values, guess = (dict(zip(names, map(float, x), strict=True)) for x in (p, fits.first))
    return Identified(
        setup=fits.sought.write(fits.setup, jnp.asarray(p, fits.setup.model.gravity.dtype)),
        values=values, guess=guess, found=combinations(least.triangle[:, :n], names),
        estimates=said, recordings=tuple(fits.recordings), traces=fitted.traces,
        evaluations=fits.evaluations, ok=least.ok, message=least.message, grid=fits.grid, error=of,
        noisy=fitted.estimated or all(says_its_noise(fits.recordings, s) for s in of.runs.values),
    )  # fmt: skip
