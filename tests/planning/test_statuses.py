"""Every status of every search, in f32 and in f64, and what comes with it."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import planning as p
from rbjax.errors import InputError

DTYPES = [jnp.float64, jnp.float32]
CAR = p.Controls.car(radius=0.5, turn=np.deg2rad(20.0), reversal=2)
DISC = p.Footprint.disc(0.15)
A, B = [1.0, 1.0, 0.0], [2.4, 1.0, 0.0]


def grid(dtype: type, wall: int = 0) -> p.OccupancyGrid:
    cells = np.zeros((34, 20), bool)
    cells[17, :wall] = True
    return p.OccupancyGrid(cells, jnp.asarray(0.1, dtype), jnp.zeros(2, dtype))


def many(*args: object, **options: object) -> p.Plan:
    g, footprint, start, goal, controls = args
    (plan,) = p.grid_dijkstra_many(g, footprint, [start], [goal], controls, **options)  # type: ignore[arg-type]
    return plan


SEARCHES: dict[str, Callable] = {
    "hybrid_a_star": p.hybrid_a_star,
    "grid_a_star": p.grid_a_star,
    "grid_dijkstra": p.grid_dijkstra,
    "many": many,
}
CASES = {
    "found": (0, A, B, {}),
    "no path": (20, A, B, {}),
    "start in collision": (20, [1.75, 1.0, 0.0], B, {}),
    "goal in collision": (20, A, [1.75, 1.0, 0.0], {}),
    "count exhausted": (13, A, B, {"max_count": 1}),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "name",
    [x if x != "many" else pytest.param(x, marks=pytest.mark.slow) for x in SEARCHES],
)
def test_every_status(name: str, dtype: type) -> None:
    loose = {} if name == "hybrid_a_star" else {"tolerance": (0.2, 0.4)}
    for status, (wall, start, goal, options) in CASES.items():
        given = options | loose | {"headings": 36}
        plan = SEARCHES[name](grid(dtype, wall), DISC, start, goal, CAR, **given)
        assert plan.status == status
        assert plan.found == (status == "found") == bool(len(plan.poses))
        assert (plan.cost is not None) == plan.found
        if plan.found:
            np.testing.assert_allclose(plan.poses[-1, :2], B[:2], rtol=0, atol=0.21)
    same = SEARCHES[name](grid(dtype), DISC, A, A, CAR, **loose, headings=36)
    assert same.found


@pytest.mark.parametrize("dtype", DTYPES)
def test_plan_hands_every_status_on(dtype: type) -> None:
    for status, (wall, start, goal, options) in CASES.items():
        given = {"radius": 0.5, "smoothed": False} | options
        assert p.plan(grid(dtype, wall), DISC, start, goal, **given).status == status


def test_sizes_that_no_machine_holds_are_refused() -> None:
    with pytest.raises(InputError, match="take a larger cell"):
        p.hybrid_a_star(grid(jnp.float64), DISC, A, B, CAR, headings=36, cell=1e-9)
    with pytest.raises(InputError, match="take a larger spacing"):
        p.Path([0, 0, 0], [[1e3, 0, 0]]).split(1e-9)
