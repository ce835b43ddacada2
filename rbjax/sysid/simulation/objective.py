"""`squares`: the squared simulation error and its gradient, for optimisers that take no Jacobian.

    c(x) = |r(x)|^2,     dc/dx = 2 J^T r
Forward mode simulates a motion and its rate for each number of x, all side by side. Reverse mode
simulates once and goes back once, however many numbers there are. It wins where numbers outgrow
the lanes of the machine; so do a network's weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.tracing.devices import memory_share
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.sysid.arguments import check_how, recordings_of, setup_of
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.parameters.unknowns import Parametrisation, Unknowns
from rbjax.sysid.simulation.programs import kept
from rbjax.sysid.simulation.runs import Run, batch_of, grid_of
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError, programs

#: forward derivatives of a full vector that take as long as one reverse derivative of it
#: (benchmarks/results/cpu-gradient-modes-*.json)
REVERSE_COSTS = 4.5
#: bytes of a processor's vector
VECTOR = 64
#: samples side by side that fill a GPU: an estimate
GPU_THREADS = 16_384


@dataclass(frozen=True, eq=False)
class Squares:
    """c(x) = |r(x)|^2 of recordings.

    Fields: x (n + runs l,), the first guess: numbers of the unknowns in the order of names, then,
    where starts are sought, corrections of each run's; names; mode, "forward" or "reverse".
    """

    x: np.ndarray
    names: tuple[str, ...]
    mode: str
    _of: SimulationError
    _value: Callable[[jax.Array, Run], jax.Array]
    _both: Callable[[jax.Array, Run], tuple[jax.Array, jax.Array]]

    def value(self, x: Any) -> jax.Array:
        """c(x)"""
        return self._value(self._of.by_run(jnp.asarray(x)), self._of.runs)

    def value_and_grad(self, x: Any) -> tuple[jax.Array, jax.Array]:
        """c(x) and its gradient, of the shape of x."""
        n = self._of.shared
        c, g = self._both(self._of.by_run(jnp.asarray(x)), self._of.runs)
        return c, jnp.concatenate([g[:, :n].sum(0), g[:, n:].ravel()])


def squares(
    model: Model | Setup,
    recordings: Recording | Sequence[Recording],
    unknowns: Mapping[str, Parametrisation],
    *,
    grid: Grid | None = None,
    starts: bool | None = None,
    loss: str = "squares",
    mode: str | None = None,
    memory: float | None = None,
) -> Squares:
    """The squared error that `identify` makes small, and its gradient.

    Args:
        model, recordings, unknowns, grid, starts, loss: as in `identify`.
        mode: "forward" or "reverse"; the one that is faster for so many numbers and runs if None.
        memory: bytes in which reverse mode may keep states, for all runs; the fewer, the more steps
            run twice. None: an eighth of the memory of the devices. It keeps every k-th state of N
            a run and holds k more, so 2 sqrt(N) at least.

    Returns:
        `Squares`, in the dtype of the model: it uses no tolerances that would need the float64 of
        `identify`. The numbers are physical, without limits: change variables (such as p = exp(y))
        if an optimiser could leave their range.

    Raises:
        InputError: as `identify`; a mode of another name; memory that is not positive.

    Source: Griewank & Walther, *Evaluating Derivatives*, 2nd ed., ch. 3 and 12.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> from rbjax.sysid import Channel, Recording, Unknown, squares
        >>> model, t = rb.load("pendulum"), np.arange(51) * 0.01
        >>> swing = Recording("swing", {"q": Channel(t, 0.1 * np.cos(3 * t)[:, None])})
        >>> error = squares(model, swing, {"mass": Unknown("bodies.mass", 0)}, starts=False)
        >>> value, slope = error.value_and_grad(error.x)
        >>> slope.shape
        (1,)
    """
    setup, runs = setup_of("squares", model), recordings_of("squares", recordings)
    check_how("squares", loss, starts)
    if not (mode is None or mode in ("forward", "reverse")):
        raise InputError(f'squares: mode is {mode!r}, expected "forward", "reverse" or None')
    number = isinstance(memory, (int, float)) and not isinstance(memory, bool)
    if memory is not None and not (number and memory > 0):
        raise InputError(f"squares: memory is {memory!r}, expected a positive number of bytes")
    sought = Unknowns.of("squares", unknowns, setup)
    grid = grid_of(runs, setup) if grid is None else grid
    of = SimulationError(setup, sought, batch_of(setup, runs, grid), grid, starts=starts, loss=loss)
    mode = mode or faster(of.shared + of.own, of.count, setup.model.gravity.dtype.itemsize)
    budget = memory_share() if memory is None else memory
    keep = _keep(setup, of.runs, grid, budget) if mode == "reverse" else None
    value, both = kept(_programs, setup, sought, grid, of.own, loss, keep)
    x = np.append(np.asarray(sought.read(setup)), np.zeros(of.size - of.shared))
    return Squares(x, sought.names, mode, of, value, both)


def faster(numbers: int, runs: int, itemsize: int) -> str:
    """The mode that is faster for so many numbers of each run, by how many samples run at once.

    >>> faster(2, 64, 8), faster(55, 64, 8), faster(2, 1, 8)
    ('forward', 'reverse', 'reverse')
    """
    on_cpu = jax.default_backend() == "cpu"
    if on_cpu and runs == 1:  # one motion needs no vector, its rates do
        return "forward" if numbers == 1 else "reverse"
    at_once = VECTOR // itemsize if on_cpu else GPU_THREADS
    forward, reverse = (math.ceil(samples / at_once) for samples in (numbers * runs, runs))
    return "forward" if forward <= REVERSE_COSTS * reverse else "reverse"


def _keep(setup: Setup, runs: Run, grid: Grid, memory: float) -> int:
    """Each how many states reverse mode keeps one."""
    count, periods = runs.commands.shape[:2]
    late = (grid.longest_delay + 2) * setup.model.nu if grid.longest_delay else 0
    numbers = sum(x.shape[-1] for x in jax.tree.leaves(runs.start)) + late
    each = count * numbers * setup.model.gravity.dtype.itemsize
    most = math.isqrt(periods)  # more would hold more than it saves
    return next((k for k in range(1, most) if periods / k * each <= memory), max(most, 1))


def _programs(
    setup: Setup, unknowns: Unknowns, grid: Grid, own: int, loss: str, keep: int | None
) -> tuple[Callable, Callable]:
    """c of all runs, and c with its gradient by each run's numbers, of (runs, n + l)."""
    one = kept(programs, setup, unknowns, grid, own, loss, keep)

    def cost(x: jax.Array, run: Run) -> jax.Array:
        return (one.compared(*one.path(x, run), run) ** 2).sum()

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
