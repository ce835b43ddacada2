"""A model beside recordings: its motion from their first states, with nothing fitted but these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.sysid.arguments import check_how, floats, recordings_of, setup_of
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.estimators.least_squares import minimise
from rbjax.sysid.parameters.unknowns import Unknowns
from rbjax.sysid.simulation.runs import batch_of, grid_of
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError
from rbjax.sysid.simulation.traces import Traces, traces
from rbjax.sysid.statistics.precision import cast, in_double


@in_double
def free_run(
    model: Model | Setup,
    recordings: Sequence[Recording],
    *,
    grid: Grid | None = None,
    starts: bool | None = False,
    noise: Mapping[str, np.ndarray] | None = None,
) -> Traces:
    """Recordings beside what a model does from their first states.

    Args:
        model: the robot, or a `Setup`.
        recordings: with channels "q", perhaps "v" and "ctrl".
        grid: as in `identify`.
        starts: whether each first state is the one from which the simulation comes nearest to the
            whole recording (least squares), not the first readings, which are noisy. So two models
            can be compared by their errors on a motion, each from its own best start. None: it is,
            unless the recordings state that their initial states are known.
        noise: sensor -> standard deviation (n,), by which `starts` weighs it; what channels say, or
            1, if None.

    Returns:
        Recording -> sensor -> `Trace`, with `residual`.

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
    check_how("free_run", starts=starts)
    grid = grid_of(recordings, setup) if grid is None else grid
    data = batch_of(setup, recordings, grid)
    if noise is not None:
        weights = {s: (w > 0) / _noise_of(noise, s, w) for s, w in data.weights.items()}
        data = data._replace(weights=weights)
    of = SimulationError(setup, Unknowns({}, (), ()), data, grid, starts=starts)
    x = minimise(of, np.zeros(of.size)).x if of.own else np.zeros(0)
    return traces(setup, of, x, recordings)


def _noise_of(noise: Any, sensor: str, weights: Any) -> np.ndarray:
    """The standard deviations of a sensor that `noise` states."""
    if not isinstance(noise, Mapping) or sensor not in noise:
        raise InputError(
            f"free_run: noise has no sensor {sensor}, expected a dict with the standard deviations "
            "of each sensor that was recorded"
        )
    sigma = floats("free_run", f"noise[{sensor!r}]", noise[sensor], "standard deviations")
    if sigma.shape not in ((), weights.shape[-1:]) or not (sigma > 0).all():
        raise InputError(
            f"free_run: noise[{sensor!r}] is {sigma.tolist()}, expected one number above 0, or "
            f"{weights.shape[-1]}, one a column"
        )
    return sigma
