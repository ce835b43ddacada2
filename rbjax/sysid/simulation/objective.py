"""`squares`: the squared simulation error and its gradient, for optimisers without a Jacobian.

    c(x) = |r(x)|^2,     dc/dx = 2 J^T r
Forward mode simulates the motion and one tangent for each entry of x in one batch. Reverse mode
needs one simulation and one backward pass for any number of entries, such as the weights of a
neural network.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, real_number
from rbjax.display import displayed
from rbjax.dynamics.tracing.devices import memory_share
from rbjax.model import Model
from rbjax.sysid.arguments import check_options, recordings_of, setup_of
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.parameters.unknowns import Parametrisation
from rbjax.sysid.simulation.programs import get_cached
from rbjax.sysid.simulation.runs import Run, default_grid, make_batch
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError, make_programs

#: ratio of the times of a reverse and a forward derivative
#: (benchmarks/results/cpu-gradient-modes-*.json)
REVERSE_COSTS = 4.5
#: size of a SIMD vector of a CPU in bytes
VECTOR = 64
#: estimated number of samples that fill a GPU
GPU_THREADS = 16_384


@displayed
@dataclass(frozen=True, eq=False)
class Squares:
    """The objective c(x) = |r(x)|^2 of recordings.

    Fields:
        x: (n + runs l,) first guess: the unknowns in the order of `names`, then the corrections of
            each run's initial state, if these are estimated.
        names: (n,) names of the unknowns.
        mode: "forward" or "reverse".
    """

    x: np.ndarray
    names: tuple[str, ...]
    mode: str
    _of: SimulationError
    _value: Callable[[jax.Array, Run], jax.Array]
    _both: Callable[[jax.Array, Run], tuple[jax.Array, jax.Array]]

    def value(self, x: Any) -> jax.Array:
        """Compute the objective c(x)."""
        return self._value(self._of.by_run(jnp.asarray(x)), self._of.runs)

    def value_and_grad(self, x: Any) -> tuple[jax.Array, jax.Array]:
        """Compute c(x) and its gradient, in the shape of x."""
        n = self._of.shared
        c, g = self._both(self._of.by_run(jnp.asarray(x)), self._of.runs)
        return c, jnp.concatenate([g[:, :n].sum(0), g[:, n:].ravel()])


def squares(
    model: Model | Setup,
    recordings: Recording | Sequence[Recording],
    unknowns: Mapping[str, Parametrisation],
    *,
    grid: Grid | None = None,
    estimate_initial_state: bool | None = None,
    loss: str = "squares",
    mode: str | None = None,
    memory: float | None = None,
) -> Squares:
    """Create the objective of `identify`, the squared simulation error, with its gradient.

    Use it with another optimiser, or to fit many parameters such as the weights of a neural
    network.

    Args:
        model: robot with first guesses, or a `Setup`.
        recordings: recordings, as in `identify`.
        unknowns: name -> unknown, as in `identify`.
        grid, estimate_initial_state, loss: options of `identify`.
        mode: "forward" or "reverse". None: the faster one.
        memory: bytes for the states that reverse mode saves, for all runs. Less memory requires
            more recomputation, with at least 2 sqrt(N) saved states for a run of N periods. None:
            an eighth of the memory of the devices.

    Returns:
        `Squares`, in the dtype of the model. It ignores the bounds of unknowns; if an optimiser
        could violate them, change variables (such as p = exp(y)).

    Raises:
        InputError: invalid arguments of `identify`, or memory that is not positive.
        UnknownName: an unknown mode.

    Source: Griewank & Walther, *Evaluating Derivatives*, 2nd ed., ch. 3 and 12.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> from rbjax.sysid import Channel, Recording, Unknown, squares
        >>> model, t = rb.load("pendulum"), np.arange(51) * 0.01
        >>> swing = Recording("swing", {"q": Channel(t, 0.1 * np.cos(3 * t)[:, None])})
        >>> mass = {"mass": Unknown("bodies.mass", 0)}
        >>> error = squares(model, swing, mass, estimate_initial_state=False)
        >>> value, slope = error.value_and_grad(error.x)
        >>> slope.shape
        (1,)
    """
    setup, runs = setup_of("squares", model), recordings_of("squares", recordings)
    check_options("squares", loss, estimate_initial_state)
    if mode is not None:
        choice("mode of squares", mode, ("forward", "reverse"))
    if memory is not None:
        real_number("squares", "memory", memory, "a positive number of bytes", above=0.0)
    sought = Unknowns.of("squares", unknowns, setup)
    grid = default_grid(runs, setup) if grid is None else grid
    of = SimulationError(
        setup,
        sought,
        make_batch(setup, runs, grid),
        grid,
        estimate_initial_state=estimate_initial_state,
        loss=loss,
    )
    mode = mode or faster(of.shared + of.own, of.count, setup.model.gravity.dtype.itemsize)
    budget = memory_share() if memory is None else memory
    keep = _keep(setup, of.runs, grid, budget) if mode == "reverse" else None
    value, both = get_cached(_make_programs, setup, sought, grid, of.own, loss, keep)
    x = np.append(np.asarray(sought.read(setup)), np.zeros(of.size - of.shared))
    return Squares(x, sought.names, mode, of, value, both)


def faster(numbers: int, runs: int, itemsize: int) -> str:
    """Choose the faster mode for `numbers` unknowns of each of `runs` runs.

    >>> faster(2, 64, 8), faster(55, 64, 8), faster(2, 1, 8)
    ('forward', 'reverse', 'reverse')
    """
    on_cpu = jax.default_backend() == "cpu"
    if on_cpu and runs == 1:  # a single motion is not vectorised, but its tangents are
        return "forward" if numbers == 1 else "reverse"
    at_once = VECTOR // itemsize if on_cpu else GPU_THREADS
    forward, reverse = (math.ceil(samples / at_once) for samples in (numbers * runs, runs))
    return "forward" if forward <= REVERSE_COSTS * reverse else "reverse"


def _keep(setup: Setup, runs: Run, grid: Grid, memory: float) -> int:
    """Choose k such that reverse mode saves every k-th state within the memory."""
    count, periods = runs.commands.shape[:2]
    late = (grid.longest_delay + 2) * setup.model.nu if grid.longest_delay else 0
    numbers = sum(x.shape[-1] for x in jax.tree.leaves(runs.start)) + late
    each = count * numbers * setup.model.gravity.dtype.itemsize
    most = math.isqrt(periods)  # a larger k needs more memory for intermediate states
    return next((k for k in range(1, most) if periods / k * each <= memory), max(most, 1))


def _make_programs(
    setup: Setup, unknowns: Unknowns, grid: Grid, own: int, loss: str, keep: int | None
) -> tuple[Callable, Callable]:
    """Compile the objective c, and c with its gradient (runs, n + l) by the entries of x of each
    run."""
    one = get_cached(make_programs, setup, unknowns, grid, own, loss, keep)

    def cost(x: jax.Array, run: Run) -> jax.Array:
        return (one.compare(*one.simulate(x, run), run) ** 2).sum()

    def value(x: jax.Array, runs: Run) -> jax.Array:
        return jax.vmap(cost)(x, runs).sum()

    def forward(x: jax.Array, run: Run) -> tuple[jax.Array, jax.Array]:
        def along(e: jax.Array) -> tuple[jax.Array, jax.Array]:
            return jax.jvp(lambda x: cost(x, run), (x,), (e,))

        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(x.shape[-1], dtype=x.dtype))

    def both(x: jax.Array, runs: Run) -> tuple[jax.Array, jax.Array]:
        c, g = jax.vmap(forward if keep is None else jax.value_and_grad(cost))(x, runs)
        return c.sum(), g

    return jax.jit(value), jax.jit(both)
