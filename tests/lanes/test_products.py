"""Products of small matrices against numpy.linalg's, for one and for stacks of stacks."""

import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import lanes
from rbjax.lanes.arrays import matrix_transpose, outer
from rbjax.spatial.operators import along
from tests.tolerances import F64_ROUNDING, relative_error


@pytest.mark.parametrize("batch", [(), (4,), (5, 4)], ids=str)
def test_products(batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(*batch, 2, 3)), rng.normal(size=(*batch, 3, 4))
    x, n = rng.normal(size=(*batch, 3)), rng.normal(size=(*batch, 3))
    N = n[..., :, None]
    pairs = [
        (lanes.matmat(A, B), A @ B),
        (lanes.matvec(A, x), (A @ x[..., None])[..., 0]),
        (matrix_transpose(A), np.swapaxes(A, -1, -2)),
        (outer(x, n), x[..., :, None] * n[..., None, :]),
        (along(n), N @ np.swapaxes(N, -1, -2) / np.linalg.norm(N, axis=-2, keepdims=True) ** 2),
    ]
    for got, want in pairs:
        assert relative_error(got, want) <= F64_ROUNDING


def test_packed_lanes_are_the_rows() -> None:
    x = jnp.asarray(np.random.default_rng(0).normal(size=(3, 4)), jnp.float32)
    rows = lanes.unpack(x)
    for got, want in zip(rows, x, strict=True):
        np.testing.assert_array_equal(got, want)
    np.testing.assert_array_equal(lanes.pack(rows, x), x)
    with_literals = lanes.pack([0.0, rows[1], 2.0], x)
    assert with_literals.dtype == x.dtype
    np.testing.assert_array_equal(with_literals, jnp.stack([0 * x[0], x[1], jnp.full(4, 2.0)]))
    assert lanes.pack([], x).shape == (0, 4)
