"""Sparse factorization of matrices that are not symmetric."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.lanes import lu
from tests.tolerances import F64_IDENTITY

PARENTS = (-1, 0, 1, 0, 3, -1, 5)


def tree_matrix(seed: int) -> np.ndarray:
    """A matrix with the pattern of a tree, whose symmetric part is positive definite."""
    n, rng = len(PARENTS), np.random.default_rng(seed)
    A = np.zeros((n, n))
    for i in range(n):
        j = i
        while j != -1:
            A[i, j], A[j, i] = rng.normal(size=2)
            j = PARENTS[j]
    symmetric = (A + A.T) / 2
    return A + (1.0 - np.linalg.eigvalsh(symmetric)[0]) * np.eye(n)


def lanes(A):
    """The entries of A, with its zeros as literals."""
    return [
        [A[i, j] if tree_matrix(0)[i, j] else 0.0 for j in range(len(PARENTS))]
        for i in range(len(PARENTS))
    ]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_it_solves(seed: int) -> None:
    A, b = tree_matrix(seed), np.random.default_rng(seed + 9).normal(size=len(PARENTS))

    def solve(A, b):
        return jnp.stack(lu(lanes(A)).solve(list(b)))

    found = jax.jit(solve)(A, b)
    assert np.abs(A @ found - b).max() < F64_IDENTITY


def test_one_dof_and_a_literal_matrix() -> None:
    assert lu([[4.0]]).solve([2.0]) == [0.5]
    A = tree_matrix(3)
    found = np.array(lu(A.tolist()).solve([1.0] * len(A)))
    assert np.abs(A @ found - 1.0).max() < F64_IDENTITY
