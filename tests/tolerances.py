"""Tolerances and their reasons. All are relative errors, as `relative_error` measures them."""

import numpy as np
from numpy.typing import ArrayLike

# A handful of operations on numbers of order one: a few dozen units in the last place (2.2e-16).
F64_ROUNDING = 1e-14

# One program run two ways (jit and eager, vmap and a loop): XLA may reorder sums and fuse
# multiply-adds, which a recursion over some thirty joints amplifies.
F64_TRANSFORM = 1e-12

# Two roads to one quantity inside rbjax (M = d tau/d a, ABA after RNEA, a jvp and its vjp):
# rounding times the condition number of the mass matrix, up to about 1e4 for our robots.
F64_IDENTITY = 1e-11

# Another engine's answer in f64. Measured against MuJoCo C: 5e-16 (7 joints) to 6e-12 (35), and
# 5e-14 for the forces that act, of springs, actuators and fluids: sums of few terms, with no
# condition number to magnify what is rounded.
F64_PARITY = 1e-10

# f32 against f64 MuJoCo C over random states. Measured for humanoid (23 velocities): median 4e-7,
# worst 5e-6; the margin is for longer trees. TF32 would show up as 1e-3.
F32_MEDIAN = 5e-6
F32_MAX = 1e-4

# A derivative against central differences in f64 with a step near 6e-6, the cube root of the
# rounding unit: truncation 4e-11 and rounding 4e-11, each times a higher derivative or a condition
# number of up to about 1e3.
GRADIENT = 1e-7


def relative_error(
    actual: ArrayLike, expected: ArrayLike, *, batch_dims: int = 0, floor: float = 1e-3
) -> np.ndarray:
    """Largest deviation of a sample over the largest entry of what was expected of it.

    max|actual - expected| / max(floor, max|expected|), one number a sample: the first `batch_dims`
    axes count samples, the others belong to one. Entry by entry would punish an entry that is
    zero by cancellation; a norm over the whole batch would hide one bad sample behind large ones.
    A sample smaller than `floor` (SI units) is measured as though it were that large, since around
    an exact zero only the absolute error means anything. A nan anywhere gives nan, which no
    comparison passes.

    >>> float(relative_error([1.0, 2.0], [1.0, 2.5]))
    0.2
    >>> relative_error([[1.0], [2.0]], [[1.0], [4.0]], batch_dims=1).tolist()
    [0.0, 0.5]
    """
    a, b = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    if a.shape != b.shape:  # broadcasting would compare what was never meant to be compared
        raise ValueError(f"shapes differ: got {a.shape}, expected {b.shape}")
    axes = tuple(range(batch_dims, a.ndim))
    deviation = np.max(np.abs(a - b), axis=axes, initial=0.0)
    return deviation / np.maximum(floor, np.max(np.abs(b), axis=axes, initial=0.0))
