"""Smoother paths: same ends and gears, bounded curvature, free, cheaper; for one and for many."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.planning import Footprint, Path, clear_along, hybrid_a_star, smooth
from tests.planning.scenes import bends, driven, rectangle_hits
from tests.planning.test_hybrid_a_star import CAR, RADIUS, SCENES, SIZE, STEER


def found(scene: str, n: int = 96):
    """A path of n steps, of which the last are zeros."""
    grid, start, goal = SCENES[scene]
    path = hybrid_a_star(grid, CAR, start, goal, STEER, weight=1.2).path.split(0.12)
    rest = n - path.steps.shape[0]
    assert rest >= 0
    return grid, Path(path.start, jnp.concatenate([path.steps, jnp.zeros((rest, 3))]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [["narrow gap"], pytest.param(["parallel parking", "dead end"], marks=pytest.mark.slow)],
)
def test_better_and_as_allowed(names: list[str]) -> None:
    for name in names:
        grid, path = found(name)
        field = grid.distance_field()
        got = smooth(path, field, CAR, RADIUS)
        assert got.status == "smoothed" and got.cost[1] < 0.97 * got.cost[0]
        poses = np.asarray(got.path.poses)
        ends = np.asarray(path.poses)
        assert (poses[0] == ends[0]).all() and np.abs(poses[-1] - ends[-1]).max() < 1e-11
        assert (np.asarray(got.path.gears) == np.asarray(path.gears)).all()
        assert bends(got.path) * RADIUS <= 1 + 1e-12
        assert not rectangle_hits(grid, driven(got.path, 10), **SIZE)
        assert bool(clear_along(field, got.path, CAR, 4))


def test_as_it_was() -> None:
    """A start within the obstacles' margin of error: no step is clear, so nothing changes."""
    grid, path = found("narrow gap")
    wide = Footprint(CAR.centers, CAR.radii + 0.5)
    got = smooth(path, grid.distance_field(), wide, RADIUS, iterations=4)
    assert got.status == "as it was" and (got.path.steps == path.steps).all()


@pytest.mark.slow
def test_many_and_derivatives() -> None:
    """`vmap` is one after the other; the derivative by the margin against differences."""
    pairs = [found(name) for name in ("dead end", "narrow gap")]
    field = pairs[0][0].distance_field()
    paths = [p for _, p in pairs]
    many = jax.tree.map(lambda *x: jnp.stack(x), *paths)
    few = 6
    run = jax.jit(jax.vmap(lambda p: smooth(p, field, CAR, RADIUS, iterations=few)))
    got = run(many)
    for i, path in enumerate(paths):
        want = smooth(path, field, CAR, RADIUS, iterations=few)
        assert int(got.steps_taken[i]) == int(want.steps_taken)
        assert np.abs(np.asarray(got.path.steps[i] - want.path.steps)).max() < 1e-7
    f = jax.jit(lambda m: smooth(paths[0], field, CAR, RADIUS, m, iterations=3).path.steps)
    slope = jax.jit(jax.jacrev(f))(0.4)
    h = 1e-6
    want = (f(0.4 + h) - f(0.4 - h)) / (2 * h)
    assert np.isfinite(np.asarray(slope)).all()
    assert np.abs(np.asarray(slope - want)).max() < 1e-4 * (1 + np.abs(np.asarray(want)).max())


def test_paths() -> None:
    """Poses against small steps; splitting keeps the path; curvature, gears and cusps."""
    rng = np.random.default_rng(0)
    steps = rng.uniform(-1, 1, (7, 3))
    steps[2], steps[3], steps[4, 1] = 0.0, (0, 0, 0.7), 0.0
    path = Path([0.3, -0.2, 1.0], steps)
    assert np.abs(driven(path, 4000)[::4000] - np.asarray(path.poses)).max() < 1e-7
    fine = path.split(0.1)
    size = np.asarray(fine.steps)
    assert np.hypot(size[:, 0], size[:, 1]).max() <= 0.1 and np.abs(size[:, 2]).max() <= 0.1
    assert np.abs(np.asarray(fine.poses[-1] - path.poses[-1])).max() < 1e-12
    assert float(fine.length) == pytest.approx(float(path.length), rel=1e-12)
    arcs = Path(np.zeros(3), [[1, 0, 0.5], [0, 0, 0], [-2, 0, 0.5], [-1, 0, 0], [0, 0, -1]])
    assert arcs.curvatures.tolist() == [0.5, 0, -0.25, 0, -math.inf]
    assert arcs.gears.tolist() == [1, 0, -1, -1, 0] and int(arcs.cusps) == 1
    assert len(arcs.split(9.0).steps) == 4 and len(fine.split(9.0).steps) == 6
    slope = jax.jit(jax.grad(lambda s: Path(jnp.zeros(3), s).length))(arcs.steps)
    assert np.isfinite(np.asarray(slope)).all()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Path([0.0, 0.0], np.zeros((2, 3))), ["(2,) and (2, 3)", "(..., n, 3)"]),
        (lambda: Path(np.zeros(3), np.zeros((2, 3))).split(0), ["spacing is 0"]),
        (lambda: smooth(None, None, None, 1.0), ["path is None", "Path"]),
    ],
    ids=range(3),
)
def test_wrong_arguments(call, words: list[str]) -> None:
    with pytest.raises(rb.InputError) as caught:
        call()
    for word in words:
        assert word in str(caught.value)
