"""The Kalman filter and smoother of a nonlinear model, on arrays or on a manifold.

    x_(k+1) = f(x_k, u_k, w_k),  w ~ N(0, W),      y_k = h(x_k) + e_k,  e ~ N(0, R)
    z = y (-) h(x),  S = H P H^T + R,  K = P H^T S^-1                       innovation, gain
    x <- x (+) K z,  P <- (1 - K H) P (1 - K H)^T + K R K^T                 update (Joseph)
    x <- f(x, u, 0), P <- A P A^T + G W G^T                                 prediction
    -log p(y) = sum of (z^T S^-1 z + log det 2 pi S) / 2                    likelihood

P is a covariance in the tangent space at the estimated state. It may be singular. All results are
differentiable for R > 0. The Rauch-Tung-Striebel smoother has the form of Bryson and Frazier,
without P^-1.
Source: Bryson & Ho, *Applied Optimal Control*, 13; Bierman, *Factorization Methods*, X; Sola, *A
micro Lie theory*, 2018 (tangent spaces); Schweppe, IEEE T-IT 11(1), 1965 (likelihood).
"""

from __future__ import annotations

import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve

from rbjax.arguments import instance
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.estimation.state_space import SPACE, StateSpace, check_fits, check_inputs, matrix, real


@displayed
class KalmanFiltered(NamedTuple):
    """The estimates of a filter at each of N + 1 samples.

    predicted: states before the update, a pytree of (N + 1, ...).
    predicted_covariance: covariances before the update, (N + 1, n, n).
    state, covariance: the same quantities after the update.
    innovation: z, (N + 1, m), 0 for missing readings.
    innovation_covariance: S, (N + 1, m, m), with 1 in place of R for missing readings.
    log_likelihood: of all samples together.
    slopes: A, the Jacobian of the prediction to the next sample, (N + 1, n, n), for the smoother.
    reads: H, (N + 1, m, n), for the smoother.
    kept: 1 - K H, mapped to the tangent space after the update, (N + 1, n, n), for the smoother.
    """

    predicted: Any
    predicted_covariance: jax.Array
    state: Any
    covariance: jax.Array
    innovation: jax.Array
    innovation_covariance: jax.Array
    log_likelihood: jax.Array
    slopes: jax.Array
    reads: jax.Array
    kept: jax.Array


@displayed
class Smoothed(NamedTuple):
    """The estimate of each state from all samples.

    state: states, a pytree of (N + 1, ...).
    covariance: covariances in the tangent spaces of the states, (N + 1, n, n).
    """

    state: Any
    covariance: jax.Array


def kalman_filter(
    space: StateSpace,
    start: Any,
    covariance: Any,
    inputs: Any,
    readings: Any,
    process: Any,
    noise: Any,
    *,
    arrived: Any = None,
) -> KalmanFiltered:
    """Estimate the states of N + 1 samples with the extended Kalman filter.

    Args:
        space: the model.
        start: mean of the first state, before the first update.
        covariance: of the first state, (n, n) or the variances (n,); 0 if it is known exactly.
        inputs: u, a pytree of arrays (N, ...); input k moves state k to state k + 1.
        readings: y, a pytree of arrays (N + 1, ...); reading k is of state k.
        process: W, (l, l) or the variances (l,).
        noise: R, (m, m) or the variances (m,), positive definite.
        arrived: (N + 1, m), false for missing rows of the innovation; their readings may have any
            finite value. If None, readings is an array (N + 1, m), and its nan entries are missing.

    Returns:
        `KalmanFiltered`, nan if an innovation covariance is not positive definite.

    Raises:
        InputError: covariances that are neither matrices nor variances; numbers of samples that do
            not match.

    Source: Bryson & Ho, 12.7; Bucy & Joseph 1968 (the update).

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.estimation import StateSpace, kalman_filter
        >>> walk = StateSpace.of(lambda x, u, w: x + w, lambda x: x)
        >>> seen = jnp.array([[1.0], [jnp.nan], [2.0]])
        >>> found = kalman_filter(walk, jnp.zeros(1), [1.0], jnp.zeros(2), seen, [1.0], [1.0])
        >>> [round(float(P), 3) for P in found.covariance.ravel()]
        [0.5, 1.5, 0.714]
    """
    P, W, R = (
        matrix(name, x)
        for name, x in (("covariance", covariance), ("process", process), ("noise", noise))
    )
    m = R.shape[0]
    instance("kalman_filter", "space", space, StateSpace, SPACE)
    if space.box_plus is operator.add:
        start = real("kalman_filter", "start", start, "the mean (n,) of the first state")
    check_inputs("kalman_filter", inputs, samples=True)
    first = jax.tree.map(lambda x: jnp.asarray(x)[0], inputs)
    check_fits("kalman_filter", space, start, P, first, W)
    if arrived is None:
        expected = "an array (N + 1, m), nan where nothing arrived; or give `arrived`"
        readings = real("kalman_filter", "readings", readings, expected, finite=False)
        if readings.ndim != 2:
            shape = readings.shape
            raise InputError(f"kalman_filter: readings have shape {shape}, expected {expected}")
        arrived = ~jnp.isnan(readings)
        readings = jnp.where(arrived, readings, 0.0)
    arrived = jnp.asarray(arrived, bool)
    N = {x.shape[0] + 1 for x in map(jnp.asarray, jax.tree.leaves(inputs))}
    N |= {jnp.asarray(x).shape[0] for x in jax.tree.leaves(readings)}
    if arrived.shape[1:] != (m,) or {arrived.shape[0]} != N:
        raise InputError(
            f"kalman_filter: readings of {sorted(N)} samples (one more than inputs) and arrived of "
            f"shape {arrived.shape}, expected as many samples in all and {m} rows, as noise has"
        )
    # repeat the last input: the prediction after the last sample is not used
    inputs = jax.tree.map(lambda a: jnp.concatenate([jnp.asarray(a), a[-1:]]), inputs)

    def sample(carry: Any, given: Any) -> Any:
        x, P = carry
        u, y, there = given
        found = _update(space, x, P, y, there, R)
        new, after, A = _predict(space, found.state, found.covariance, u, W)
        said = found._replace(slopes=A)
        return (new, after), said

    found = jax.lax.scan(sample, (start, P), (inputs, readings, arrived))[1]
    return found._replace(log_likelihood=found.log_likelihood.sum())


def kalman_smoother(space: StateSpace, filtered: KalmanFiltered) -> Smoothed:
    """Estimate each state from all samples with the Rauch-Tung-Striebel smoother.

        l = A^T l',   x (+) -P l,   P - P L P;     l' = -H^T S^-1 z + C^T l,   C = 1 - K H

    backwards from l = 0, with L the covariance of l (the form of Bryson and Frazier, without the
    inverse of P). If the later samples reduce P by k decades, the difference loses k digits.

    Args:
        space: the model.
        filtered: the result of `kalman_filter`.

    Returns:
        `Smoothed`, with states and covariances (T, n, n).

    Raises:
        InputError: not a `StateSpace`, or not the result of `kalman_filter`.

    Source: Bryson & Frazier 1963; Bierman, *Fixed interval smoothing with discrete measurements*,
    Int. J. Control 18(1), 1973; Rauch, Tung & Striebel, AIAA J. 3(8), 1965.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.estimation import StateSpace, kalman_filter, kalman_smoother
        >>> walk = StateSpace.of(lambda x, u, w: x + w, lambda x: x)
        >>> seen = jnp.array([[1.0], [jnp.nan], [2.0]])
        >>> found = kalman_filter(walk, jnp.zeros(1), [1.0], jnp.zeros(2), seen, [1.0], [1.0])
        >>> [round(float(x), 3) for x in kalman_smoother(walk, found).state.ravel()]
        [0.714, 1.143, 1.571]
    """
    instance("kalman_smoother", "space", space, StateSpace, SPACE)
    instance("kalman_smoother", "filtered", filtered, KalmanFiltered, "the result of kalman_filter")
    n = filtered.covariance.shape[-1]
    zero = jnp.zeros(n, filtered.covariance.dtype)

    def sample(carry: Any, f: KalmanFiltered) -> Any:
        l, L = carry
        state, turn = _retract(space, f.state, -f.covariance @ l)
        P = f.covariance - f.covariance @ L @ f.covariance
        if turn is not None:
            P = turn @ P @ turn.T
        S = jnp.linalg.cholesky(f.innovation_covariance)
        SH = cho_solve((S, True), f.reads)
        l = f.kept.T @ l - SH.T @ f.innovation
        L = f.kept.T @ L @ f.kept + f.reads.T @ SH
        return (l, (L + L.T) / 2), (Smoothed(state, (P + P.T) / 2))

    # align each A with the sample that it leads to
    led = jnp.concatenate([jnp.zeros_like(filtered.slopes[:1]), filtered.slopes[:-1]])

    def back(carry: Any, given: Any) -> Any:
        f, A = given
        (l, L), found = sample(carry, f)
        return (A.T @ l, A.T @ L @ A), found

    each = filtered._replace(log_likelihood=jnp.zeros(led.shape[0], zero.dtype))
    begin = (zero, jnp.zeros((n, n), zero.dtype))
    return jax.lax.scan(back, begin, (each, led), reverse=True)[1]


def _update(
    space: StateSpace, x: Any, P: jax.Array, y: Any, there: jax.Array, R: jax.Array
) -> KalmanFiltered:
    """Update a state and its covariance by one sample. The field `slopes` of the result is zero."""
    n, m = P.shape[0], R.shape[0]

    def innovation(dx: jax.Array) -> tuple[jax.Array, jax.Array]:
        z = jnp.where(there, space.innovation(space.box_plus(x, dx), y), 0.0)
        return z, z

    H, z = jax.jacfwd(innovation, has_aux=True)(jnp.zeros(n, P.dtype))
    H = -H
    seen = jnp.where(there[:, None] & there, R, jnp.eye(m, dtype=P.dtype))
    S = H @ P @ H.T + seen
    L = jnp.linalg.cholesky(S)
    K = cho_solve((L, True), H @ P).T
    left = jnp.eye(n, dtype=P.dtype) - K @ H
    updated = left @ P @ left.T + K @ seen @ K.T
    state, turn = _retract(space, x, K @ z)
    if turn is not None:
        left, updated = turn @ left, turn @ updated @ turn.T
    r = jax.scipy.linalg.solve_triangular(L, z, lower=True)
    log = -(r @ r) / 2 - jnp.log(jnp.diag(L)).sum() - there.sum() * jnp.log(2 * jnp.pi) / 2
    return KalmanFiltered(x, P, state, updated, z, S, log, jnp.zeros_like(P), H, left)


def _predict(
    space: StateSpace, state: Any, P: jax.Array, u: Any, W: jax.Array
) -> tuple[Any, jax.Array, jax.Array]:
    """Return the next state, its covariance, and the Jacobian A of the step."""
    n, l = P.shape[0], W.shape[0]

    def move(dw: jax.Array) -> tuple[Any, Any]:
        new = space.move(space.box_plus(state, dw[:n]), u, dw[n:])
        return new, new

    slopes, new = jax.jacfwd(move, has_aux=True)(jnp.zeros(n + l, P.dtype))
    columns = jax.vmap(
        lambda d: jax.jvp(lambda y: space.box_minus(new, y), (new,), (d,))[1], -1, -1
    )
    A, G = jnp.split(columns(slopes), [n], 1)
    after = A @ P @ A.T + G @ W @ G.T
    return new, (after + after.T) / 2, A


@displayed
class Estimate(NamedTuple):
    """A state and its covariance (n, n), in the tangent space of the state."""

    state: Any
    covariance: jax.Array


def kalman_update(
    space: StateSpace, estimate: Estimate, reading: Any, noise: Any, *, arrived: Any = None
) -> Estimate:
    """Update an estimate by one sample: the first half of a step of `kalman_filter`.

        K = P H^T (H P H^T + R)^-1,   x (+) K (y (-) h(x)),   (1 - K H) P (1 - K H)^T + K R K^T

    Args:
        space: the model.
        estimate: before the sample.
        reading: y.
        noise: R, (m, m) or the variances (m,), positive definite.
        arrived: (m,), false for missing rows. If None, reading is an array (m,), and its nan
            entries are missing.

    Returns:
        `Estimate`.

    Raises:
        InputError: a noise that is neither a matrix nor variances.

    Source: Bryson & Ho, 12.7; Bucy & Joseph 1968.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.estimation import Estimate, StateSpace, kalman_update
        >>> walk = StateSpace.of(lambda x, u, w: x + w, lambda x: x)
        >>> found = kalman_update(walk, Estimate(jnp.zeros(1), jnp.eye(1)), jnp.ones(1), [1.0])
        >>> round(float(found.state[0]), 6), round(float(found.covariance[0, 0]), 6)
        (0.5, 0.5)
    """
    where = "kalman_update"
    R = matrix("noise", noise, where)
    instance(where, "estimate", estimate, Estimate, "an Estimate(state, covariance)")
    instance(where, "space", space, StateSpace, SPACE)
    P = matrix("covariance", estimate.covariance, where)
    check_fits(where, space, estimate.state, P, None, None)
    if arrived is None:
        expected = "an array (m,), nan where nothing arrived; or give `arrived`"
        reading = real(where, "reading", reading, expected, finite=False)
        if reading.shape != R.shape[:1]:
            raise InputError(
                f"{where}: the reading has shape {reading.shape}, expected {R.shape[:1]}, as noise"
            )
        arrived = ~jnp.isnan(reading)
        reading = jnp.where(arrived, reading, 0.0)
    there = jnp.broadcast_to(jnp.asarray(arrived, bool), R.shape[:1])
    found = _update(space, estimate.state, P, reading, there, R)
    return Estimate(found.state, found.covariance)


def kalman_predict(space: StateSpace, estimate: Estimate, given: Any, process: Any) -> Estimate:
    """Predict the next state: the second half of a step of `kalman_filter`.

        x+ = f(x, u, 0),   P+ = A P A^T + G W G^T

    Args:
        space: the model.
        estimate: after the last sample.
        given: u, the inputs of the step.
        process: W, (l, l) or the variances (l,).

    Returns:
        `Estimate`.

    Raises:
        InputError: a process noise that is neither a matrix nor variances.

    Source: Bryson & Ho, 12.7.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.estimation import Estimate, StateSpace, kalman_predict
        >>> walk = StateSpace.of(lambda x, u, w: x + u + w, lambda x: x)
        >>> found = kalman_predict(walk, Estimate(jnp.zeros(1), jnp.eye(1)), jnp.ones(1), [2.0])
        >>> float(found.state[0]), float(found.covariance[0, 0])
        (1.0, 3.0)
    """
    where = "kalman_predict"
    instance(where, "estimate", estimate, Estimate, "an Estimate(state, covariance)")
    P, W = matrix("covariance", estimate.covariance, where), matrix("process", process, where)
    instance(where, "space", space, StateSpace, SPACE)
    check_inputs(where, given, samples=False)
    check_fits(where, space, estimate.state, P, given, W)
    state, after, _ = _predict(space, estimate.state, P, given, W)
    return Estimate(state, after)


def _retract(space: StateSpace, x: Any, dx: jax.Array) -> tuple[Any, jax.Array | None]:
    """Return x (+) dx, and the map of tangent vectors from x to the new state (None for arrays)."""
    if space.box_plus is operator.add:
        return x + dx, None
    new = space.box_plus(x, dx)
    turn = jax.jacfwd(lambda e: space.box_minus(new, space.box_plus(x, dx + e)))(jnp.zeros_like(dx))
    return new, turn
