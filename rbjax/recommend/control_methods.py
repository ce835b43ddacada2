"""`control_method`: choose a method of optimal control for a problem, by trial solutions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, instance, integer
from rbjax.control import Problem, methods, solve
from rbjax.control.optimal.first_guess import first_guess
from rbjax.control.status import CONVERGED
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.progress import progress_line
from rbjax.recommend.recommendation import Recommendation, fastest
from rbjax.status import Status

SAME = 1e-6  # relative tolerance within which costs are equal


class MethodTrial(NamedTuple):
    """A measured method."""

    name: str  # of the method
    status: str  # of the solution from zero controls
    objective: float  # the cost of the motion
    iterations: int  # of this solution
    cost: float  # the time of a compiled solution, milliseconds
    solved: float  # the fraction of first guesses from which the method converged
    failed: tuple[int, ...]  # the indices of the first guesses from which it did not converge

    @property
    def success(self) -> bool:
        return self.status == Status.CONVERGED.text


@displayed
@dataclass(frozen=True)
class MethodRecommendation(Recommendation):
    """A method of `rb.control.solve`.

    Fields, in addition to the fields of `Recommendation` (cost: milliseconds per solution):
        objective: the cost of the motion.
        guesses: (G, N, nu), the first guesses of the controls.
    """

    objective: float
    guesses: jax.Array


def control_method(
    problem: Problem,
    start: Any,
    *,
    candidates: Sequence[str] | None = None,
    guesses: int = 8,
    scale: float = 1.0,
    iterations: int = 200,
    seed: int = 0,
    progress: bool = True,
) -> MethodRecommendation:
    """Recommend a method for a problem, by solutions from zero controls and random first guesses.

    The recommendation is the fastest of the methods that converge to the least cost.

    Args:
        problem: `rb.control.Problem`.
        start: the initial state.
        candidates: names of `rb.control.methods()`; None for all that support the problem's
            constraints.
        guesses: the number of first guesses of the controls. The first is zero.
        scale: random guesses are uniform within the bounds, limited to -scale .. scale.
        iterations: the largest number of iterations of each solution.
        seed: of the random numbers.
        progress: whether to display the progress on the terminal.

    Returns:
        `MethodRecommendation`.

    Raises:
        InputError: not a problem, no candidate.
        UnknownName: no such method.

    Source: Betts, *Practical Methods for Optimal Control*, 2010, 1.15 (a gradient-based solution is
    a local optimum, which depends on the first guess).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> C = rb.control
        >>> cart = C.Equations(lambda t, x, u: jnp.stack([x[1], u[0]]), 2, 1)
        >>> problem = C.Problem(cart, 10, 0.1, running=[lambda t, x, u: x, C.Control()])
        >>> start, how = jnp.ones(2), dict(candidates=["ddp"], guesses=2, progress=False)
        >>> r = rb.recommend.control_method(problem, start, **how)
        >>> r.name, r.candidates[0].solved
        ('ddp', 1.0)
    """
    instance("recommend", "problem", problem, Problem, "an rb.control.Problem")
    integer("recommend", "guesses", guesses, least=1)
    known = methods()
    able = {k: m for k, m in known.items() if m.constraints or not problem.constraints}
    names = tuple(able) if candidates is None else tuple(candidates)
    for name in names:
        choice("method of rb.control", name, known)
        if name not in able:
            raise InputError(f"recommend: {name!r} holds no constraints; these do: {list(able)}")
    if not names:
        raise InputError(f"recommend: no candidate, expected some of {list(able)}")
    _, plain = first_guess(problem, start)
    low, high = (jnp.clip(x, -scale, scale) for x in (problem.low, problem.high))
    key = jax.random.key(seed)
    others = low + (high - low) * jax.random.uniform(key, (guesses - 1, *plain.shape), plain.dtype)
    every = jnp.concatenate([plain[None], others.astype(plain.dtype)])
    trials = []
    with progress_line("recommend", progress) as say:
        for name in names:
            say(f"{name}: {guesses} first guesses")
            trials.append(_trial(problem, start, name, every, iterations))
    best = _best(trials)
    why = _reason(best, trials, guesses)
    return MethodRecommendation(best.name, best.cost, tuple(trials), why, best.objective, every)


def _trial(
    problem: Problem, start: Any, name: str, guesses: jax.Array, iterations: int
) -> MethodTrial:
    def run(ctrls: jax.Array) -> Any:
        return solve(problem, start, method=name, ctrl=ctrls, iterations=iterations)

    one = run(guesses[0])
    ms = 1e3 * fastest(lambda: jax.block_until_ready(run(guesses[0]).cost))
    statuses = [one.status, *(run(g).status for g in guesses[1:])]
    failed = tuple(i for i, x in enumerate(statuses) if x != CONVERGED)
    status = Status(int(one.status)).text.split(":")[0]
    cost = float(one.cost) if np.isfinite(one.cost) else np.inf
    return MethodTrial(
        name, status, cost, int(one.iterations), ms, 1 - len(failed) / len(guesses), failed
    )


def _best(trials: Sequence[MethodTrial]) -> MethodTrial:
    """Choose the fastest method with the least cost. If none converges, choose the least cost."""
    done = [t for t in trials if t.success]
    if not done:
        return min(trials, key=lambda t: t.objective)
    least = min(t.objective for t in done)
    equal = [t for t in done if t.objective <= least + SAME * max(abs(least), 1.0)]
    return min(equal, key=lambda t: t.cost)


def _reason(best: MethodTrial, trials: Sequence[MethodTrial], guesses: int) -> str:
    said = f"{best.name!r}: {best.status}"
    if best.success:
        said += (
            f" in {best.iterations} iterations and {best.cost:.3g} ms to a cost of "
            f"{best.objective:.6g}; it converges from {guesses - len(best.failed)} of {guesses} "
            "first guesses"
        )
    else:
        said += (
            f" after {best.iterations} iterations at a cost of {best.objective:.6g}; none converges"
        )
    rest = [
        f"{t.name!r} {t.status} ({t.iterations} iterations, {t.cost:.3g} ms, cost "
        f"{t.objective:.6g}, {guesses - len(t.failed)} of {guesses})"
        for t in trials
        if t is not best
    ]
    return said + ("; " + ", ".join(rest) if rest else "") + "."
