"""Lyapunov equations beside SciPy."""

import functools

import jax
import numpy as np
import pytest
import scipy.linalg

from rbjax.control import LinearStatus
from rbjax.control.linear import lyapunov
from rbjax.errors import InputError
from tests.composing import check_composes
from tests.tolerances import relative_error

RNG = np.random.default_rng(0)
N = 5
CONTRACTION = RNG.normal(size=(N, N)) / np.sqrt(N)
CONTRACTION *= 0.95 / np.abs(np.linalg.eigvals(CONTRACTION)).max()
DECAY = RNG.normal(size=(N, N))
DECAY -= (np.linalg.eigvals(DECAY).real.max() + 0.2) * np.eye(N)
Q = RNG.normal(size=(N, N))


def scipys(A, Q, discrete):
    if discrete:
        return scipy.linalg.solve_discrete_lyapunov(A, Q, method="direct")
    return scipy.linalg.solve_continuous_lyapunov(A, -Q)


@pytest.mark.parametrize("method", ["doubling", "kronecker"])
@pytest.mark.filterwarnings("ignore:(?i).*ill-conditioned matrix")  # of SciPy's Kronecker form
@pytest.mark.parametrize("discrete", [False, True])
def test_stable_matrices_beside_scipy(method, discrete):
    scales = np.array([1.0, 1e3, 1e-3, 1.0, 10.0])
    first = CONTRACTION if discrete else DECAY
    for A in (first, first * scales[:, None] / scales):  # the second badly scaled
        found = lyapunov(A, Q, discrete=discrete, method=method)
        assert found.status == LinearStatus.success and found.residual < 2e-15
        assert relative_error(found.X, scipys(A, Q, discrete)) < (1e-12 if A is first else 1e-10)


@pytest.mark.filterwarnings("ignore:An ill-conditioned matrix")
@pytest.mark.parametrize("discrete", [False, True])
def test_on_the_edge_and_beyond(discrete):
    edge = np.diag([1.0, 0.5, 0.1, 0.2, 0.3]) if discrete else np.diag([0.0, -1, -2, -3, -4])
    near = edge + 1e-9 * np.diag([-1.0, 0, 0, 0, 0])
    for A, stable in ((edge, False), (edge * 1.5 + 0.2, False), (near, True)):
        if not stable:
            with pytest.raises(InputError, match="not stable"):
                lyapunov(A, np.eye(N), discrete=discrete)
        found = jax.jit(functools.partial(lyapunov, discrete=discrete))(A, np.eye(N))
        assert bool(found.status == LinearStatus.success) == stable
        assert bool(found.status == LinearStatus.not_stable) != stable
        assert np.isfinite(found.X).all()
    assert relative_error(found.X, scipys(near, np.eye(N), discrete)) < 1e-6  # condition 1e9
    # of a matrix that is not stable the Kronecker form knows the solution
    A = DECAY + 4 * np.eye(N)
    found = lyapunov(A, Q, discrete=discrete, method="kronecker")
    assert relative_error(found.X, scipys(A, Q, discrete)) < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("discrete", [False, True])
def test_composes(discrete):
    A = CONTRACTION if discrete else DECAY
    xs = [np.stack([A, 0.9 * A, 0.8 * A]), np.stack([Q, Q.T, Q + Q.T])]
    check_composes(lambda A, Q: lyapunov(A, Q, discrete=discrete).X, xs)
