"""Rotations in a hundred digits, only from definitions: matrix power series and elementary turns.

Nothing here shares a formula with rbjax: exponentials and Jacobians are power series of matrices,
rate maps are differences of the rotation matrix, derivatives are differences along a line.
"""

from collections.abc import Callable, Sequence

import jax
import mpmath
import numpy as np
from mpmath import mp, mpf

from tests.tolerances import relative_error

DIGITS = 100
STEP = mpf(10) ** -12  # of differences: truncation 1e-24

# at, near and far from the removable singularity at zero, and up to half a turn
ANGLES = [
    0.0, 1e-300, 1e-12, 1e-9, 1e-6, 1e-4, 1e-3, 1e-2, 0.1, 0.5, 1.0, 1.5, 1.7320508, 1.7320509,
    2.0, 2.5, 3.0, 3.14, np.pi - 1e-6, np.pi - 1e-9,
]  # fmt: skip


def numbers(x) -> list:
    return [mpf(float(a)) for a in np.ravel(x)]


def hat(p: Sequence) -> mpmath.matrix:
    x, y, z = p
    return mpmath.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def vee(W: mpmath.matrix) -> list:
    return [(W[2, 1] - W[1, 2]) / 2, (W[0, 2] - W[2, 0]) / 2, (W[1, 0] - W[0, 1]) / 2]


def series(A: mpmath.matrix, first: int = 0) -> mpmath.matrix:
    """sum_n A^n / (n + first)!: the exponential for first = 0, its left Jacobian for 1."""
    term = mpmath.eye(A.rows) / mpmath.factorial(first)
    total, n = term, first
    while True:
        n += 1
        term = term * A / n
        total += term
        if max(abs(a) for a in term) < mpf(10) ** -(DIGITS + 5):
            return total


def turn(axis: Sequence, angle) -> mpmath.matrix:
    """Rodrigues' formula for a unit axis."""
    K = hat(axis)
    return mpmath.eye(3) + mpmath.sin(angle) * K + (1 - mpmath.cos(angle)) * K * K


def norm(p: Sequence):
    return mpmath.sqrt(sum(a * a for a in p))


def quaternion_matrix(q: Sequence) -> mpmath.matrix:
    n = norm(q)
    w, *u = (a / n for a in q)
    K = hat(u)
    return mpmath.eye(3) + 2 * w * K + 2 * K * K


def quaternion_exp(phi: Sequence) -> list:
    angle = norm(phi)
    scale = mpmath.sin(angle / 2) / angle if angle else mpf(1) / 2
    return [mpmath.cos(angle / 2), *(p * scale for p in phi)]


def quaternion_log(q: Sequence) -> list:
    """Of a quaternion of any length, by the shorter way round."""
    w, *u = q if q[0] >= 0 else [-x for x in q]
    n = norm(u)
    scale = 2 * mpmath.atan2(n, w) / n if n else 2 / w
    return [x * scale for x in u]


def matrix_log(R: mpmath.matrix) -> list:
    """By the half angle: n sin(phi) is the skew part, 1 + cos(phi) comes from the trace."""
    v = vee(R)
    sine, cosine = norm(v), (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2
    return [a * (mpmath.atan2(sine, cosine) / sine if sine else 1) for a in v]


def rate_matrices(to_matrix: Callable, x: Sequence) -> tuple[mpmath.matrix, mpmath.matrix]:
    """The body and the space rate matrix: vee(R^T dR/dx_k), vee(dR/dx_k R^T), column by column."""
    h = mpf(10) ** -35 * max(1, norm(x))
    R, body, space = to_matrix(x), [], []
    for k in range(len(x)):
        ends = [to_matrix([a + s * h * (i == k) for i, a in enumerate(x)]) for s in (-1, 1)]
        dR = (ends[1] - ends[0]) / (2 * h)
        body.append(vee(R.T * dR))
        space.append(vee(dR * R.T))
    return mpmath.matrix(body).T, mpmath.matrix(space).T


def jet(f: Callable[[list], object], x, d) -> list[np.ndarray]:
    """f and its first two derivatives at x along d, flattened."""
    with mp.workdps(DIGITS):
        x, d = numbers(x), numbers(d)
        left, here, right = (
            list(f([a + k * STEP * b for a, b in zip(x, d, strict=True)])) for k in (-1, 0, 1)
        )
        first = [(r - l) / (2 * STEP) for l, r in zip(left, right, strict=True)]
        second = [(r - 2 * c + l) / STEP**2 for l, c, r in zip(left, here, right, strict=True)]
        return [np.array([float(a) for a in row]) for row in (here, first, second)]


def jets(f: Callable[[list], object], xs, ds) -> list[np.ndarray]:
    """`jet` of every sample."""
    rows = [jet(f, x, d) for x, d in zip(xs, ds, strict=True)]
    return [np.stack(column) for column in zip(*rows, strict=True)]


def our_jets(f: Callable, xs, ds) -> list[np.ndarray]:
    """The same of a function of ours: value, forward first and second derivative, reverse first."""

    def one(x, d):
        def line(t):
            return f(x + t * d).reshape(-1)

        def rate(t):
            return jax.jvp(line, (t,), (jax.numpy.ones_like(t),))

        zero = jax.numpy.zeros((), x.dtype)
        (value, first), (_, second) = jax.jvp(rate, (zero,), (jax.numpy.ones_like(zero),))
        weight = jax.numpy.cos(jax.numpy.arange(value.size, dtype=x.dtype))
        (gradient,) = jax.vjp(lambda x: f(x).reshape(-1), x)[1](weight)
        return value, first, second, (gradient * d).sum() - (weight * first).sum()

    run = jax.jit(jax.vmap(one))
    return [np.asarray(a) for a in run(jax.numpy.asarray(xs), jax.numpy.asarray(ds))]


# What the room promises against a hundred digits: a few units in the last place (2.2e-16) of the
# largest entry, up to half a turn; derivatives to 1e-12.
VALUE, DERIVATIVE = 1e-15, 1e-12


def assert_jets(got: list[np.ndarray], want: list[np.ndarray], floor: float = 1e-3) -> None:
    """`our_jets` are `jets`, and the reverse mode is the forward one."""
    for g, w, limit in zip(got[:3], want, (VALUE, DERIVATIVE, DERIVATIVE), strict=True):
        error = relative_error(g, w, batch_dims=1, floor=floor)
        assert error.max() <= limit, (error.argmax(), error.max())
    assert np.abs(got[3]).max() <= DERIVATIVE * max(1.0, np.abs(got[1]).max())
