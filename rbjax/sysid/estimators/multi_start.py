"""`many_starts`: a fit from many first guesses at once, for errors with many minima.

Guesses are moved side by side by a few damped Gauss-Newton steps, all their motions and slopes one
batch. The best go on until they converge. Those that end at one motion lie in one basin.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from rbjax.arguments import integer
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.progress import progress_line
from rbjax.sysid.arguments import check_how, floats, recordings_of, setup_of
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.estimators.fits import Fits
from rbjax.sysid.estimators.identification import identify
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.estimators.least_squares import Minimum, Request, search
from rbjax.sysid.estimators.step_length import start_grid
from rbjax.sysid.parameters.guesses import drawn
from rbjax.sysid.parameters.unknowns import Parametrisation, Unknowns
from rbjax.sysid.simulation.runs import batch_of
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import (
    Programs,
    SimulationError,
    sum_of_squares,
)
from rbjax.sysid.statistics.precision import cast, in_double

#: prior weights of a guess: of all for a few steps, and of the best until they converge
SHORT, LONG = (1e-4,), (1e-4, 1e-7)
#: motions that are as near as this share of what was recorded are one
ONE_MOTION = 1e-2
#: bytes of slopes of a batch; more guesses are several batches
MEMORY = 2**28


@dataclass(frozen=True, eq=False)
class Basin:
    """Where several guesses end: values by name, cost |r|^2, and starts, the guesses by number."""

    values: dict[str, float]
    cost: float
    starts: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class ManyStarts:
    """What came of many guesses.

    Fields: best, the fit that went on from the best; basins of those guesses that converged, the
    best first; won, the number of the guess; guesses (K, n); costs (K,) |r|^2 after the first few
    steps, inf where a motion was not finite.
    """

    best: Identified
    basins: tuple[Basin, ...]
    won: int
    guesses: np.ndarray
    costs: np.ndarray

    def summary(self) -> str:
        """A sentence."""
        first = self.basins[0]
        went = sum(len(b.starts) for b in self.basins)
        said = (
            f"of {len(self.guesses)} guesses the best {went} end in {len(self.basins)} basins; "
            f"{len(first.starts)} in the best one, guess {self.won} first"
        )
        if len(self.basins) == 1:
            return said
        return f"{said}; the next one has {self.basins[1].cost / first.cost:.3g} times its squares"


@in_double
def many_starts(
    model: Model | Setup,
    recordings: Recording | Sequence[Recording],
    unknowns: Mapping[str, Parametrisation],
    *,
    guesses: int | Any = 32,
    spread: float = 1.0,
    seed: int = 0,
    first_steps: int = 8,
    finalists: int = 4,
    grid: Grid | None = None,
    starts: bool | None = None,
    loss: str = "squares",
    progress: bool = False,
    **more: Any,
) -> ManyStarts:
    """`identify` from many first guesses: for motions whose error has many minima.

    Args:
        model, recordings, unknowns, grid, starts, loss, progress: as in `identify`.
        guesses: how many are drawn, the model's own among them; or an array (K, n) of them, in the
            order of the unknowns.
        spread: how far they are drawn: positive numbers by factors up to e^spread, free ones up to
            spread times their scale, bodies as far in the logarithm of their inertia; bounded ones
            anywhere in their bounds.
        seed: of the drawing.
        first_steps: evaluations of each guess before the best are chosen.
        finalists: how many go on.
        more: what else `identify` takes, for the fit of the best.

    Returns:
        `ManyStarts`. What the data leave open stays as near to the model as in `identify`.

    Raises:
        InputError: as `identify`; guesses of a wrong shape or that are not possible; an unknown of
            a kind that cannot be drawn; no guess whose motion is finite.

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
    check_how("many_starts", loss, starts)
    for name, count in (("first_steps", first_steps), ("finalists", finalists)):
        integer("many_starts", name, count, least=1)
    integer("many_starts", "seed", seed, least=0)
    spread_of = floats("many_starts", "spread", spread, "a number above 0")
    if spread_of.shape != () or not 0 < spread_of < np.inf:
        raise InputError(f"many_starts: spread is {spread!r}, expected a number above 0")
    points = _guesses(guesses, sought, setup, spread, seed)
    grid, chosen = start_grid(setup, sought, runs, grid)
    if chosen:
        fits = Fits(
            setup, sought, runs, grid, starts=starts, loss=loss, steps=100, save=None,
            say=lambda text: None,
        )  # fmt: skip
        fits.stepped()
        grid = fits.grid
    of = SimulationError(setup, sought, batch_of(setup, runs, grid), grid, starts=starts, loss=loss)
    beginnings = [np.append(p, np.zeros(of.size - len(p))) for p in points]
    with progress_line("many_starts", progress) as say:
        say(f"{len(points)} guesses")
        first = together(of, beginnings, prior_weights=SHORT, max_evaluations=first_steps)
        costs = np.array([least.cost for least in first])
        if not np.isfinite(costs).any():
            raise InputError(
                f"many_starts: none of {len(points)} guesses has a motion that stays finite, "
                "expected nearer ones: make spread or the steps of grid smaller"
            )
        order = [int(k) for k in np.argsort(costs)[:finalists] if np.isfinite(costs[k])]
        say(f"the best {len(order)} go on")
        ends = together(of, [first[k].x for k in order], prior_weights=LONG, max_evaluations=100)
    basins = _basins(of, dict(zip(order, ends, strict=True)))
    best = identify(
        given, runs, unknowns, resume=basins[0].values, starts=starts, loss=loss,
        grid=grid._replace(substeps=0) if chosen else grid, progress=progress, **more,
    )  # fmt: skip
    return ManyStarts(best, basins, basins[0].starts[0], points, costs)


def together(of: SimulationError, beginnings: Sequence[np.ndarray], **how: Any) -> list[Minimum]:
    """Search from each x; the requests of all searches are answered as one batch."""
    searches = [search(of.divergence, x, **how) for x in beginnings]
    asked: list[Request | Minimum] = [next(one) for one in searches]
    residuals, slopes = _batched(of.programs)
    each = of.runs.commands.shape[0] * of.by_run(beginnings[0]).shape[-1]
    rows = sum(int(np.prod(w.shape[1:])) for w in of.runs.weights.values())
    width = int(np.clip(MEMORY // (8 * rows * each), 1, len(searches)))

    def answers(
        asked: dict[int, Request], f: Callable, read: Callable[[Any], Any]
    ) -> dict[int, Any]:
        which = list(asked)
        found: dict[int, Any] = {}
        for k in range(0, len(which), width):
            some = which[k : k + width]
            filled = some + some[-1:] * (width - len(some))  # one shape: nothing compiles again
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
        found = answers(steep, slopes, lambda out: of.assembled(*out))
        found |= answers(flat, residuals, sum_of_squares)
        for i in waiting:
            asked[i] = searches[i].send(found[i])


@functools.lru_cache(maxsize=4)
def _batched(one: Programs) -> tuple[Callable, Callable]:
    """Residuals and slopes of several x (K, runs, n + l) of the same runs."""
    f, g = (jax.jit(jax.vmap(f, (0, None))) for f in (one.residuals, one.slopes))
    return f, g


def _guesses(given: Any, sought: Unknowns, setup: Setup, spread: float, seed: int) -> np.ndarray:
    n = sum(sought.sizes)
    if np.ndim(given) == 0:
        integer("many_starts", "guesses", given, least=1)
        return drawn(sought, setup, int(given), spread, seed)
    points = floats("many_starts", "guesses", given, "a number, or an array (K, n)")
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
    """Ends that have the same motion, the best first."""
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
