"""Random linear-quadratic problems and systems."""

import jax.numpy as jnp
import numpy as np
import scipy.linalg

from rbjax.control.linear import LinearQuadratic


def random_problem(seed, N, n, m, dtype=float):
    """A convex one with gaps, slopes and products of states and controls."""
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(N + 1, n + m, n + m)) / np.sqrt(n + m)
    W = W @ W.transpose(0, 2, 1) + 0.1 * np.eye(n + m)
    A, B = rng.normal(size=(N, n, n)) / np.sqrt(n), rng.normal(size=(N, n, m))
    d, q, r = (rng.normal(size=s) for s in ((N, n), (N + 1, n), (N, m)))
    each = (A, B, d, W[:, :n, :n], q, W[:-1, n:, n:], r, W[:-1, :n, n:])
    return LinearQuadratic(*(jnp.asarray(x, dtype) for x in each))


def enlarged(A, B, Q, R):
    """With modes that decay and controls of their own, so that there are 3 states and 2 controls,
    and one program for all."""
    A, B, Q, R = (np.atleast_2d(np.asarray(x, float)) for x in (A, B, Q, R))
    n, m = 3 - A.shape[0], 2 - B.shape[1]
    more = np.zeros((n, m))
    more[:m, :m] = np.eye(m)
    block = scipy.linalg.block_diag
    A, Q, R = (block(x, y) for x, y in ((A, -0.5 * np.eye(n)), (Q, np.eye(n)), (R, np.eye(m))))
    return A, block(B, more), Q, R


def random_system(seed, n, m, scale=1.0):
    """A, B, Q, R, S with a joint cost that is positive definite."""
    rng = np.random.default_rng(seed)
    A, B = scale * rng.normal(size=(n, n)) / np.sqrt(n), rng.normal(size=(n, m))
    W = rng.normal(size=(n + m, n + m)) / np.sqrt(n + m)
    W = W @ W.T + 0.1 * np.eye(n + m)
    return A, B, W[:n, :n], W[n:, n:], W[:n, n:]
