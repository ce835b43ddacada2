"""Nonlinear least squares with bounds and a weak prior, the minimiser of all estimators.

    min f(x) + w D(x, x_0),     f = |r(x)|^2, or -2 log p with the scores r
D is a convex divergence that is infinite outside of the bounds (`divergence`). It serves as
barrier, metric of the step length, and prior. Each step minimises the linearised residual plus D
and a second divergence from the current x (proximal Gauss-Newton). The Jacobian enters as the
triangular factor R of [J r]. The weight of the prior is reduced in stages. The last steps have no
prior, which removes its bias in the identifiable directions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from rbjax.rank_tolerances import rank_tolerance
from rbjax.status import HasStatus, Status
from rbjax.sysid.parameters.divergence import TRIAL, Divergence

#: weights of the prior in successive stages, relative to the largest curvature of |r|^2
PRIOR_WEIGHTS = (1e-4, 1e-7, 1e-10)
#: a step with a smaller divergence ends a stage
SMALL = 1e-18
#: damping of the first step, and largest damping at the end of a search
CALM = 1e-6
#: divergence of a step that changes every entry by less than 5e-8 of its size. It ends a search on
#: exact data: the residual is rounding, and its relative decrease is arbitrary
ROUNDING = 1e-15
#: larger derivatives belong to a diverged motion
HUGE = 1e100
#: largest number of Newton steps of one convex subproblem
NEWTON = 60


class Tolerances(NamedTuple):
    """Stopping rule of a search, by the expected decrease of the cost in the next step.

    Fields:
        flat: expected decrease that ends the last stage, below the resolution of noise.
        coarse: expected decrease that ends an earlier stage.
        optimal: x is a minimum if the expected decrease of the Gauss-Newton step is smaller.
        relative: whether these are fractions of the cost, which then is |r|^2.
        calm: largest damping at the end of a search.
        small: a step with a smaller divergence ends a stage.
        rounding: x is a minimum if the divergence of the Gauss-Newton step is smaller.
    """

    flat: float
    coarse: float
    optimal: float
    relative: bool
    calm: float = CALM
    small: float = SMALL
    rounding: float = ROUNDING


#: at a minimum the residual is orthogonal to all columns of J to within 3e-4 rad
OF_SQUARES = Tolerances(flat=1e-8, coarse=1e-2, optimal=1e-7, relative=True)


class Objective(Protocol):
    """Protocol of an objective of x (p,) with residuals r and their Jacobian J.

    cost: the value; inf if it is not finite.
    triangle: R (p + 1, p + 1) with R^T R = [J r]^T [J r]. J^T r is half of the cost's gradient.
    divergence: a `Divergence` of x from x0, which measures the length of a step.
    """

    def cost(self, x: np.ndarray, /) -> float: ...

    def triangle(self, x: np.ndarray, /) -> np.ndarray: ...

    def divergence(self, x: np.ndarray, x0: np.ndarray, /) -> Divergence: ...


@dataclass(frozen=True)
class Minimum(HasStatus):
    """The end of a minimisation at x (p,), with the factor R of [J r] and the cost at x.

    `CONVERGED` means that x is a minimum by the scaled gradient.
    """

    x: np.ndarray
    triangle: np.ndarray
    cost: float
    evaluations: int
    status: Status


def minimise(
    objective: Objective, start: np.ndarray, prior: np.ndarray | None = None, **options: Any
) -> Minimum:
    """Minimise an objective near a start, with the arguments of `search`."""
    steps = search(objective.divergence, start, prior, **options)
    request = next(steps)
    while not isinstance(request, Minimum):
        x = request.x
        request = steps.send(objective.triangle(x) if request.slopes else objective.cost(x))
    return request


def minimise_by_differences(
    objective: Objective, start: np.ndarray, prior: np.ndarray | None = None, *, step: float,
    max_evaluations: int = 100, **options: Any,
) -> Minimum:  # fmt: skip
    """Minimise an objective whose slopes are differences over a step h, in the metric of D.

    The cost is rough at lengths far below h, so a search ends where it expects a step shorter than
    h / 10, or a decrease of the cost below 1e-4 of it. Then the cost is compared with the costs at
    the distance h along each entry. The next search starts from the lowest one; if none is lower, x
    is a minimum at this length.

    Source: Kolda, Lewis & Torczon, *Optimization by direct search*, SIAM Review 45(3), 2003.
    """
    least = (step / 10) ** 2 / 2
    rule = Tolerances(
        flat=1e-4, coarse=1e-2, optimal=1e-4, relative=True, small=least, rounding=least
    )
    evaluations, x = 0, np.asarray(start, float)
    while True:
        found = minimise(
            objective, x, prior, tolerances=rule, max_evaluations=max_evaluations - evaluations,
            **options,
        )  # fmt: skip
        evaluations += found.evaluations
        found = dataclasses.replace(found, evaluations=evaluations)
        if found.status not in (Status.CONVERGED, Status.STUCK):
            return found
        near = [
            found.x + side * d
            for d in objective.divergence(found.x, found.x).moves(step)
            for side in (1.0, -1.0)
        ]
        costs = [objective.cost(y) for y in near]
        evaluations += len(costs)
        if not min(costs) < found.cost:
            return dataclasses.replace(found, evaluations=evaluations, status=Status.CONVERGED)
        x = near[int(np.argmin(costs))]
        options.pop("triangle", None)
        if evaluations >= max_evaluations:
            return dataclasses.replace(found, evaluations=evaluations, status=Status.BUDGET)


class Request(NamedTuple):
    """The next evaluation of a search at x: the triangular factor if `slopes`, else the cost."""

    x: np.ndarray
    slopes: bool


def search(
    D: Callable[[np.ndarray, np.ndarray], Divergence],
    start: np.ndarray,
    prior: np.ndarray | None = None,
    *,
    triangle: np.ndarray | None = None,
    prior_weights: tuple[float, ...] = PRIOR_WEIGHTS,
    max_evaluations: int = 100,
    tolerances: Tolerances = OF_SQUARES,
    watch: Callable[[int, float, np.ndarray], None] = lambda evaluation, cost, x: None,
) -> Generator[Request | Minimum, Any, None]:
    """Minimise an objective as a generator of requests, so that many searches run as one batch.

    The caller sends the answer to each `Request`. The last value is the `Minimum`.

    Args:
        D: (x, x0) -> divergence.
        start: (p,) initial x.
        prior: x_0. None: the start.
        triangle: R at the start, if it is known.
        prior_weights: weights w of the stages.
        max_evaluations: largest number of evaluations of the cost, over all stages.
        tolerances: stopping rule.
        watch: progress callback, called with the number of evaluations, the cost and x.

    Source: Nielsen, *Damping parameter in Marquardt's method*, IMM-REP-1999-05 (the damping).
    """
    x = np.array(start, float)
    prior = x if prior is None else np.asarray(prior, float)
    count = 0

    def cost(x: np.ndarray) -> Generator[Request, Any, float]:
        nonlocal count
        count += 1
        value = yield Request(x, False)
        watch(count, value, x)
        return value

    R = (yield Request(x, True)) if triangle is None else triangle
    ended, factor = False, metric_factor(D, x)
    if not _has_squares(R):
        yield Minimum(x, R, np.inf, count, Status.NOT_FINITE)
        return
    now = float(R[:, -1] @ R[:, -1]) if tolerances.relative else (yield from cost(x))
    if not np.isfinite(now) or factor is None:
        invalid = Status.INFEASIBLE if np.isfinite(now) else Status.NOT_FINITE
        yield Minimum(x, R, now, count, invalid)
        return
    damping = CALM
    for w in prior_weights:  # a stage starts with the damping of the last one
        last, damping, growth, ended = w == prior_weights[-1], min(damping, CALM), 2.0, False
        enough = tolerances.flat if last else tolerances.coarse
        while not ended and count < max_evaluations:
            size = _largest_curvature(factor, R)
            trial = regularised_step(R, x, D, ((w * size, prior), (damping * size, x)))
            near = D(trial, x).value <= tolerances.small
            pull = w * size * (D(x, prior).value - D(trial, prior).value)
            expected = _expected_decrease(R, trial - x, now, tolerances) + pull
            scale = now if tolerances.relative else 1.0
            calm = damping <= tolerances.calm and expected < enough * scale
            if calm and not last:  # the first step of the next stage replaces this one
                break
            after = yield from cost(trial)
            gain = (now - after + pull) / max(expected, 1e-300)
            # reject a point without a finite Jacobian and metric, since no step can start from it
            root = metric_factor(D, trial) if gain > 0 else None
            slopes = np.array(np.nan) if root is None else (yield Request(trial, True))
            if root is not None and _has_squares(slopes):
                x, now, R, factor = trial, after, slopes, root
                damping, growth = damping * max(0.1, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3), 2.0
                ended = calm or (near and damping <= CALM)
            else:
                damping, growth = damping * growth, growth * 2
                ended = near or damping > 1e9 or (calm and not tolerances.relative)
    for k in range(4):  # without the prior
        trial = x + identifiable_step(R, factor)
        after = np.inf
        if np.isfinite(D(trial, x).value):
            after = yield from cost(trial)
        # the first step removes the prior's bias; a later step with a smaller change of the
        # squares is rounding, or below the noise
        hidden = tolerances.relative and after > now / 10
        if k and hidden:
            break
        root = metric_factor(D, trial) if after < now else None
        slopes = np.array(np.nan) if root is None else (yield Request(trial, True))
        if root is None or not _has_squares(slopes):
            break
        x, now, R, factor = trial, after, slopes, root
        if hidden:
            break
    status = Status.STUCK if ended else Status.BUDGET
    if _is_minimum(D, x, R, prior_weights[-1], now, tolerances):
        status = Status.CONVERGED
    yield Minimum(x, R, now, count, status)


def _largest_curvature(factor: np.ndarray, R: np.ndarray) -> float:
    """Compute the largest eigenvalue of J^T J relative to the metric L L^T, with `factor` L."""
    return float(np.linalg.norm(np.linalg.solve(factor, R[:, :-1].T), 2)) ** 2


def _expected_decrease(
    R: np.ndarray, step: np.ndarray, now: float, tolerances: Tolerances
) -> float:
    """Compute the decrease of |r|^2 by a step in the linear model.

    now: the current cost.
    """
    linear = R[:, :-1] @ step + R[:, -1]
    squares = now if tolerances.relative else float(R[:, -1] @ R[:, -1])
    return squares - float(linear @ linear)


def _is_minimum(
    D: Callable, x: np.ndarray, R: np.ndarray, w: float, now: float, tolerances: Tolerances
) -> bool:
    """Check whether x is a minimum, without the prior.

    The Gauss-Newton step within the bounds must be as short as rounding, or have an expected
    decrease of the cost below the resolution of noise.
    """
    factor = metric_factor(D, x)
    if factor is None:
        return False
    if not R[:, -1].any():
        return True
    enough = tolerances.optimal * (now if tolerances.relative else 1.0)

    def ends(y: np.ndarray) -> bool:
        expected = _expected_decrease(R, y - x, now, tolerances)
        return bool(expected <= enough or D(y, x).value <= tolerances.rounding)

    # the step without bounds is at least as long, with at least as large an expected decrease
    if ends(x + identifiable_step(R, factor)):
        return True
    return ends(regularised_step(R, x, D, ((w * _largest_curvature(factor, R), x),)))


def _has_squares(R: np.ndarray) -> bool:
    """Check that the derivatives and their squares are finite."""
    return bool((np.abs(R) < HUGE).all())


def metric_factor(
    D: Callable[[np.ndarray, np.ndarray], Divergence], x: np.ndarray
) -> np.ndarray | None:
    """Compute the Cholesky factor of the metric at x.

    Return None if the metric is not positive definite because of rounding, as for a thin body.
    """
    curvature = D(x, x).curvature
    if not np.isfinite(curvature).all():
        return None
    try:
        return np.linalg.cholesky(curvature)
    except np.linalg.LinAlgError:
        return None


@np.errstate(**TRIAL)
def regularised_step(
    R: np.ndarray,
    x: np.ndarray,
    D: Callable[[np.ndarray, np.ndarray], Divergence],
    terms: tuple[tuple[float, np.ndarray], ...],
) -> np.ndarray:
    """Minimise |J (y - x) + r|^2 + sum of w D(y, x0) over y, by Newton's method from x.

    `terms` are the pairs (w, x0).
    """
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
        # the curvature of D at y does not depend on x0
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


def identifiable_step(R: np.ndarray, L: np.ndarray) -> np.ndarray:
    """Compute the shortest Gauss-Newton step in the identifiable directions, with metric L L^T."""
    tolerance = rank_tolerance("unknowns", R.dtype)
    A = np.linalg.solve(L, R[:, :-1].T).T
    moves = A.any(0)  # do not change entries without an effect on the residuals
    U, s, Vt = np.linalg.svd(A[:, moves], full_matrices=False)
    kept = s > tolerance * s.max(initial=0.0)
    z = np.zeros(A.shape[1])
    z[moves] = Vt[kept].T @ ((U.T @ R[:, -1])[kept] / s[kept])
    return -np.linalg.solve(L.T, z)
