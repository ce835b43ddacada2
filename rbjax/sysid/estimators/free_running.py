"""`free_run`: the simulation of recordings by a model, with no fit except of initial states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.sysid.arguments import check_options, floats, recordings_of, setup_of
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.estimators.least_squares import minimise
from rbjax.sysid.parameters.unknowns import Unknowns
from rbjax.sysid.simulation.runs import default_grid, make_batch
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError
from rbjax.sysid.simulation.traces import Traces, make_traces
from rbjax.sysid.statistics.precision import cast, in_double


@in_double
def free_run(
    model: Model | Setup,
    recordings: Sequence[Recording],
    *,
    grid: Grid | None = None,
    estimate_initial_state: bool | None = False,
    noise: Mapping[str, np.ndarray] | None = None,
) -> Traces:
    """Simulate recordings with a model, to compare it with them or with another model.

    Args:
        model: the robot, or a `Setup`.
        recordings: with channels "q", perhaps "v" and "ctrl".
        grid: as in `identify`.
        estimate_initial_state: whether each motion starts from the initial state that fits the
            whole recording best (least squares), instead of the first readings, which are noisy.
            None: unless the recordings have an `initial_state`.
        noise: sensor -> standard deviation (n,), which weighs that fit; None for the stated noise,
            or 1.

    Returns:
        Recording -> sensor -> `Trace`, with `residual`.

    Raises:
        InputError: recordings that do not suit the model; noise without a recorded sensor.

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
    """Check the standard deviations of a sensor."""
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
