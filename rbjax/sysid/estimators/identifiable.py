"""Identifiability before a fit: the rank of the Jacobian at the first guess."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rbjax.model import Model
from rbjax.sysid.arguments import check_how, recordings_of, setup_of
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.estimators.step_length import start_grid
from rbjax.sysid.parameters.unknowns import Parametrisation, Unknowns
from rbjax.sysid.simulation.runs import batch_of
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError
from rbjax.sysid.statistics.precision import cast, in_double
from rbjax.sysid.statistics.rank import Combinations, beside_others, combinations


@in_double
def identifiability(
    model: Model | Setup,
    recordings: Recording | Sequence[Recording],
    unknowns: Mapping[str, Parametrisation],
    *,
    grid: Grid | None = None,
    starts: bool | None = None,
) -> Combinations:
    """Find which unknowns, and which combinations of them, recordings can identify. Use it before
    `identify`, which gives the same for its result.

    Args:
        model, recordings, unknowns, grid, starts: as in `identify`.

    Returns:
        `Combinations` by the singular values of the Jacobian of the simulation error at the first
        guess, without the part that the initial states explain too. Its `summary()` says it in
        sentences.

    Raises:
        InputError: as `identify`.

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
    check_how(where, starts=starts)
    setup = cast(setup, np.float64)
    sought = Unknowns.of(where, unknowns, setup)
    grid, _ = start_grid(setup, sought, runs, grid)
    error = SimulationError(setup, sought, batch_of(setup, runs, grid), grid, starts=starts)
    guess = np.asarray(sought.read(setup), float)
    R = error.triangle(np.append(guess, np.zeros(error.size - guess.size)))
    return combinations(beside_others(R, guess.size), sought.names)
