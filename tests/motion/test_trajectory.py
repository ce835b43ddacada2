"""What a trajectory says of itself."""

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.motion.trajectory import all_finite


def test_one_number_that_is_not_finite_spoils_its_sample() -> None:
    """Samples, times, coordinates: one entry of q or of v."""
    q, v = jnp.ones((3, 4, 2)), jnp.ones((3, 4, 2))
    states = rb.State(q.at[0, 1, 0].set(jnp.nan), v.at[2, 3, 1].set(jnp.inf))
    np.testing.assert_array_equal(all_finite(states), [False, True, False])
