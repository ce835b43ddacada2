"""Distances against a search over all cells and SciPy's transform; footprints against points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

import rbjax as rb
from rbjax.planning import DistanceField, Footprint, OccupancyGrid, clear, clearance
from tests.tolerances import F64_ROUNDING

H, ORIGIN = 0.25, np.array([-1.0, 2.0])


def cluttered(shape: tuple[int, int] = (23, 17), share: float = 0.15, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape) < share


def from_squares(cells: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distances of points, in cells, from the nearest of all squares of a set."""
    off = np.abs(points[:, None] - (np.argwhere(cells) + 0.5)) - 0.5
    return np.sqrt((np.maximum(off, 0.0) ** 2).sum(-1)).min(1)


def exact(cells: np.ndarray, points: np.ndarray, closed: bool = True, rim: int = 10) -> np.ndarray:
    """The signed distance in m of points in m; what is beyond the map is a wide rim of cells."""
    wide = np.pad(cells, rim, constant_values=closed)
    at = (points - ORIGIN) / H + rim
    return H * (from_squares(wide, at) - from_squares(~wide, at))


@pytest.mark.parametrize("closed", [True, False])
def test_exact_at_centres(closed: bool) -> None:
    cells = cluttered()
    grid = OccupancyGrid(cells, H, ORIGIN)
    field = grid.distance_field(closed=closed)
    places = np.argwhere(np.ones(cells.shape, bool))
    want = exact(cells, np.asarray(grid.center(places)), closed)
    got = np.asarray(field.values)[1:-1, 1:-1].ravel()
    assert np.abs(got - want).max() <= F64_ROUNDING
    assert np.abs(np.asarray(field.at(grid.center(places))) - want).max() <= F64_ROUNDING


def test_against_scipy() -> None:
    """Points of squares nearest to a centre lie on a lattice of half cells, as do the centres."""
    cells = cluttered((60, 45), 0.05, seed=3)
    fine = np.zeros((2 * 60 + 1, 2 * 45 + 1), bool)
    for a in range(3):
        for b in range(3):
            fine[a : a + 119 : 2, b : b + 89 : 2] |= cells
    want = H * ndimage.distance_transform_edt(~fine)[1::2, 1::2] / 2
    field = OccupancyGrid(cells, H).distance_field(closed=False)
    got = np.asarray(field.values)[1:-1, 1:-1]
    assert np.abs(np.maximum(got, 0) - want).max() <= F64_ROUNDING * want.max()


@pytest.mark.parametrize("closed", [True, False])
def test_bounds_everywhere(closed: bool) -> None:
    cells = cluttered(share=0.08)
    field = OccupancyGrid(cells, H, ORIGIN).distance_field(closed=closed)
    size = H * np.array(cells.shape)
    points = ORIGIN + np.random.default_rng(1).uniform(-0.3, 1.3, (800, 2)) * size
    want = exact(cells, points, closed)
    at, below = np.asarray(field.at(points)), np.asarray(field.below(points))
    assert (below <= want + 1e-12).all()
    within = ((points > ORIGIN) & (points < ORIGIN + size)).all(1)
    assert np.abs(at - want)[within].max() <= H / np.sqrt(2)
    assert (want - below)[within].max() <= H * np.sqrt(2)
    assert (at <= want + H / np.sqrt(2)).all()


def test_maps_of_one_kind() -> None:
    """No obstacle, or nothing else: distances are finite, with the right sign."""
    for full in (False, True):
        for closed in (False, True):
            values = OccupancyGrid(np.full((4, 3), full), H).distance_field(closed).values
            assert np.isfinite(values).all()
            inner = np.asarray(values)[1:-1, 1:-1]
            assert (inner < 0).all() if full else (inner > 0).all()


def test_footprints_cover_outlines() -> None:
    rng = np.random.default_rng(2)
    car = Footprint.rectangle(ahead=1.0, behind=0.4, width=0.7, discs=3)
    inside = rng.uniform([-0.4, -0.35], [1.0, 0.35], (2000, 2))
    corners = np.array([[0, 0], [1, 0], [1, 1], [0.6, 1], [0.6, 0.3], [0, 0.3]])  # an L
    excess = 0.11
    ell = Footprint.polygon(corners, excess)
    points = rng.uniform(0, 1, (4000, 2))
    points = points[(points[:, 1] < 0.3) | (points[:, 0] > 0.6)]

    def short(footprint: Footprint, points: np.ndarray) -> np.ndarray:
        off = points[:, None] - np.asarray(footprint.centers)
        return (np.hypot(off[..., 0], off[..., 1]) - np.asarray(footprint.radii)).min(1)

    assert short(car, np.vstack([inside, [[1.0, 0.35], [-0.4, -0.35]]])).max() <= 1e-12
    assert short(ell, np.vstack([points, corners])).max() <= 1e-12
    around = rng.uniform(-0.5, 1.5, (6000, 2))
    boxes = ((0, 0, 1, 0.3), (0.6, 0, 1, 1))
    away = np.min([np.hypot(*(around - np.clip(around, b[:2], b[2:])).T) for b in boxes], axis=0)
    assert (short(ell, around)[away > excess] > 0).all()
    assert float(car.reach) == pytest.approx(np.hypot(1.4 / 3, 0.7) / 2 + 1.0 - 0.7 / 3)


def test_clear_is_certain() -> None:
    """No point of a rectangle that is clear is in an obstacle; what is not clear is near one."""
    cells = cluttered((40, 40), 0.04, seed=5)
    grid = OccupancyGrid(cells, H, ORIGIN)
    field = grid.distance_field()
    car = Footprint.rectangle(ahead=0.8, behind=0.3, width=0.5, discs=4)
    rng = np.random.default_rng(6)
    poses = np.column_stack([ORIGIN + rng.uniform(0, 10, (800, 2)), rng.uniform(-9, 9, 800)])
    free = np.asarray(clear(field, poses, car))
    assert 0.1 < free.mean() < 0.9
    x, y = np.meshgrid(np.linspace(-0.3, 0.8, 23), np.linspace(-0.25, 0.25, 11))
    c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    points = np.stack([c * x.ravel() - s * y.ravel(), s * x.ravel() + c * y.ravel()], -1)
    points += poses[:, None, :2]
    i, j = np.moveaxis(np.asarray(grid.cell(points)), -1, 0)
    beyond = (i < 0) | (j < 0) | (i >= 40) | (j >= 40)
    hit = (beyond | cells[i.clip(0, 39), j.clip(0, 39)]).any(1)
    assert not (free & hit).any()
    margin = np.asarray(clearance(field, poses, car))
    assert (margin[~free] <= H * (np.sqrt(2) + np.sqrt(0.5))).all()
    assert (margin[free] > -H / np.sqrt(2)).all()


def test_gradients_and_transformations() -> None:
    field = OccupancyGrid(cluttered(share=0.05), H, ORIGIN).distance_field()
    car = Footprint.rectangle(ahead=0.6, behind=0.2, width=0.4)
    rng = np.random.default_rng(8)
    poses = np.column_stack([ORIGIN + rng.uniform(-1, 5, (40, 2)), rng.uniform(-3, 3, 40)])

    def total(poses: jax.Array) -> jax.Array:
        return clearance(field, poses, car).sum()

    slope = np.asarray(jax.jit(jax.grad(total))(poses))
    assert np.isfinite(slope).all() and (np.hypot(slope[:, 0], slope[:, 1]) < 1.5).all()
    h, wrong = 1e-7, 0
    for k in range(3):
        step = h * np.eye(3)[k]
        ends = [np.asarray(clearance(field, poses + sign * step, car)) for sign in (1, -1)]
        wrong += (np.abs((ends[0] - ends[1]) / (2 * h) - slope[:, k]) > 1e-6).sum()
    assert wrong <= 2  # where another disc or another cell takes over
    mapped = jax.jit(jax.vmap(lambda pose: clear(field, pose, car)))(poses)
    assert (np.asarray(mapped) == np.asarray(clear(field, poses, car))).all()
    single = jax.tree.map(lambda x: x.astype(np.float32), (field, car))
    got = clearance(single[0], poses.astype(np.float32), single[1])
    assert got.dtype == jnp.float32
    assert np.abs(got - np.asarray(clearance(field, poses, car))).max() < 1e-5


def test_many_maps_at_once() -> None:
    maps = np.stack([cluttered((9, 7), seed=seed) for seed in range(3)])

    def values(cells: jax.Array) -> jax.Array:
        return OccupancyGrid(cells, jnp.asarray(H)).distance_field().values

    mapped = jax.jit(jax.vmap(values))(maps)
    assert np.array_equal(mapped[1], values(maps[1]))


EMPTY = np.zeros((3, 4), bool)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: OccupancyGrid(np.zeros((3, 4)), 0.1), ["occupied", "float64", "bool"]),
        (lambda: OccupancyGrid(np.zeros(3, bool), 0.1), ["(3,)", "(nx, ny)"]),
        (lambda: OccupancyGrid(EMPTY, 0.0), ["resolution", "got 0.0", "above zero"]),
        (lambda: OccupancyGrid(EMPTY, 0.1, [0.0]), ["origin", "(1,)", "(2,)"]),
        (lambda: Footprint(np.zeros((2, 2)), np.ones(3)), ["(2, 2)", "(3,)", "(n, 2)"]),
        (lambda: Footprint.disc(-1), ["disc: radius is -1", "above zero"]),
        (lambda: Footprint.rectangle(1, 0, 1, discs=0), ["discs is 0", "an integer of at least 1"]),
        (lambda: Footprint.polygon([[0, 0], [1, 1]], 0.1), ["(2, 2)", "n >= 3"]),
        (
            lambda: clear(OccupancyGrid(EMPTY, 0.1), np.zeros(3), Footprint.disc(1)),
            ["clear: field is of type OccupancyGrid", "distance_field()"],
        ),
        (
            lambda: clearance(
                OccupancyGrid(EMPTY, 0.1).distance_field(), np.zeros(2), Footprint.disc(1)
            ),
            ["clearance: poses", "(2,)", "(..., 3)"],
        ),
        (
            lambda: clearance(OccupancyGrid(EMPTY, 0.1).distance_field(), np.zeros(3), None),
            ["clearance: footprint is None", "Footprint.rectangle"],
        ),
    ],
    ids=range(11),
)
def test_wrong_arguments(call, words: list[str]) -> None:
    with pytest.raises(rb.InputError) as caught:
        call()
    for word in words:
        assert word in str(caught.value)


def test_a_field_is_a_pytree() -> None:
    field = OccupancyGrid(EMPTY, 0.1).distance_field()
    assert isinstance(jax.tree.map(lambda x: x, field), DistanceField)
    assert len(jax.tree.leaves(field)) == 3


def test_a_known_map_computes_its_field_once() -> None:
    """Also within a trace, without a tracer in it; a changed map computes its own."""
    walls = np.zeros((6, 5), bool)
    walls[3, 2] = True
    grid = OccupancyGrid(walls, 0.1)
    point = jnp.array([0.12, 0.2])
    inside = jax.jit(lambda x: grid.distance_field().at(x))(point)
    field = grid.distance_field()
    assert field is grid.distance_field() and not isinstance(field.values, jax.core.Tracer)
    np.testing.assert_allclose(inside, field.at(point), rtol=1e-6)
    assert float(grid.replace(resolution=0.2).distance_field().resolution) == pytest.approx(0.2)
