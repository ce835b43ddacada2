"""The covariance of a robust regression of few samples, in closed form."""

import numpy as np

from rbjax.sysid.torque import regress


def test_it_is_hubers():
    """sigma^2 mean psi^2 / (mean psi')^2 (X'X)^-1, of noise with a known deviation and outliers."""
    t = np.linspace(0.0, 1.0, 6)
    W = np.stack([np.ones(6), t], 1)
    tau = W @ [1.0, 2.0] + 0.1 * np.array([0.5, -0.4, 30.0, 0.3, -0.6, 0.2])
    found = regress(W[:, None], tau[:, None], ["a", "b"], method="robust", noise=0.1)
    u = (tau - W @ found.beta) / 0.1
    psi, slope = np.clip(u, -1.345, 1.345), np.abs(u) <= 1.345
    assert slope.sum() == 5
    due = 0.1**2 * (psi**2).mean() / slope.mean() ** 2 * np.linalg.inv(W.T @ W)
    np.testing.assert_allclose(found.covariance, due, rtol=1e-9)
