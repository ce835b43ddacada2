"""Nonlinear least squares over numbers that must stay possible, with a prior that may be weak.

    min |r(x)|^2 + w D(x, x_0)
D is convex and infinite where x is impossible (`divergence`). Each step solves a convex problem, r
made linear and D as it is, with a second divergence that holds the step short (a proximal
Gauss-Newton method). The prior decides only what the data leave open: its weight is lowered to
almost nothing, and at the end steps without it, in the directions that the data show, take its last
pull away.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.statistics.precision import rank_tolerance

#: weights of the prior, relative to the largest curvature of |r|^2, of successive minimisations
PULLS = (1e-4, 1e-7, 1e-10)
#: a step of this divergence ends a minimisation
SMALL = 1e-18
#: a damping up to which a step is as long as Gauss and Newton would have it
CALM = 1e-6
#: a decrease of this fraction ends one that is not the last
COARSE = 1e-2
#: an expected decrease of this fraction ends the last: less than noise can tell
FLAT = 1e-8
#: x is a minimum if the Gauss-Newton step is expected to lower the cost by less than this fraction:
#: then the residual is orthogonal to all columns of J to within 3e-4 rad
OPTIMAL = 1e-7
#: or that step has such a divergence: it changes no number by more than 5e-8 of its size. Of exact
#: data the residual is rounding, whose share that a step expects to take off says nothing
ROUNDING = 1e-15
#: slopes from here on are those of a motion that ran away
HUGE = 1e100
#: Newton's steps of one convex problem
NEWTON = 60


class Residual(Protocol):
    """What is minimised: r (any shape), R (p + 1, p + 1) with R^T R = [J r]^T [J r], and D."""

    def residuals(self, x: np.ndarray, /) -> np.ndarray: ...

    def triangle(self, x: np.ndarray, /) -> np.ndarray: ...

    def divergence(self, x: np.ndarray, x0: np.ndarray, /) -> Divergence: ...


@dataclass(frozen=True)
class Minimum:
    """The end of a minimisation.

    x: (p,).
    triangle: (p + 1, p + 1), R of [J r] at x.
    cost: |r|^2.
    evaluations: of the residual.
    ok: whether x is a minimum by the scaled gradient.
    message: "converged", "stalled: ...", "not converged ...", or why the first guess is invalid.
    """

    x: np.ndarray
    triangle: np.ndarray
    cost: float
    evaluations: int
    ok: bool
    message: str


def minimise(
    of: Residual,
    start: np.ndarray,
    prior: np.ndarray | None = None,
    *,
    triangle: np.ndarray | None = None,
    pulls: tuple[float, ...] = PULLS,
    steps: int = 100,
    watch: Callable[[int, float, np.ndarray], None] = lambda evaluation, cost, x: None,
) -> Minimum:
    """The minimum near a start.

    Args:
        of: the residual.
        start: (p,).
        prior: x_0; the start if None.
        triangle: that of the residual at the start, where it is known.
        pulls: weights w, one after the other.
        steps: evaluations of the residual in all.
        watch: called with the number of evaluations, |r|^2 and x, for progress.

    Source: Nielsen, *Damping parameter in Marquardt's method*, IMM-REP-1999-05 (the damping).
    """
    search = searching(
        of.divergence, start, prior, triangle=triangle, pulls=pulls, steps=steps, watch=watch
    )
    asked = next(search)
    while not isinstance(asked, Minimum):
        asked = search.send(answered(of, asked))
    return asked


class Asked(NamedTuple):
    """What a search has to know next: |r|^2 at x, or the triangle there."""

    x: np.ndarray
    slopes: bool


def answered(of: Residual, asked: Asked) -> Any:
    """|r|^2, inf where it is not finite, or the triangle."""
    return of.triangle(asked.x) if asked.slopes else sum_of_squares(of.residuals(asked.x))


def sum_of_squares(r: np.ndarray) -> float:
    """|r|^2, inf where it is not finite: a motion that went to infinity."""
    r = np.asarray(r).ravel()
    with np.errstate(over="ignore"):
        found = float(r @ r)
    return found if np.isfinite(found) else np.inf


def searching(
    D: Callable[[np.ndarray, np.ndarray], Divergence],
    start: np.ndarray,
    prior: np.ndarray | None = None,
    *,
    triangle: np.ndarray | None = None,
    pulls: tuple[float, ...] = PULLS,
    steps: int = 100,
    watch: Callable[[int, float, np.ndarray], None] = lambda evaluation, cost, x: None,
) -> Generator[Asked | Minimum, Any, None]:
    """`minimise` that asks for what it has to know, so that many can be answered at once. The last
    that it yields is the minimum."""
    x = np.array(start, float)
    prior = x if prior is None else np.asarray(prior, float)
    count = 0

    def cost(x: np.ndarray) -> Generator[Asked, Any, float]:
        nonlocal count
        count += 1
        found = yield Asked(x, False)
        watch(count, found, x)
        return found

    R = (yield Asked(x, True)) if triangle is None else triangle
    ended, half = False, half_of(D, x)
    if not _has_squares(R):
        message = "the motion of the first guess is not finite"
        yield Minimum(x, R, np.inf, count, False, message)
        return
    now = float(R[:, -1] @ R[:, -1])
    if half is None:
        message = "the first guess is at the border of what is possible"
        yield Minimum(x, R, now, count, False, message)
        return
    damping = CALM
    for w in pulls:  # a weaker pull goes on with the damping of the last
        last, damping, growth, ended = w == pulls[-1], min(damping, CALM), 2.0, False
        while not ended and count < steps:
            size = float(np.linalg.norm(np.linalg.solve(half, R[:, :-1].T), 2)) ** 2
            terms = ((w * size, prior), (damping * size, x))
            trial = convex_step(R, x, D, terms)
            near = D(trial, x).value <= SMALL
            linear = R[:, :-1] @ (trial - x) + R[:, -1]
            pull = w * size * (D(x, prior).value - D(trial, prior).value)
            expected = now - float(linear @ linear) + pull
            calm = damping <= CALM and expected < (FLAT if last else COARSE) * now
            if calm and not last:  # the next pull's first step does what this one would
                break
            after = yield from cost(trial)
            gain = (now - after + pull) / max(expected, 1e-300)
            # where slopes have no squares, or the metric no root, no step could begin: such a point
            # is refused
            root = half_of(D, trial) if gain > 0 else None
            there = np.array(np.nan) if root is None else (yield Asked(trial, True))
            if root is not None and _has_squares(there):
                x, now, R, half = trial, after, there, root
                damping, growth = damping * max(0.1, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3), 2.0
                ended = calm or (near and damping <= CALM)
            else:
                damping, growth = damping * growth, growth * 2
                ended = near or damping > 1e9
    for k in range(4):  # without the prior
        trial = x + shown(R, half)
        after = np.inf
        if np.isfinite(D(trial, x).value):
            after = yield from cost(trial)
        # the first takes the pull away; what later ones change by less is rounding, or hidden by
        # noise
        if k and after > now / 10:
            break
        root = half_of(D, trial) if after < now else None
        there = np.array(np.nan) if root is None else (yield Asked(trial, True))
        if root is None or not _has_squares(there):
            break
        ends = after > now / 10
        x, now, R, half = trial, after, there, root
        if ends:
            break
    best = _is_minimum(D, x, R, pulls[-1], now)
    if best:
        message = "converged"
    elif ended:
        message = f"stalled: no step lowers the error, but its slope is not 0 ({count} evaluations)"
    else:
        message = f"not converged in {count} evaluations"
    yield Minimum(x, R, now, count, best, message)


def _is_minimum(D: Callable, x: np.ndarray, R: np.ndarray, w: float, now: float) -> bool:
    """Whether the step of Gauss and Newton, within what is possible, expects no decrease that
    noise could tell, or is no longer than rounding: a gradient that is 0 on the scale of the
    columns and the residual. A prior has no part in it."""
    half = half_of(D, x)
    if half is None:
        return False
    if not R[:, -1].any():
        return True

    def ends(y: np.ndarray) -> bool:
        linear = R[:, :-1] @ (y - x) + R[:, -1]
        expected = now - float(linear @ linear)
        return bool(expected <= OPTIMAL * now or D(y, x).value <= ROUNDING)

    # without limits a step is at least as long and expects at least as large a decrease
    if ends(x + shown(R, half)):
        return True
    size = float(np.linalg.norm(np.linalg.solve(half, R[:, :-1].T), 2)) ** 2
    return ends(convex_step(R, x, D, ((w * size, x),)))


def _has_squares(R: np.ndarray) -> bool:
    """Whether slopes are finite, and their squares too, whatever their scale."""
    return bool((np.abs(R) < HUGE).all())


def half_of(D: Callable[[np.ndarray, np.ndarray], Divergence], x: np.ndarray) -> np.ndarray | None:
    """The Cholesky factor of the metric at x; None if rounding leaves none, as for a thin body."""
    curvature = D(x, x).curvature
    if not np.isfinite(curvature).all():
        return None
    try:
        return np.linalg.cholesky(curvature)
    except np.linalg.LinAlgError:
        return None


@np.errstate(over="ignore", invalid="ignore")  # of trial steps, which the line search rejects
def convex_step(
    R: np.ndarray,
    x: np.ndarray,
    D: Callable[[np.ndarray, np.ndarray], Divergence],
    terms: tuple[tuple[float, np.ndarray], ...],
) -> np.ndarray:
    """argmin over y of |J (y - x) + r|^2 + sum of w D(y, x0), by Newton's method from x."""
    J, r = R[:, :-1], R[:, -1]

    def at(y: np.ndarray) -> tuple[float, list[Divergence]]:
        off, apart = J @ (y - x) + r, [D(y, x0) for _, x0 in terms]
        pulled = sum(w * d.value for (w, _), d in zip(terms, apart, strict=True))
        return float(off @ off) + pulled, apart

    y, (now, apart) = x, at(x)
    squared, weight = 2 * J.T @ J, sum(w for w, _ in terms)
    for _ in range(NEWTON):
        g = 2 * J.T @ (J @ (y - x) + r)
        for (w, _), d in zip(terms, apart, strict=True):
            g = g + w * d.slope
        # D's curvature at y is the same from all x0
        step = -np.linalg.solve(squared + weight * apart[0].curvature, g)
        decrease = -float(g @ step)
        if decrease <= 1e-13 * now:
            break
        part = 1.0
        while part > 1e-10:
            after, apart = at(y + part * step)
            if after <= now - 1e-4 * part * decrease:
                break
            part /= 2
        else:
            break
        y, now = y + part * step, after
    return y


def shown(R: np.ndarray, L: np.ndarray) -> np.ndarray:
    """The shortest Gauss-Newton step in the directions that the data show; L L^T is the metric."""
    tolerance = rank_tolerance(R.dtype)
    A = np.linalg.solve(L, R[:, :-1].T).T
    moves = A.any(0)  # rounding of the decomposition must not move what nothing depends on
    U, s, Vt = np.linalg.svd(A[:, moves], full_matrices=False)
    kept = s > tolerance * s.max(initial=0.0)
    z = np.zeros(A.shape[1])
    z[moves] = Vt[kept].T @ ((U.T @ R[:, -1])[kept] / s[kept])
    return -np.linalg.solve(L.T, z)
