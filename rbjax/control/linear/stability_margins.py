"""Gain, phase and delay margins of a state feedback, with one loop broken at its input at a time.

    l_i(s) = k_i (s - A_i)^-1 b_i,     A_i = A - sum_(j != i) b_j k_j,     s = iw, or z = exp(iw dt)

is the loop transfer function at input i, with the other loops closed. The closed loop stays stable
as long as l_i does not reach -1. Crossings of the real axis and of |l| = 1 are located on a
logarithmic grid of frequencies and refined by bisection. A resonance much narrower than the grid is
missed.
Source: Åström & Murray, *Feedback Systems*, 10; Safonov & Athans, IEEE TAC 22(2), 1977.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import integer
from rbjax.compiling import compiled
from rbjax.control.linear.arguments import check_matrices
from rbjax.control.linear.lyapunov_equation import is_stable
from rbjax.control.products import product
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_step

CROSSINGS = 16  # maximum number of crossings of each kind
HALVINGS = 50
DECADES = 3.0  # of the grid below the slowest and above the fastest rate


@displayed
class Margins(NamedTuple):
    """Stability margins, one entry an input.

    gain_up: smallest factor above 1 at which the loop becomes unstable, (m,); inf if there is none.
    gain_down: largest factor below 1 at which the loop becomes unstable, (m,); 0 if there is none.
    phase: phase margin, (m,), rad; pi if |l| does not cross 1.
    delay: delay margin, (m,), s; inf if there is none.
    stable: true if the closed loop is stable, (); if not, the gains are 1, phase and delay 0.
    """

    gain_up: jax.Array
    gain_down: jax.Array
    phase: jax.Array
    delay: jax.Array
    stable: jax.Array


def margins(A: Any, B: Any, K: Any, dt: Any = None, *, frequencies: int = 2000) -> Margins:
    """Compute the margins of u = -K x at each input, with the other loops closed.

    Args:
        A: (n, n).
        B: (n, m).
        K: (m, n).
        dt: seconds of a step, if x+ = A x + B u; None in continuous time.
        frequencies: number of points of the grid, from a thousandth of the slowest rate to a
            thousand times the fastest.

    Returns:
        `Margins`.

    Raises:
        InputError: shapes, values that are not finite.

    Source: Åström & Murray, 10.3.

    Example:
        >>> import jax, math
        >>> from rbjax.control.linear import margins
        >>> with jax.enable_x64(True):  # an integrator: l = 1 / s
        ...     found = margins([[0.0]], [[1.0]], [[1.0]])
        >>> round(math.degrees(float(found.phase[0])), 6), round(float(found.delay[0]), 6)
        (90.0, 1.570796)
    """
    A, B, K = check_matrices("margins", ("A", A, "nn"), ("B", B, "nm"), ("K", K, "mn"))
    step = None if dt is None else check_step("margins", "dt", dt, A.dtype)
    integer("margins", "frequencies", frequencies, least=2)
    return _margins(A, B, K, step, frequencies)


@functools.partial(compiled, static_argnums=4)
def _margins(A: jax.Array, B: jax.Array, K: jax.Array, step: Any, frequencies: int) -> Margins:
    closed = A - product(B, K)
    stable = is_stable(closed, step is not None)
    w = _grid(A, closed, step, frequencies)

    def of(i: jax.Array) -> tuple[jax.Array, ...]:
        b, k = B[:, i], K[i]
        return _of_loop(closed + jnp.outer(b, k), b, k, w, step)

    up, down, phase, delay = jax.vmap(of)(jnp.arange(B.shape[1]))
    return Margins(
        jnp.where(stable, up, 1.0), jnp.where(stable, down, 1.0),
        jnp.where(stable, phase, 0.0), jnp.where(stable, delay, 0.0), stable,
    )  # fmt: skip


def _grid(A: jax.Array, closed: jax.Array, dt: Any, points: int) -> jax.Array:
    """Return a logarithmic grid of frequencies (points,), rad/s, around the rates of A and of the
    closed loop."""
    if dt is not None:  # up to the Nyquist frequency
        return jnp.logspace(-2 - DECADES, 0, points, dtype=A.dtype) * (math.pi / dt)
    fast = jnp.maximum(jnp.linalg.norm(A), jnp.linalg.norm(closed))
    slow = 1 / jnp.linalg.norm(jnp.linalg.inv(closed))
    slow = jnp.where(jnp.isfinite(slow) & (slow > 0), slow, fast)
    low, high = jnp.log10(slow) - DECADES, jnp.log10(fast) + DECADES
    return 10 ** (low + (high - low) * jnp.linspace(0, 1, points, dtype=A.dtype))


def _of_loop(A: jax.Array, b: jax.Array, k: jax.Array, w: jax.Array, dt: Any) -> tuple:
    n = A.shape[0]
    one = jnp.eye(n, dtype=A.dtype)

    def loop(w: jax.Array) -> jax.Array:
        z = 1j * w if dt is None else jnp.exp(1j * w * dt)
        return (k * jnp.linalg.solve(z * one - A, b.astype(z.dtype))).sum()

    def refined(f: Any, values: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return frequencies at which f(l) changes sign, and the loop transfer function l at them.

        Unused entries are nan.
        """
        sign = jnp.signbit(values)
        at = jnp.nonzero(sign[1:] != sign[:-1], size=CROSSINGS, fill_value=-1)[0]
        low, high = w[at], w[at + 1]

        def halve(_, ends):
            low, high = ends
            middle = (low + high) / 2
            same = jnp.signbit(f(jax.vmap(loop)(middle))) == sign[at]
            return jnp.where(same, middle, low), jnp.where(same, high, middle)

        low, high = jax.lax.fori_loop(0, HALVINGS, halve, (low, high))
        there = jnp.where(at >= 0, (low + high) / 2, jnp.nan)
        return there, jax.vmap(loop)((low + high) / 2)

    l = jax.vmap(loop)(w)
    at, crossing = refined(jnp.imag, l.imag)
    # at frequency 0 and at the Nyquist frequency l is real; near a pole it is large
    ends = [(w[:1] * 0, jax.vmap(loop)(w[:1] * 0).real)]
    if dt is not None:
        ends.append((w[-1:], jax.vmap(loop)(w[-1:]).real))
    at = jnp.concatenate([at, *(x for x, _ in ends)])
    real = jnp.concatenate([crossing.real, *(x for _, x in ends)])
    g = jnp.where(jnp.isfinite(at) & (real < 0), -1 / real, jnp.nan)
    up = jnp.where(g > 1, g, jnp.inf).min()
    down = jnp.where(g < 1, g, 0.0).max()
    at, there = refined(lambda l: jnp.abs(l) - 1, jnp.abs(l) - 1)
    found = jnp.isfinite(at)
    turn = jnp.angle(-there)  # angle of l relative to -1
    phase = jnp.where(found, jnp.abs(turn), jnp.pi).min()
    # a delay rotates l clockwise
    late = jnp.where(turn < 0, turn + 2 * jnp.pi, turn)
    delay = jnp.where(found, late / at, jnp.inf).min()
    return up, down, phase, delay
