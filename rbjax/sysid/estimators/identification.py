"""`identify`: parameters of a set-up from recordings, by the error of simulated motions.

    min over p of  sum |weights (reading(motion(p)) - recorded)|^2
The identifiable combinations of the unknowns are estimated. The other directions remain at the
first guess, or as close to it as the bounds allow. Initial states are estimated too, unless they
are known. `identifiability` finds the identifiable combinations before a fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance, integer, real_number
from rbjax.contact.impact_bias import RAMP, jumps_at_touch
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.motion.field import dynamics_of, free_motion
from rbjax.progress import Say, progress_line
from rbjax.sysid.arguments import check_options, recordings_of, setup_of
from rbjax.sysid.data.recording import Recording, noise_is_stated
from rbjax.sysid.estimators.identified import FitOptions, Identified, read_fit
from rbjax.sysid.estimators.staged_fit import Fit, StagedFit, start_grid
from rbjax.sysid.estimators.verdict import judge
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.parameters.unknowns import Parametrisation
from rbjax.sysid.simulation.runs import make_batch
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError
from rbjax.sysid.statistics.fit_statistics import fit_statistics
from rbjax.sysid.statistics.precision import cast, in_double
from rbjax.sysid.statistics.rank import Combinations, combinations, project_out_others


@in_double
def identify(
    model: Model | Setup,
    recordings: Recording | Sequence[Recording],
    unknowns: Mapping[str, Parametrisation],
    *,
    grid: Grid | None = None,
    segments: float | None = None,
    multiple_shooting: float | None = None,
    estimate_initial_state: bool | None = None,
    loss: str = "squares",
    max_evaluations: int = 100,
    restarts: int = 4,
    difference_step: float | None = None,
    save: str | Path | None = None,
    resume: str | Path | Mapping[str, float] | None = None,
    progress: bool = False,
) -> Identified:
    """Estimate parameters of a model, its sensors and its controller from recordings.

    Use it for measured positions, velocities or other sensors. If torques and accelerations are
    measured, `rb.sysid.torque` needs no simulation. All computations are in float64.

    Args:
        model: robot with first guesses; or a `Setup`, with sensors, a controller or a delay.
        recordings: recordings with a channel "q", optional "v" and "ctrl", and the other sensors of
            the set-up (`Setup.with_sensors`), each with its own clock. Each simulation starts from
            the first samples of "q" and "v". Other samples may be missing.
        unknowns: name -> `Unknown`, `Inertia`, `Shared`, `FixedTotal`, `Tilt`, `Derived`.
        grid: steps of the integration. None: RK4 steps at the finest clock of all channels, or
            shorter steps if half the length changes the estimates (see `notes`). An unknown delay
            may grow to its upper bound, or to three times its first guess. `Grid(period,
            substeps=0)`: other steps with the same check.
        segments: for a poor first guess, length in s of segments for a first fit, each simulated
            from its first sample. None: no such fit.
        multiple_shooting: for a long or chaotic motion, length in s of segments for a first fit,
            with continuity weights that grow until the segments are one motion. Time restarts in
            each segment, for forces and controllers that depend on it. None: no such fit.
        estimate_initial_state: whether to estimate the initial state of each recording. None: yes,
            except for known ones. False: the first readings of q and v are the initial state, and
            the intervals ignore their noise.
        loss: "squares", or "huber", which reduces the weight of outliers. The verdict of "huber"
            ignores outliers (above 4 robust standard deviations), up to a fifth of the samples.
        max_evaluations: largest number of evaluations of the residual, for each fit.
        restarts: largest number of other starts if the fit from the first guess is poor (R2 below
            0.99, or errors several times the noise). The first one grows from the first part of the
            recordings, the next ones start from other guesses. Unused with segments,
            multiple_shooting or resume.
        difference_step: for motions with impacts, whose derivatives are wrong or without bound: the
            size h of central differences in place of derivatives, relative to a positive unknown
            (0.03), to the distance of a bounded one from its bound, or to the scale of a free one.
            The estimate is a minimum to a tenth of h. The initial states must be known, or not be
            estimated. None: derivatives.
        save: path of a file for the best estimates during the fit, and for the final result.
        resume: path of such a file, or name -> value, from which the fit continues.
        progress: show a progress line.

    Returns:
        `Identified`, with the model in its original dtype. `success` and `status` describe the
        convergence, `verdict` the quality of the fit. Noise that a channel does not state is
        estimated from the residuals, for each column. If residuals are correlated in time, the
        covariance is a sandwich estimate.

    Raises:
        InputError: recordings that do not match the model, no unknowns, or an unknown outside of
            its range or without an effect on the recordings.
        UnknownName: an unknown leaf or body.

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
    integer("identify", "max_evaluations", max_evaluations, least=1)
    integer("identify", "restarts", restarts, least=0)
    check_options(
        "identify", loss, estimate_initial_state, segments=segments,
        multiple_shooting=multiple_shooting,
    )  # fmt: skip
    instance("identify", "save", save, str | Path | None, "the path of a file")
    if difference_step is not None:
        real_number("identify", "difference_step", difference_step, above=0.0, most=0.5)
        if multiple_shooting is not None:
            raise InputError(
                "identify: difference_step with multiple_shooting, which estimates initial states "
                "by derivatives; expected one of them. segments= works with difference_step"
            )
    dtype, setup = setup.model.gravity.dtype, cast(setup, np.float64)
    sought = Unknowns.of("identify", unknowns, setup)
    options = FitOptions(
        grid, segments, multiple_shooting, estimate_initial_state, loss, max_evaluations, restarts,
        difference_step,
    )  # fmt: skip
    x = None if resume is None else read_fit(resume, sought.names)
    with progress_line("identify", progress) as say:
        identified = fit_in_stages(
            setup, sought, runs, options, x=x, save=save, say=say, dtype=dtype
        )
    if save is not None:
        identified.save(save)
    return identified


def fit_in_stages(
    setup: Setup, unknowns: Unknowns, runs: Sequence[Recording], options: FitOptions, *,
    x: np.ndarray | None = None, save: str | Path | None = None, say: Say = lambda text: None,
    dtype: Any = np.float64,
) -> Identified:  # fmt: skip
    """Run `identify` without its checks, from the first guess or from x, in float64."""
    stages = StagedFit(setup, unknowns, runs, options, save=save, say=say)
    prepared = x is not None or options.segments is not None
    prepared = prepared or options.multiple_shooting is not None
    stages.shorten_steps()
    if x is None:
        x = stages.first
        if options.segments is not None:
            x = stages.fit_segments(x, options.segments)
        if options.multiple_shooting is not None:
            x = stages.fit_multiple_shooting(x, options.multiple_shooting)
    best = stages.fit_all(x)
    if not prepared:
        best = stages.retry_if_poor(best)
    return _result(stages, stages.refine_steps(stages.reweigh(best)), dtype)


def _result(stages: StagedFit, best: Fit, dtype: Any) -> Identified:
    """Create the result from the last fit: estimates, combinations, covariance and verdict."""
    of, minimum, n, names = best.error, best.minimum, stages.shared, stages.unknowns.names
    runs, p = stages.recordings, best.minimum.x[: stages.shared]
    stated = {s for s in of.runs.values if noise_is_stated(runs, s)}
    statistics = fit_statistics(
        [*names, *(f"start[{k}]" for k in range(of.size - n))], minimum.x,
        of.columns(minimum.x, stated), bounds=stages.unknowns.limits(stages.setup),
        factor=minimum.triangle[:, :-1],
    )  # fmt: skip
    values, guess = (dict(zip(names, map(float, x), strict=True)) for x in (p, stages.first))
    return Identified(
        setup=cast(stages.unknowns.write(stages.setup, jnp.asarray(p)), dtype),
        values=values, guess=guess,
        identifiable=combinations(project_out_others(minimum.triangle, n), names),
        estimates=statistics.estimates, recordings=tuple(runs), traces=best.traces,
        evaluations=stages.evaluations, status=minimum.status, grid=of.grid, error=of,
        noise_known=best.noise_estimated or len(stated) == len(of.runs.values),
        statistics=statistics,
        verdict=judge(
            minimum.status, best.traces, runs, statistics.coloured,
            robust=stages.options.loss == "huber",
        ),
        notes=(*stages.notes, *_notes_on_impacts(stages)), options=stages.options,
    )  # fmt: skip


def _notes_on_impacts(stages: StagedFit) -> list[str]:
    """Note that the derivatives of impacts are biased, if they are taken."""
    model = stages.setup.model
    law = dynamics_of("identify", model, free_motion, None)
    if stages.options.difference_step is not None or not jumps_at_touch(model, law):
        return []
    return [
        "the force of the contacts jumps at touch: if contacts begin within the recordings, the "
        "derivatives are biased and the fit may end early; take difference_step=0.03, or geoms "
        f"with solimp={RAMP!r}"
    ]


@in_double
def identifiability(
    model: Model | Setup,
    recordings: Recording | Sequence[Recording],
    unknowns: Mapping[str, Parametrisation],
    *,
    grid: Grid | None = None,
    estimate_initial_state: bool | None = None,
) -> Combinations:
    """Find the unknowns and the combinations of unknowns that recordings identify.

    Use it before `identify`. The result of `identify` contains the combinations at the estimates.

    Args:
        model: robot with first guesses, or a `Setup`.
        recordings: recordings, as in `identify`.
        unknowns: name -> unknown, as in `identify`.
        grid: steps of the integration, as in `identify`.
        estimate_initial_state: whether initial states are unknown, as in `identify`.

    Returns:
        `Combinations` by the singular values of the Jacobian of the simulation error at the first
        guess, without the part that initial states can compensate. See its `summary()`.

    Raises:
        InputError: recordings that do not match the model, or no unknowns.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> from rbjax.sysid import Channel, Inertia, Recording, identifiability
        >>> model, t = rb.load("pendulum"), np.arange(101) * 0.01
        >>> run = Recording("swing", {"q": Channel(t, 0.5 * np.cos(3 * t))})
        >>> identifiability(model, run, {"rod": Inertia("rod")}).rank  # of ten parameters
        3
    """
    where = "identifiability"
    setup, runs = setup_of(where, model), recordings_of(where, recordings)
    check_options(where, estimate_initial_state=estimate_initial_state)
    setup = cast(setup, np.float64)
    sought = Unknowns.of(where, unknowns, setup)
    grid, _ = start_grid(setup, sought, runs, grid)
    error = SimulationError(
        setup,
        sought,
        make_batch(setup, runs, grid),
        grid,
        estimate_initial_state=estimate_initial_state,
    )
    guess = np.asarray(sought.read(setup), float)
    R = error.triangle(np.append(guess, np.zeros(error.size - guess.size)))
    return combinations(project_out_others(R, guess.size), sought.names)
