"""Inverses of small matrices and their derivatives, against numpy's and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from rbjax.lanes import inverse


@pytest.mark.parametrize("parts", [1, 2])
def test_inverse_and_its_derivatives(parts: int) -> None:
    given = jax.random.normal(jax.random.key(parts), (parts, 3, 4, 4))
    known = np.linalg.inv(given[0] if parts == 1 else given[0] + 1j * given[1])
    found = jax.vmap(inverse)(*given)
    for x, want in zip(found, (known.real, known.imag), strict=False):
        np.testing.assert_allclose(x, want, atol=1e-12 * abs(known).max())

    def summed(along: jax.Array) -> jax.Array:
        return jnp.stack(inverse(*along)).ravel() @ jnp.arange(parts * 16.0)

    check_grads(summed, (given[:, 0],), order=2, rtol=1e-5)
