"""A model beside recordings: its motion from their first states, with nothing fitted but these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from rbjax.model import Model
from rbjax.sysid.least_squares import minimise
from rbjax.sysid.precision import cast, in_double
from rbjax.sysid.recording import Recording
from rbjax.sysid.runs import batch_of, grid_of
from rbjax.sysid.simulation import Grid, Setup
from rbjax.sysid.simulation_error import SimulationError
from rbjax.sysid.traces import Traces, traces
from rbjax.sysid.unknowns import Unknowns


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
            can be compared by what they get wrong of a motion, each from its own best start. None:
            unless the recordings say that their initial states are known.
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
    setup = cast(model if isinstance(model, Setup) else Setup.of(model), np.float64)
    grid = grid_of(recordings, setup) if grid is None else grid
    data = batch_of(setup, recordings, grid)
    if noise is not None:
        weights = {s: (w > 0) / jnp.asarray(noise[s], w.dtype) for s, w in data.weights.items()}
        data = data._replace(weights=weights)
    of = SimulationError(setup, Unknowns({}, (), ()), data, grid, starts=starts)
    x = minimise(of, np.zeros(of.size)).x if of.own else np.zeros(0)
    return traces(setup, of, x, recordings)
