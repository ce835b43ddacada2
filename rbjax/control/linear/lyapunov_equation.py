"""Lyapunov equations, by doubling.

    discrete    X = A X A' + Q = sum of A^k Q A'^k
    continuous  A X + X A' + Q = 0,   X = integral of exp(At) Q exp(A't)

Smith's doubling adds as many terms again at each turn, X <- X + A X A', A <- A^2, so a stable A
takes log2 of its memory in steps. A continuous equation becomes a discrete one by Cayley's map with
a pace g > 0: F = (g - A)^-1 (g + A) and Q <- 2 g (g - A)^-1 Q (g - A)^-T have the same X. One
turn of refinement by the residual follows. A norm of a power of A below one proves stability; no
eigenvalues are needed, so it runs wherever products and linear systems do.

For a matrix that is not stable, the Kronecker form (1 - A x A) vec X = vec Q still has a solution
where no two eigenvalues are each other's inverse (or negative). It takes n^6 operations.
Source: Smith, SIAM J. Applied Math. 16, 1968; Golub & Van Loan, *Matrix Computations*, 7.6.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import flag
from rbjax.compiling import compiled
from rbjax.control.products import product
from rbjax.control.status import LinearStatus, first_of, raise_failure
from rbjax.dynamics.arguments import check_array, shape_of
from rbjax.errors import InputError, UnknownName

#: squarings that resolve a spectral radius of 1 - 1e-15
SQUARINGS = 56
METHODS = ("doubling", "kronecker")


class Lyapunov(NamedTuple):
    """The solution of a Lyapunov equation.

    X: (n, n), symmetric if Q is.
    residual: (), the largest entry of the residual over that of the terms of the equation.
    status: a `LinearStatus`.
    """

    X: jax.Array
    residual: jax.Array
    status: Any

    @property
    def success(self) -> jax.Array:
        """Whether there is a solution."""
        return self.status == LinearStatus.success


def lyapunov(A: Any, Q: Any, *, discrete: bool = False, method: str = "doubling") -> Lyapunov:
    """The solution of A X + X A' + Q = 0, or of A X A' - X + Q = 0 in discrete time.

    Args:
        A: (n, n).
        Q: (n, n), symmetric or not.
        discrete: which of the two.
        method: "doubling", for stable A; "kronecker", for any A for which there is one solution,
            with (n^2, n^2) linear systems.

    Returns:
        `Lyapunov`. By doubling, if A is not stable, the status is `not_stable` in traced code and
        X is 0.

    Raises:
        InputError: shapes, values that are not finite; outside of traced code also if there is no
            solution. UnknownName: the method.

    Differentiable in A and Q in both modes, by the implicit function theorem.

    Source: Smith 1968; Bartels & Stewart 1972 (the problem).

    Example:
        >>> from rbjax.control.linear import lyapunov
        >>> float(lyapunov([[-2.0]], [[4.0]]).X[0, 0])
        1.0
    """
    A = _square("lyapunov", "A", A)
    Q = check_array("lyapunov", "Q", Q, A.shape)
    dtype = jnp.result_type(A, Q)
    A, Q = A.astype(dtype), Q.astype(dtype)
    if method not in METHODS:
        raise UnknownName("method of lyapunov", method, METHODS)
    found = _lyapunov(A, Q, flag("lyapunov", "discrete", discrete), method)
    raise_failure("lyapunov", found.status)
    return found


@functools.partial(compiled, static_argnums=(2, 3))
def _lyapunov(A: jax.Array, Q: jax.Array, discrete: bool, method: str) -> Lyapunov:
    dtype = A.dtype
    left = stein_left if discrete else lyapunov_left
    if method == "kronecker":
        X, stable = _by_kronecker(A, Q, discrete), jnp.asarray(True)
    else:
        X, stable = (stein if discrete else continuous)(A, Q)
    finite = jnp.isfinite(X).all()
    X = jnp.where(finite & stable, X, 0.0)
    size = (
        jnp.abs(Q).max()
        + jnp.abs(left(A, X)).max()
        + jnp.abs(X).max() * (1 if discrete else jnp.abs(A).max())
    )
    off = jnp.abs(left(A, X) - Q).max() / jnp.maximum(size, jnp.finfo(dtype).tiny)
    status = first_of(
        (~stable, LinearStatus.not_stable), (~finite, LinearStatus.not_finite)
    )
    return Lyapunov(X, off, status)


def _square(where: str, name: str, value: Any) -> jax.Array:
    shape = shape_of(where, name, value)
    if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
        hint = "; for a batch use jax.vmap" if len(shape) == 3 else ""
        raise InputError(f"{where}: {name} has shape {shape}, expected (n, n){hint}")
    return check_array(where, name, value, shape)


def stein_left(A: jax.Array, X: jax.Array) -> jax.Array:
    """X - A X A'."""
    return X - product(product(A, X), A.T)


def lyapunov_left(A: jax.Array, X: jax.Array) -> jax.Array:
    """-(A X + X A')."""
    return -(product(A, X) + product(X, A.T))


def stein(A: jax.Array, Q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """X of X = A X A' + Q, and whether A is stable."""
    stable = is_stable(A)
    safe = jnp.where(stable, A, 0.0)
    X = jax.lax.custom_linear_solve(
        lambda X: stein_left(safe, X), Q,
        lambda _, Q: _refined(safe, Q, _doubled, stein_left),
        lambda _, Q: _refined(safe.T, Q, _doubled, stein_left),
    )  # fmt: skip
    return X, stable


def continuous(A: jax.Array, Q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """X of A X + X A' + Q = 0, and whether A is stable."""
    g = pace(A)
    stable = is_stable(cayley(A, g)[0])
    safe = jnp.where(stable, A, -jnp.eye(A.shape[0], dtype=A.dtype))
    X = jax.lax.custom_linear_solve(
        lambda X: lyapunov_left(safe, X), Q,
        lambda _, Q: _refined(safe, Q, _by_cayley, lyapunov_left),
        lambda _, Q: _refined(safe.T, Q, _by_cayley, lyapunov_left),
    )  # fmt: skip
    return X, stable


def is_stable(A: jax.Array, squarings: int = SQUARINGS) -> jax.Array:
    """Whether all eigenvalues are within the unit circle: some power has a norm below one."""

    def going(carry):
        A, k, stable = carry
        return (k < squarings) & ~stable & jnp.isfinite(A).all()

    def turn(carry):
        A, k, _ = carry
        A = product(A, A)
        return A, k + 1, jnp.abs(A).sum(-1).max() < 1

    A = jax.lax.stop_gradient(A)
    first = jnp.abs(A).sum(-1).max() < 1
    return jax.lax.while_loop(going, turn, (A, 0, first))[2]


def _doubled(A: jax.Array, Q: jax.Array) -> jax.Array:
    """The sum of A^k Q A'^k."""
    eps = jnp.finfo(A.dtype).eps

    def going(carry):
        _, X, term, k = carry
        return (k < SQUARINGS) & (term > eps * jnp.abs(X).max() / 8)

    def turn(carry):
        A, X, _, k = carry
        more = product(product(A, X), A.T)
        return product(A, A), X + more, jnp.abs(more).max(), k + 1

    return jax.lax.while_loop(going, turn, (A, Q, jnp.asarray(jnp.inf, A.dtype), 0))[1]


def _by_cayley(A: jax.Array, Q: jax.Array) -> jax.Array:
    g = pace(A)
    F, inverse = cayley(A, g)
    return _doubled(F, 2 * g * product(product(inverse, Q), inverse.T))


def cayley(A: jax.Array, g: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(g - A)^-1 (g + A) and (g - A)^-1."""
    one = jnp.eye(A.shape[0], dtype=A.dtype)
    inverse = jnp.linalg.inv(g * one - A)
    return product(inverse, g * one + A), inverse


def pace(A: jax.Array) -> jax.Array:
    """The geometric mean of the fastest and the slowest rate, by norms of A and of its inverse.

    Any pace above zero is right; this one takes the fewest turns where both are known."""
    fast = jnp.sqrt(jnp.abs(A).sum(0).max() * jnp.abs(A).sum(1).max())
    slow = jnp.linalg.inv(A)
    slow = jnp.sqrt(jnp.abs(slow).sum(0).max() * jnp.abs(slow).sum(1).max())
    g = jnp.sqrt(fast / slow)
    return jnp.where(jnp.isfinite(g) & (g > 0), g, jnp.where(fast > 0, fast, 1.0))


def _refined(A: jax.Array, Q: jax.Array, solve: Any, left: Any) -> jax.Array:
    def turn(_, X):  # twice the same program
        return X + solve(A, Q - left(A, X))

    return jax.lax.fori_loop(0, 2, turn, jnp.zeros_like(Q))


def _by_kronecker(A: jax.Array, Q: jax.Array, discrete: bool) -> jax.Array:
    n = A.shape[0]
    one = jnp.eye(n, dtype=A.dtype)
    if discrete:
        M = jnp.eye(n * n, dtype=A.dtype) - jnp.kron(A, A)
    else:
        M = -(jnp.kron(A, one) + jnp.kron(one, A))
    return jnp.linalg.solve(M, Q.ravel()).reshape(n, n)
