"""Gradients at points where a distance is zero or two are equal: finite, and those of one side."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.planning import Footprint, OccupancyGrid, clearance

DTYPES = [jnp.float32, jnp.float64]


def field(dtype):
    cells = np.zeros((8, 8), bool)
    cells[6] = True
    one = OccupancyGrid(cells, 1.0).distance_field()
    return jax.tree.map(lambda x: x.astype(dtype), one)


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_lower_bound_of_a_distance_at_the_centre_of_a_cell(dtype):
    here = field(dtype)
    for point in (
        [2.5, 3.5],
        [2.5, 3.2],
        [0.5, 0.5],
    ):  # on a centre, on a line of them, at a corner
        slope = jax.jit(jax.grad(here.below))(jnp.asarray(point, dtype))
        assert slope.dtype == dtype and np.isfinite(slope).all()
    slope = jax.grad(here.below)(jnp.asarray([2.5, 3.2], dtype))
    np.testing.assert_allclose(slope, [0.0, 1.0], atol=1e-5)  # towards the centre it grows


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_reach_of_discs_at_the_origin_and_of_equal_discs(dtype):
    def reach(centers):
        return Footprint(centers, jnp.full(len(centers), 0.3, dtype)).reach

    grad = jax.grad(reach)
    np.testing.assert_array_equal(grad(jnp.zeros((1, 2), dtype)), [[0.0, 0.0]])
    slope = grad(jnp.asarray([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0]], dtype))
    assert np.isfinite(slope).all() and abs(slope).sum() == 1


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_clearance_of_two_discs_at_one_distance(dtype):
    two = Footprint(jnp.asarray([[0.0, 0.5], [0.0, -0.5]], dtype), jnp.full(2, 0.2, dtype))
    pose = jnp.asarray([4.2, 3.7, 0.0], dtype)
    slope = jax.jit(jax.grad(lambda p: clearance(field(dtype), p, two)))(pose)
    assert np.isfinite(slope).all() and slope[0] == -1
