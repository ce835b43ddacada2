"""Every status of `refine` and `smooth`, in f32 and in f64: rounding is no improvement."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.planning import (
    Footprint,
    Limits,
    OccupancyGrid,
    Path,
    Refined,
    Residuals,
    Timed,
    refine,
    smooth,
)

DTYPES = [jnp.float32, jnp.float64]
ENDS = {"distance": 0.0, "turn": 0.0, "speed": 0.0, "torque": 1.0, "rate": 0.5, "angle": 0.2,
        "clearance": 0.3, "free": True, "defect": 1e-4}  # fmt: skip


def refined(dtype, change: float, taken: int = 1, success: bool = True, **off) -> Refined:
    """A motion that takes 3 s (1 + change), after 3 s along the path."""
    start = jnp.asarray(3.0, dtype)
    residuals = Residuals(**{
        k: jnp.asarray(x) if k == "free" else jnp.asarray(x, dtype)
        for k, x in {**ENDS, **off}.items()
    })  # fmt: skip
    ts = jnp.stack([jnp.zeros((), dtype), start * jnp.asarray(1 + change, dtype)])
    motion = Timed(ts, *(jnp.zeros((2, 1), dtype) for _ in range(3)))
    return Refined(motion, residuals, start, jnp.int32(taken), jnp.asarray(success))


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_status_of_refine(dtype):
    few = 4 * float(jnp.finfo(dtype).eps)
    cases = {
        "refined": [refined(dtype, -0.2), refined(dtype, -1e-4)],
        "as it was": [
            refined(dtype, 0.0), refined(dtype, -0.2, taken=0), refined(dtype, -few),
            refined(dtype, few),
        ],
        "not converged": [
            refined(dtype, 1e-3), refined(dtype, -0.2, free=False),
            refined(dtype, -0.2, distance=0.01), refined(dtype, -0.2, torque=1.1),
            refined(dtype, -0.2, speed=np.nan), refined(dtype, np.nan),
        ],
        "infeasible": [refined(dtype, -0.2, success=False), refined(dtype, 0.5, success=False)],
    }  # fmt: skip
    for status, results in cases.items():
        assert [x.status for x in results] == [status] * len(results)


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_status_of_smooth(dtype):
    grid = OccupancyGrid(np.zeros((30, 20), bool), 0.1)
    field = jax.tree.map(lambda x: x.astype(dtype), grid.distance_field())
    start = jnp.asarray([0.7, 1.0, 0.0], dtype)
    bends = Path(start, jnp.asarray([[0.5, 0, s] for s in (0.5, -0.5, -0.5, 0.5)], dtype))
    straight = Path(start, jnp.asarray([[0.5, 0, 0]], dtype))
    disc = Footprint(jnp.zeros((1, 2), dtype), jnp.full(1, 0.1, dtype))
    for path, status in ((bends, "smoothed"), (straight, "as it was")):
        got = smooth(path.split(0.25), field, disc, 0.8, margin=0.2, iterations=12, parts=2)
        assert got.status == status and got.path.steps.dtype == dtype
        assert got.cost[1] < 0.99 * got.cost[0] or status == "as it was"


@pytest.mark.slow
@pytest.mark.parametrize("dtype", DTYPES)
def test_refine_in_each_dtype(dtype):
    """A path that goes too far and back is refined; a steep slope is infeasible."""
    kind = rb.wheeled.kinds()["differential_drive"]
    robot = jax.tree.map(
        lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x,
        kind.make(caster=None),
    )
    path = Path(jnp.zeros(3, dtype), jnp.asarray([[0.1, 0, 0]] * 10 + [[-0.1, 0, 0]] * 3, dtype))
    few = dict(intervals=12, iterations=25, parts=1)
    cart = rb.wheeled.at(robot, "reduced")
    got = refine(cart, path, Limits(0.4), **few)
    assert got.motion.time.dtype == dtype and got.status == "refined", got.residuals
    steep = rb.wheeled.at(robot.replace(slope=jnp.array([0.5, 0.0], dtype)), "reduced")
    assert refine(steep, path, Limits(0.4), **few).status == "infeasible"


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_path_is_split_in_its_dtype(dtype):
    """Steps along one curve are joined first, in f32 too."""
    path = Path(jnp.zeros(3, dtype), jnp.asarray([[0.1, 0, 0.3], [0.3, 0, 0.9]], dtype))
    parts = path.split(0.2)
    assert parts.steps.dtype == dtype and len(parts.steps) == 6  # 1.2 rad in steps of 0.2
    np.testing.assert_allclose(parts.steps, [[0.4 / 6, 0, 0.2]] * 6, rtol=1e-6)
