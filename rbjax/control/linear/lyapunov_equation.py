"""Lyapunov equations, by doubling.

    discrete    X = A X A' + Q = sum of A^k Q A'^k
    continuous  A X + X A' + Q = 0,   X = integral of exp(At) Q exp(A't)

Smith's doubling X <- X + A X A', A <- A^2 sums 2^k terms in k steps. Cayley's transform with a
shift g > 0 makes a continuous equation discrete: F = (g - A)^-1 (g + A) and 2 g (g - A)^-1 Q (g -
A)^-T have the same X. One step of iterative refinement follows. A is stable if the norm of a power
of it is below one, so no eigenvalues are needed.

The Kronecker form (1 - A x A) vec X = vec Q also has a solution for unstable A, unless two
eigenvalues are each other's inverse (or negative). It needs n^6 operations.
Source: Smith, SIAM J. Applied Math. 16, 1968; Golub & Van Loan, *Matrix Computations*, 7.6.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import choice, flag
from rbjax.compiling import compiled
from rbjax.control.linear.arguments import check_matrices
from rbjax.control.products import product
from rbjax.control.status import LinearStatus, first_of, raise_failure
from rbjax.display import displayed

#: maximum number of squarings; they resolve a spectral radius of 1 - 1e-15
SQUARINGS = 56
METHODS = ("doubling", "kronecker")


@displayed
class Lyapunov(NamedTuple):
    """The solution of a Lyapunov equation.

    X: solution, (n, n), symmetric if Q is.
    residual: largest entry of the residual, relative to the terms of the equation, ().
    status: a `LinearStatus`.
    """

    X: jax.Array
    residual: jax.Array
    status: Any

    @property
    def success(self) -> jax.Array:
        """True if there is a solution."""
        return self.status == LinearStatus.success


def lyapunov(A: Any, Q: Any, *, discrete: bool = False, method: str = "doubling") -> Lyapunov:
    """Solve A X + X A' + Q = 0, or A X A' - X + Q = 0 in discrete time, for X.

    `lyapunov(A, B @ B.T)` is the controllability Gramian of a stable system, and
    `lyapunov(A.T, C.T @ C)` is the observability Gramian.

    Args:
        A: (n, n).
        Q: (n, n), symmetric or not.
        discrete: true for A X A' - X + Q = 0.
        method: "doubling" for stable A; "kronecker" for any A with a unique solution, with (n^2,
            n^2) linear systems.

    Returns:
        `Lyapunov`. In traced code, if A is not stable, doubling returns the status `not_stable` and
        X = 0.

    Raises:
        InputError: shapes, values that are not finite; outside of traced code also if there is no
            solution.
        UnknownName: the method.

    Differentiable in A and Q in both modes, by the implicit function theorem.

    Source: Smith 1968; Bartels & Stewart 1972 (the problem); Zhou, Doyle & Glover, *Robust and
    Optimal Control*, 3.8 (Gramians).

    Example:
        >>> from rbjax.control.linear import lyapunov
        >>> float(lyapunov([[-2.0]], [[4.0]]).X[0, 0])
        1.0
    """
    A, Q = check_matrices("lyapunov", ("A", A, "nn"), ("Q", Q, "nn"))
    choice("method of lyapunov", method, METHODS)
    found = _lyapunov(A, Q, flag("lyapunov", "discrete", discrete), method)
    raise_failure("lyapunov", found.status)
    return found


@functools.partial(compiled, static_argnums=(2, 3))
def _lyapunov(A: jax.Array, Q: jax.Array, discrete: bool, method: str) -> Lyapunov:
    dtype = A.dtype
    left = functools.partial(_left_side, discrete)
    if method == "kronecker":
        X, stable = _by_kronecker(A, Q, discrete), jnp.asarray(True)
    else:
        X, stable = solve_stable(A, Q, discrete)
    finite = jnp.isfinite(X).all()
    X = jnp.where(finite & stable, X, 0.0)
    size = (
        jnp.abs(Q).max()
        + jnp.abs(left(A, X)).max()
        + jnp.abs(X).max() * (1 if discrete else jnp.abs(A).max())
    )
    off = jnp.abs(left(A, X) - Q).max() / jnp.maximum(size, jnp.finfo(dtype).tiny)
    status = first_of((~stable, LinearStatus.not_stable), (~finite, LinearStatus.not_finite))
    return Lyapunov(X, off, status)


def _left_side(discrete: bool, A: jax.Array, X: jax.Array) -> jax.Array:
    """Return X - A X A' (discrete) or -(A X + X A')."""
    if discrete:
        return X - product(product(A, X), A.T)
    return -(product(A, X) + product(X, A.T))


def solve_stable(A: jax.Array, Q: jax.Array, discrete: bool) -> tuple[jax.Array, jax.Array]:
    """Return the solution X, and whether A is stable; if not, X is finite but meaningless."""
    stable = is_stable(A, discrete)
    safe = jnp.where(stable, A, 0.0 if discrete else -jnp.eye(A.shape[0], dtype=A.dtype))
    X = jax.lax.custom_linear_solve(
        lambda X: _left_side(discrete, safe, X), Q,
        lambda _, Q: _solve_refined(safe, Q, discrete),
        lambda _, Q: _solve_refined(safe.T, Q, discrete),
    )  # fmt: skip
    return X, stable


def is_stable(A: jax.Array, discrete: bool) -> jax.Array:
    """Return whether x+ = A x, or x' = A x, is stable. It is stable if some power of A, or of its
    Cayley transform, has a norm below one."""
    A = A if discrete else cayley(A, cayley_shift(A))[0]

    def going(carry):
        A, k, stable = carry
        return (k < SQUARINGS) & ~stable & jnp.isfinite(A).all()

    def turn(carry):
        A, k, _ = carry
        A = product(A, A)
        return A, k + 1, jnp.abs(A).sum(-1).max() < 1

    A = jax.lax.stop_gradient(A)
    first = jnp.abs(A).sum(-1).max() < 1
    return jax.lax.while_loop(going, turn, (A, 0, first))[2]


def _sum_by_doubling(A: jax.Array, Q: jax.Array) -> jax.Array:
    """Return the sum of A^k Q A'^k."""
    eps = jnp.finfo(A.dtype).eps

    def going(carry):
        _, X, term, k = carry
        return (k < SQUARINGS) & (term > eps * jnp.abs(X).max() / 8)

    def turn(carry):
        A, X, _, k = carry
        more = product(product(A, X), A.T)
        return product(A, A), X + more, jnp.abs(more).max(), k + 1

    return jax.lax.while_loop(going, turn, (A, Q, jnp.asarray(jnp.inf, A.dtype), 0))[1]


def cayley(A: jax.Array, g: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return (g - A)^-1 (g + A) and (g - A)^-1."""
    one = jnp.eye(A.shape[0], dtype=A.dtype)
    inverse = jnp.linalg.inv(g * one - A)
    return product(inverse, g * one + A), inverse


def cayley_shift(A: jax.Array) -> jax.Array:
    """Return the geometric mean of the fastest and the slowest rate, from norms of A and its
    inverse. The Cayley transform is valid for any positive shift."""
    fast = jnp.sqrt(jnp.abs(A).sum(0).max() * jnp.abs(A).sum(1).max())
    slow = jnp.linalg.inv(A)
    slow = jnp.sqrt(jnp.abs(slow).sum(0).max() * jnp.abs(slow).sum(1).max())
    g = jnp.sqrt(fast / slow)
    return jnp.where(jnp.isfinite(g) & (g > 0), g, jnp.where(fast > 0, fast, 1.0))


def _solve_refined(A: jax.Array, Q: jax.Array, discrete: bool) -> jax.Array:
    """Solve by doubling, with one step of iterative refinement."""

    def solve(Q: jax.Array) -> jax.Array:
        if discrete:
            return _sum_by_doubling(A, Q)
        g = cayley_shift(A)
        F, inverse = cayley(A, g)
        return _sum_by_doubling(F, 2 * g * product(product(inverse, Q), inverse.T))

    def refine(_, X):  # a loop of two steps, to compile the program once
        return X + solve(Q - _left_side(discrete, A, X))

    return jax.lax.fori_loop(0, 2, refine, jnp.zeros_like(Q))


def _by_kronecker(A: jax.Array, Q: jax.Array, discrete: bool) -> jax.Array:
    n = A.shape[0]
    one = jnp.eye(n, dtype=A.dtype)
    if discrete:
        M = jnp.eye(n * n, dtype=A.dtype) - jnp.kron(A, A)
    else:
        M = -(jnp.kron(A, one) + jnp.kron(one, A))
    return jnp.linalg.solve(M, Q.ravel()).reshape(n, n)
