"""`many_starts`: `identify` from many first guesses, for errors with many minima.

A few damped Gauss-Newton steps improve all guesses, with motions and Jacobians in one batch. The
best ones continue until they converge. Guesses that end at the same motion form a basin.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from rbjax.arguments import integer, real_array, real_number
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.progress import progress_line
from rbjax.status import Status
from rbjax.sysid.arguments import check_options, recordings_of, setup_of
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.estimators.identification import identify
from rbjax.sysid.estimators.identified import FitOptions, Identified
from rbjax.sysid.estimators.least_squares import Minimum, Request, search
from rbjax.sysid.estimators.staged_fit import StagedFit
from rbjax.sysid.parameters.unknown_vector import Unknowns, draw_guesses
from rbjax.sysid.parameters.unknowns import Parametrisation
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import Programs, SimulationError, sum_of_squares
from rbjax.sysid.statistics.precision import cast, in_double

#: prior weights of the first steps of all guesses, and of the later steps of the best guesses
SHORT, LONG = (1e-4,), (1e-4, 1e-7)
#: motions are equal if they differ by less than this share of the spread of the recordings
ONE_MOTION = 1e-2
#: largest size of the Jacobians of a batch in bytes; more guesses are divided into batches
MEMORY = 2**28


@displayed
@dataclass(frozen=True, eq=False)
class Basin:
    """A minimum that several guesses reach.

    Fields:
        values: name -> value at the minimum.
        cost: |r|^2 at the minimum.
        guesses: indices of the guesses, the best first.
    """

    values: dict[str, float]
    cost: float
    guesses: tuple[int, ...]


@displayed
@dataclass(frozen=True, eq=False)
class ManyStarts:
    """The result of `many_starts`.

    Fields:
        best: fit from the best minimum.
        basins: basins of the finalists, the best first.
        best_guess: index of the guess that led to the best minimum.
        guesses: (K, n) first guesses.
        costs: (K,) |r|^2 after the first few steps, inf if a motion is not finite.
    """

    best: Identified
    basins: tuple[Basin, ...]
    best_guess: int
    guesses: np.ndarray
    costs: np.ndarray

    def summary(self) -> str:
        """Return the number of basins, and of guesses that reach them, as one sentence."""
        first = self.basins[0]
        finalists = sum(len(b.guesses) for b in self.basins)
        text = (
            f"of {len(self.guesses)} guesses the best {finalists} end in {len(self.basins)} "
            f"basins; {len(first.guesses)} in the best one, guess {self.best_guess} first"
        )
        if len(self.basins) == 1:
            return text
        return f"{text}; the next one has {self.basins[1].cost / first.cost:.3g} times its squares"

    @property
    def status(self) -> Status:
        """The status of the best fit."""
        return self.best.status

    @property
    def success(self) -> bool:
        """Whether the best fit converged."""
        return self.best.success


@in_double
def many_starts(
    model: Model | Setup,
    recordings: Recording | Sequence[Recording],
    unknowns: Mapping[str, Parametrisation],
    *,
    guesses: int | Any = 32,
    spread: float = 1.0,
    seed: int = 0,
    finalists: int = 4,
    grid: Grid | None = None,
    estimate_initial_state: bool | None = None,
    loss: str = "squares",
    progress: bool = False,
    **more: Any,
) -> ManyStarts:
    """Fit from many first guesses, for motions whose error has many minima.

    Args:
        model: robot with first guesses, or a `Setup`.
        recordings: recordings, as in `identify`.
        unknowns: name -> unknown, as in `identify`.
        guesses: number of guesses, including the model; or an array (K, n) in the order of
            the unknowns.
        spread: size of the changes. Positive parameters change by factors up to e^spread, free ones
            up to spread times their scale, and log-Cholesky coordinates of inertias up to spread /
            2. Parameters with two bounds are anywhere between them.
        seed: seed of the random guesses.
        finalists: number of guesses that continue, the best after eight evaluations of each.
        grid, estimate_initial_state, loss, progress: options of `identify`.
        more: other arguments of `identify`, for the fit from the best minimum.

    Returns:
        `ManyStarts`. Unidentifiable directions remain near the model, as in `identify`.

    Raises:
        InputError: invalid arguments of `identify`, guesses of a wrong shape or outside of their
            range, an unknown of a kind that cannot be drawn, or no guess with a finite motion.

    Source: Rinnooy Kan & Timmer, *Stochastic global optimization methods*, Math. Programming 39,
    1987 (multistart).

    Example:
        >>> import rbjax as rb, numpy as np
        >>> from rbjax.sysid import Channel, Recording, Unknown, many_starts
        >>> model, t = rb.load("pendulum"), np.arange(201) * 0.02
        >>> other = model.replace(joints=model.joints.replace(armature=np.array([0.8])))
        >>> start = rb.State(np.array([1.5]), np.array([0.0]))
        >>> seen = rb.rollout(other, start, np.zeros((200, 1)), 0.02, integrator="rk4")
        >>> swing = Recording("swing", {"q": Channel(t, seen.q), "v": Channel(t, seen.v)})
        >>> guess = model.replace(joints=model.joints.replace(armature=np.array([0.05])))
        >>> rotor = {"armature": Unknown("joints.armature", 0, positive=True)}
        >>> found = many_starts(guess, swing, rotor, guesses=8, spread=4.0)
        >>> round(found.best.values["armature"], 2)
        0.8
    """
    given, runs = setup_of("many_starts", model), recordings_of("many_starts", recordings)
    setup = cast(given, np.float64)
    sought = Unknowns.of("many_starts", unknowns, setup)
    check_options("many_starts", loss, estimate_initial_state)
    integer("many_starts", "finalists", finalists, least=1)
    integer("many_starts", "seed", seed, least=0)
    spread = real_number("many_starts", "spread", spread, "a number above 0", above=0.0)
    points = _guesses(guesses, sought, setup, spread, seed)
    options = FitOptions(grid=grid, estimate_initial_state=estimate_initial_state, loss=loss)
    stages = StagedFit(setup, sought, runs, options)
    stages.shorten_steps()
    of, grid = stages.error(runs), stages.grid
    starts = [np.append(p, np.zeros(of.size - len(p))) for p in points]
    with progress_line("many_starts", progress) as say:
        say(f"{len(points)} guesses")
        first = search_together(of, starts, prior_weights=SHORT, max_evaluations=8)
        costs = np.array([least.cost for least in first])
        if not np.isfinite(costs).any():
            raise InputError(
                f"many_starts: none of {len(points)} guesses has a motion that stays finite, "
                "expected nearer ones: make spread or the steps of grid smaller"
            )
        order = [int(k) for k in np.argsort(costs)[:finalists] if np.isfinite(costs[k])]
        say(f"the best {len(order)} go on")
        finalists_x = [first[k].x for k in order]
        ends = search_together(of, finalists_x, prior_weights=LONG, max_evaluations=100)
    basins = _basins(of, dict(zip(order, ends, strict=True)))
    best = identify(
        given, runs, unknowns, resume=basins[0].values, loss=loss, progress=progress,
        estimate_initial_state=estimate_initial_state,
        grid=grid._replace(substeps=0) if stages.checks_steps else grid, **more,
    )  # fmt: skip
    return ManyStarts(best, basins, basins[0].guesses[0], points, costs)


def search_together(of: SimulationError, starts: Sequence[np.ndarray], **how: Any) -> list[Minimum]:
    """Search from each start, and answer the requests of all searches as one batch."""
    searches = [search(of.divergence, x, **how) for x in starts]
    asked: list[Request | Minimum] = [next(one) for one in searches]
    residuals, slopes = _batched(of.programs)
    each = of.runs.commands.shape[0] * of.by_run(starts[0]).shape[-1]
    rows = sum(int(np.prod(w.shape[1:])) for w in of.runs.weights.values())
    width = int(np.clip(MEMORY // (8 * rows * each), 1, len(searches)))

    def answers(
        asked: dict[int, Request], f: Callable, read: Callable[[Any], Any]
    ) -> dict[int, Any]:
        which = list(asked)
        found: dict[int, Any] = {}
        for k in range(0, len(which), width):
            some = which[k : k + width]
            filled = some + some[-1:] * (width - len(some))  # constant shape, to compile once
            x = np.stack([of.by_run(asked[i].x) for i in filled])
            out = jax.tree.map(np.asarray, f(x, of.runs))
            found |= {i: read(jax.tree.map(lambda a, j=j: a[j], out)) for j, i in enumerate(some)}
        return found

    while True:
        waiting = {i: a for i, a in enumerate(asked) if isinstance(a, Request)}
        if not waiting:
            return [a for a in asked if isinstance(a, Minimum)]
        steep = {i: a for i, a in waiting.items() if a.slopes}
        flat = {i: a for i, a in waiting.items() if not a.slopes}
        found = answers(steep, slopes, lambda out: of.assemble(*out))
        found |= answers(flat, residuals, sum_of_squares)
        for i in waiting:
            asked[i] = searches[i].send(found[i])


@functools.lru_cache(maxsize=4)
def _batched(one: Programs) -> tuple[Callable, Callable]:
    """Compile residuals and slopes for several parameter vectors x (K, runs, n + l) of the same
    runs."""
    f, g = (jax.jit(jax.vmap(f, (0, None))) for f in (one.residuals, one.slopes))
    return f, g


def _guesses(given: Any, sought: Unknowns, setup: Setup, spread: float, seed: int) -> np.ndarray:
    n = sum(sought.sizes)
    if np.ndim(given) == 0:
        integer("many_starts", "guesses", given, least=1)
        return draw_guesses(sought, setup, int(given), spread, seed)
    points = real_array(
        "many_starts", "guesses", given, "a number, or an array (K, n)", finite=False
    )
    if points.ndim != 2 or points.shape[1] != n or not len(points):
        raise InputError(
            f"many_starts: guesses has shape {points.shape}, expected (K, {n}), or a number"
        )
    for k, p in enumerate(points):
        if not np.isfinite(sought.divergence(p, p).value):
            raise InputError(
                f"many_starts: guess {k} is {p.tolist()}, expected numbers within their range"
            )
    return points


def _basins(of: SimulationError, ends: dict[int, Minimum]) -> tuple[Basin, ...]:
    """Group the minima by motion, the best first."""
    size = 0.0
    for sensor, values in of.runs.values.items():
        spread = np.asarray(of.runs.weights[sensor] * (values - values.mean((0, 1))))
        size += sum_of_squares(spread)
    found: list[tuple[np.ndarray, list[int], Minimum]] = []
    for k, least in sorted(ends.items(), key=lambda item: item[1].cost):
        r = of.residuals(least.x).ravel()
        for motion, members, _ in found:
            if sum_of_squares(r - motion) <= ONE_MOTION**2 * size:
                members.append(k)
                break
        else:
            found.append((r, [k], least))
    names = of.unknowns.names
    return tuple(
        Basin(dict(zip(names, map(float, least.x), strict=False)), least.cost, tuple(members))
        for _, members, least in found
    )
