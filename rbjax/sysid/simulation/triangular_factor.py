"""The triangular factor of the rows [J r] of a least-squares problem."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import get_lapack_funcs

#: block size of LAPACK's QR in columns
BLOCK = 64


def triangle_of(rows: np.ndarray) -> np.ndarray:
    """Compute the QR factor R of rows [J r], or nan if an entry is not finite."""
    n = rows.shape[1]
    if not np.isfinite(rows).all():
        return np.full((n, n), np.nan, rows.dtype)
    (factorise,) = get_lapack_funcs(("geqrf",), (rows,))
    # column order and block size of LAPACK, twice as fast as `np.linalg.qr`
    columns, _, _, _ = factorise(np.array(rows, order="F"), lwork=BLOCK * n, overwrite_a=True)
    R: Any = np.triu(columns[:n])
    missing = n - R.shape[0]
    return R if missing <= 0 else np.pad(R, ((0, missing), (0, 0)))
