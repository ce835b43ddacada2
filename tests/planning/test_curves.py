"""Dubins' and Reeds and Shepp's curves: where they end, how long they are, that none is shorter.

The oracle of the slow test knows no formula: it minimises the length over sequences of arcs and
straights numerically.
"""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import rbjax as rb
from rbjax.planning import Path, dubins, reeds_shepp
from rbjax.planning.paths import words
from tests.tolerances import GRADIENT

END = 1e-12  # relative to distances of a few radii: rounding of a few arcs
BOTH = pytest.mark.parametrize("shortest", [dubins, reeds_shepp])


def pairs(n: int, size: float = 4.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(7)
    start, goal = rng.uniform(-size, size, (2, n, 3))
    return start, goal, rng.uniform(0.3, 2.0, n)


def apart(got, want) -> float:
    """The largest deviation of poses; headings are compared as directions."""
    got, want = np.asarray(got), np.asarray(want)
    turn = np.abs(np.exp(1j * (got[..., 2] - want[..., 2])) - 1)
    return max(np.abs(got[..., :2] - want[..., :2]).max(), turn.max())


@BOTH
def test_curves_end_at_the_goal(shortest) -> None:
    start, goal, radius = pairs(2000)
    curve = shortest(start, goal, radius)
    assert apart(curve.end, goal) <= END
    assert np.allclose(curve.length, np.abs(curve.steps[..., 0]).sum(-1), rtol=1e-14)
    assert (np.asarray(curve.length) >= np.hypot(*(goal - start)[:, :2].T) * (1 - 1e-14)).all()


@pytest.mark.parametrize(
    ("table", "wrap"),
    [(words.DUBINS, words.forwards), (words.REEDS_SHEPP, words.either_way)],
    ids=["Dubins", "Reeds-Shepp"],
)
def test_every_word_ends_at_the_goal(table, wrap) -> None:
    """Not only the best: each candidate that exists is an admissible path."""
    goal = pairs(500)[1]
    find = jax.jit(lambda x, y, phi: words.candidates(table, wrap, x, y, phi))
    lengths, turns, exists = find(*goal.T)
    steps = jnp.stack([lengths, 0 * lengths, turns * lengths], -1)
    curves = Path(jnp.zeros((*lengths.shape[:-1], 3)), steps)
    exists = np.asarray(exists)
    assert exists.any(0).all()
    ends = np.broadcast_to(goal[:, None], (*exists.shape, 3))
    assert apart(np.asarray(curves.end)[exists], ends[exists]) <= END
    arcs = np.asarray(lengths)[:, np.asarray(turns) != 0]
    least, most = (0.0, 2 * math.pi) if wrap is words.forwards else (-math.pi, math.pi)
    assert arcs.min() >= least and arcs.max() <= most + 1e-14


def test_the_48_words() -> None:
    """Signs and kinds that Reeds and Shepp list (their table 1), as candidates with their signs.

    A reflection and a change of direction are 4 each: C|C|C 4, CC|C 4, C|CC 4, CSC 8, CCu|CuC 4,
    C|CuCu|C 4, C|C(pi/2)SC 8, CSC(pi/2)|C 8, C|C(pi/2)SC(pi/2)|C 4.
    """
    listed = set()
    for signs, kinds in (
        ("+-+", "LRL"), ("++-", "LRL"), ("+--", "LRL"), ("+++", "LSL"), ("+++", "LSR"),
        ("++--", "LRLR"), ("+--+", "LRLR"), ("+---", "LRSL"), ("+---", "LRSR"),
        ("+++-", "LSLR"), ("+++-", "LSRL"), ("+---+", "LRSLR"),
    ):  # fmt: skip
        for flip, mirror in itertools.product((False, True), repeat=2):
            s = signs.translate(str.maketrans("+-", "-+")) if flip else signs
            k = kinds.translate(str.maketrans("LR", "RL")) if mirror else kinds
            listed.add("".join(a + b for a, b in zip(k, s, strict=True)))
    assert len(listed) == 48
    best = jax.tree.map(np.asarray, reeds_shepp(*pairs(3000, 2.5)))
    found = {jax.tree.map(lambda x, i=i: x[i], best).word for i in range(3000)}
    assert found <= listed, found - listed
    assert len(found) >= 40  # the others are best in small sets


@pytest.mark.parametrize(
    ("goal", "forwards", "both"),
    [
        ((0, 0, math.pi), 7 * math.pi / 3, math.pi),  # arcs of pi/3, 5 pi/3, pi/3; three of pi/3
        ((5, 0, 0), 5.0, 5.0),
        ((-5, 0, 0), None, 5.0),
        ((0, 2, math.pi), math.pi, math.pi),
        ((2, 2, 0), math.pi, math.pi),
        ((0, 6, math.pi), math.pi + 4, None),
        ((4, 4, math.pi / 2), math.pi / 2 + math.hypot(3, 3), math.pi / 2 + math.hypot(3, 3)),
        ((0, 0, 0), 0.0, 0.0),
    ],
)
def test_known_lengths(goal, forwards, both) -> None:
    """Lengths that follow from elementary geometry, for unit radius."""
    start = np.zeros(3)
    for shortest, want in ((dubins, forwards), (reeds_shepp, both)):
        if want is not None:
            got = float(shortest(start, np.asarray(goal, float), 1.0).length)
            assert got == pytest.approx(want, abs=1e-12)


def test_a_distance() -> None:
    """Reeds-Shepp is symmetric, obeys the triangle inequality, and never exceeds Dubins."""
    a, b, _ = pairs(1500)
    c = np.roll(b, 1, 0)
    ab, bc, ac = (np.asarray(reeds_shepp(*p, 0.7).length) for p in ((a, b), (b, c), (a, c)))
    assert np.allclose(ab, reeds_shepp(b, a, 0.7).length, rtol=0, atol=END)
    assert (ac <= ab + bc + END).all()
    forwards = [np.asarray(dubins(*p, 0.7).length) for p in ((a, b), (b, c), (a, c))]
    assert (ab <= forwards[0] + END).all()
    assert (forwards[2] <= forwards[0] + forwards[1] + END).all()
    half = np.array([0, 0, math.pi])
    turned = a + half, b + half  # backwards along the same curve
    assert np.allclose(forwards[0], dubins(*turned[::-1], 0.7).length, atol=END)


def test_scale_and_frame_do_not_matter() -> None:
    start, goal, radius = pairs(300)
    turn, shift = 1.1, np.array([3.0, -2.0])
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def moved(pose: np.ndarray) -> np.ndarray:
        return np.column_stack([2.5 * (pose[:, :2] @ R.T) + shift, pose[:, 2] + turn + 4 * np.pi])

    want = 2.5 * np.asarray(reeds_shepp(start, goal, radius).length)
    got = reeds_shepp(moved(start), moved(goal), 2.5 * radius).length
    assert np.allclose(got, want, rtol=1e-12)


@BOTH
def test_poses_along_a_curve(shortest) -> None:
    """Neighbours are as far apart as driven, along the heading, on arcs of the radius."""
    start, goal, radius = pairs(30)
    curve = shortest(start, goal, radius)
    n = 1001
    path = np.asarray(curve.sample_poses(n))
    assert apart(path[:, 0], start) == 0 and apart(path[:, -1], goal) <= END
    step = np.diff(path[..., :2], axis=1)
    ds = np.asarray(curve.length)[:, None] / (n - 1)
    middle = (path[:, 1:, 2] + path[:, :-1, 2]) / 2
    along = (step * np.stack([np.cos(middle), np.sin(middle)], -1)).sum(-1)
    regular = np.abs(np.abs(along) - ds) < 1e-3 * ds  # no change of segment within
    assert regular.sum() >= regular.size - 4 * len(path)
    bend = np.abs(np.diff(path[..., 2], axis=1)) * radius[:, None]
    assert (bend <= ds * (1 + 1e-9)).all()
    if shortest is dubins:
        assert (along > 0).all()


@BOTH
def test_gradients(shortest) -> None:
    """By start, goal and radius against central differences; finite where formulas degenerate."""
    corners = np.array([[0, 0, 0], [4, 0, 0], [0, 2, 0], [0, 2, np.pi], [2, 2, 0], [0, 0, np.pi]])
    start, goal, radius = pairs(30)
    flat = np.column_stack([start, goal, radius])
    flat = np.vstack([flat, np.column_stack([0 * corners, corners, np.ones(len(corners))])])

    def lengths(flat):
        return shortest(flat[..., :3], flat[..., 3:6], flat[..., 6]).length

    slope = np.asarray(jax.jit(jax.grad(lambda flat: lengths(flat).sum()))(flat))
    assert np.isfinite(slope).all()
    h = 6e-6
    step = h * np.concatenate([np.eye(7), -np.eye(7)])
    ends = np.asarray(lengths(flat[:30, None] + step))
    want = (ends[:, :7] - ends[:, 7:]) / (2 * h)
    off = np.abs(slope[:30] - want) > 10 * GRADIENT * np.maximum(1, np.abs(want))
    assert off.any(1).sum() <= 1  # a pair next to where the best word changes


def test_transformations_and_dtypes() -> None:
    start, goal, radius = pairs(20)
    want = reeds_shepp(start, goal, radius)
    mapped = jax.jit(jax.vmap(reeds_shepp))(start, goal, radius)
    assert np.allclose(mapped.length, want.length, rtol=1e-13)
    single = reeds_shepp(*(x.astype(np.float32) for x in (start, goal, radius)))
    assert single.length.dtype == single.end.dtype == jnp.float32
    assert np.allclose(single.length, want.length, rtol=3e-5)
    assert apart(single.end, goal) <= 2e-5
    table = jax.eval_shape(reeds_shepp, start[:, None], goal[None, :3], np.ones(()))
    assert table.start.shape == (20, 3, 3) and table.steps.shape == (20, 3, 5, 3)
    assert jax.eval_shape(lambda c: c.sample_poses(4), table).shape == (20, 3, 4, 3)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: dubins([0, 0], [1, 1, 0], 1.0), ["dubins: start", "(2,)", "(..., 3)"]),
        (lambda: reeds_shepp([0, 0, 0], [1, np.nan, 0], 1.0), ["goal[1] is nan", "finite"]),
        (lambda: reeds_shepp([0, 0, 0], [1, 1, 0], 0.0), ["radius is 0.0", "zero"]),
        (lambda: dubins(*pairs(2)).word, ["Path.word", "(2,)"]),
        (
            lambda: dubins([0, 0, 0], [1, 1, 0], 1.0).sample_poses(1),
            ["sample_poses: n is 1", "at least 2"],
        ),
    ],
    ids=range(5),
)
def test_wrong_arguments(call, words: list[str]) -> None:
    with pytest.raises(rb.InputError) as caught:
        call()
    for word in words:
        assert word in str(caught.value)


# ------------------------------------------------------------- the shortest of all, by search


def driven(kinds: str, lengths: np.ndarray) -> np.ndarray:
    """The end of segments of a car of unit radius from the origin, by elementary geometry."""
    x = y = heading = 0.0
    for kind, s in zip(kinds, lengths, strict=True):
        if kind == "S":
            x, y = x + s * math.cos(heading), y + s * math.sin(heading)
            continue
        side = 1 if kind == "L" else -1
        after = heading + side * s
        x += side * (math.sin(after) - math.sin(heading))
        y -= side * (math.cos(after) - math.cos(heading))
        heading = after
    return np.array([x, y, heading])


def searched(goal: np.ndarray, backwards: bool, rng: np.random.Generator, tries: int) -> float:
    """The least length over all sequences of five segments, by sequential quadratic programs."""
    best = math.inf
    for kinds in map("".join, itertools.product("LSR", repeat=5)):
        if any(a == b for a, b in itertools.pairwise(kinds)):
            continue
        for _ in range(tries):
            first = rng.uniform(0, 2, 10 if backwards else 5)

            def lengths(z: np.ndarray) -> np.ndarray:
                return z[:5] - z[5:] if backwards else z

            def gap(z: np.ndarray, kinds: str = kinds) -> np.ndarray:
                end = driven(kinds, lengths(z))
                turn = goal[2] - end[2]
                return np.array([*(end[:2] - goal[:2]), math.remainder(turn, 2 * math.pi)])

            found = minimize(
                np.sum, first, jac=np.ones_like, method="SLSQP", bounds=[(0, 7)] * len(first),
                constraints={"type": "eq", "fun": gap}, options={"maxiter": 60, "ftol": 1e-9},
            )  # fmt: skip
            if np.abs(gap(found.x)).max() < 1e-7:
                best = min(best, float(np.abs(lengths(found.x)).sum()))
    return best


@pytest.mark.slow
@pytest.mark.parametrize("shortest", [dubins, reeds_shepp])
def test_no_sequence_is_shorter(shortest) -> None:
    rng = np.random.default_rng(5)
    for goal in rng.uniform(-2.5, 2.5, (4, 3)):
        want = searched(goal, shortest is reeds_shepp, rng, 6)
        assert float(shortest(np.zeros(3), goal, 1.0).length) == pytest.approx(want, abs=1e-5)
