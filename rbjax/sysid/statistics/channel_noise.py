"""`noise_by_channel`: the noise of several sensors that share the parameters of one fit."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbjax.errors import InputError
from rbjax.sysid.statistics.intervals import checked_rows, decomposed, tolerance_for

ROUNDS = 100  # of the fixed point


class ChannelNoise(NamedTuple):
    """Noise of channels: standard deviation and degrees of freedom of each, by channel."""

    sigma: dict[Any, float]
    dof: dict[Any, float]

    def of(self, channels: Any) -> np.ndarray:
        """The standard deviation of each row."""
        return np.array([self.sigma[c] for c in np.asarray(channels).tolist()])


def noise_by_channel(
    residual: Any, jacobian: Any, channels: Any, *, rank_tolerance: float | None = None
) -> ChannelNoise:
    """The noise of each sensor from the residuals of one fit to all of them.

    sigma_c^2 = sum_c r^2 / (m_c - sum_c h), with h the diagonal of the hat matrix
    J (J^T S^-1 J)^-1 J^T S^-1: a parameter takes its degree of freedom from the channels that
    determine it. S depends on sigma, so this is a fixed point.

    Args:
        residual: (m,), of a fit whose weights are about 1/sigma (repeat fit and this twice).
        jacobian: (m, n).
        channels: (m,), the label of each row's channel.
        rank_tolerance: as in `estimates`.

    Returns:
        `ChannelNoise`.

    Raises:
        InputError: wrong shapes; a channel whose samples the parameters fit exactly.

    Source: the expectation of r_c^T r_c, as in Seber & Lee, *Linear Regression Analysis*, 3.3.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid import noise_by_channel
        >>> r, J = np.array([1.0, -1.0, 2.0, -2.0, 2.0]), np.array([[1.0], [1], [0], [0], [0]])
        >>> found = noise_by_channel(r, J, ["a", "a", "b", "b", "b"])
        >>> round(found.sigma["a"], 4), round(found.sigma["b"], 4), found.dof["b"]
        (1.4142, 2.0, 3.0)
    """
    rank_tolerance = tolerance_for(jacobian) if rank_tolerance is None else rank_tolerance
    J = checked_rows("noise_by_channel", "jacobian", jacobian, 2)
    r = checked_rows("noise_by_channel", "residual", residual, 1, len(J))
    labels, row = np.unique(np.asarray(channels), return_inverse=True)
    if row.shape != r.shape:
        raise InputError(
            f"noise_by_channel: channels has shape {row.shape}, expected {r.shape}, a label a row"
        )
    squares, count = np.bincount(row, r**2), np.bincount(row)
    sigma = np.sqrt(squares / count)
    for _ in range(ROUNDS):
        sigma = np.maximum(sigma, 1e-150 + 1e-12 * sigma.max())
        weighted = J / sigma[row][:, None]
        lengths, s, V, _ = decomposed(weighted, rank_tolerance)
        leverage = np.sum((weighted / lengths @ (V / s)) ** 2, 1)
        dof = count - np.bincount(row, leverage)
        if (dof < 1e-6 * count).any():
            c = labels[dof.argmin()]
            raise InputError(
                f"noise_by_channel: the parameters fit the {count[dof.argmin()]} samples of "
                f"channel {c} exactly, so its noise cannot be seen; expected more samples"
            )
        before, sigma = sigma, np.sqrt(squares / dof)
        if np.abs(sigma - before).max() <= 1e-12 * sigma.max():
            break
    keys = labels.tolist()
    return ChannelNoise(
        dict(zip(keys, sigma.tolist(), strict=True)), dict(zip(keys, dof.tolist(), strict=True))
    )
