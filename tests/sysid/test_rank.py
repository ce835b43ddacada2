"""Ranks, groupings and sentences of Jacobians whose answer is known by construction."""

import numpy as np
import pytest

from rbjax.sysid.statistics import combinations, estimates
from rbjax.sysid.statistics.rank import project_out_others

RNG = np.random.default_rng(0)
T = np.linspace(0.0, 2.0, 40)


def test_words():
    """Two that share a column, one that never shows, one found, a small coefficient in SI units."""
    J = np.stack([np.sin(T), T, np.sin(T), 0 * T, 2e-5 * T + 0.5 * np.sin(T)], 1)
    found = combinations(J, ["link1.Izz", "mass", "joint1.armature", "bias", "link2.m"])
    assert found.rank == 2
    assert found.terms() == ("link1.Izz + joint1.armature + 0.5 link2.m", "mass + 2e-05 link2.m")
    assert found.hidden == ("bias",) and found.single == ()
    text = found.summary()
    assert text.startswith(
        "2 of 5 are identifiable: 0 by themselves and 2 as combinations; 1 have no"
    )
    due = "link1.Izz + joint1.armature + 0.5 link2.m is identifiable; none of them by itself."
    assert due in text
    assert "mass + 2e-05 link2.m is identifiable; neither by itself." in text
    assert text.endswith("Without effect: bias.")


def test_earlier_names_are_kept():
    J = np.stack([np.sin(T), T, np.sin(T) - 2 * T], 1)
    assert combinations(J, "abc").terms() == ("a + c", "b - 2 c")
    assert combinations(J[:, ::-1], "cba").terms() == ("c + a", "b + 2 a")
    preferred = combinations(J, "abc", first=["c"])
    assert preferred.kept == (0, 2) and preferred.terms() == ("a + 0.5 b", "c - 0.5 b")


def test_base_values_and_free_directions():
    """J pi = J_kept beta for all pi, and free directions change nothing, in any units."""
    n, r = 9, 5
    units = 10.0 ** RNG.uniform(-4, 4, n)
    J = RNG.normal(size=(60, r)) @ RNG.normal(size=(r, n)) * units
    found = combinations(J, [f"p{k}" for k in range(n)])
    assert found.rank == r and found.kept == (0, 1, 2, 3, 4)
    assert found.gap[0] > 1e-2 and found.gap[1] < 1e-14
    np.testing.assert_allclose(found.condition, 1 / found.gap[0])
    pi = RNG.normal(size=n) / units
    np.testing.assert_allclose(J[:, found.kept] @ found.combine(pi), J @ pi, rtol=1e-9, atol=1e-9)
    N = found.free_directions
    assert N.shape == (n, n - r) and np.linalg.matrix_rank(N / np.abs(N).max(0)) == n - r
    np.testing.assert_allclose(J @ N, 0.0, atol=1e-9 * np.abs(J).max() * np.abs(N).max())
    np.testing.assert_allclose(found.matrix @ N, 0.0, atol=1e-12 * np.abs(N).max())


def test_exact_zeros_stay_zero():
    """Parameters found by themselves do not get 1e-16 of the others."""
    J = RNG.normal(size=(50, 6))
    J[:, 5] = J[:, 0] - 3 * J[:, 2]
    found = combinations(J, "abcdef")
    assert found.single == ("b", "d", "e")
    np.testing.assert_allclose(found.K[:, 0], [1, 0, -3, 0, 0], atol=1e-12)
    assert (found.K[[1, 3, 4], 0] == 0).all()


def test_a_nearly_dependent_column_waits():
    """b is a within 1e-5; with c both are three columns of rank 2 plus a little: kept are the
    columns that stand clear, although b comes before c."""
    a, c = RNG.normal(size=(2, 30))
    b = a + 1e-7 * c
    J = np.stack([a, b, c], 1)
    found = combinations(J, "abc", tolerance=1e-9)
    assert found.rank == 2 and found.kept == (0, 2)
    np.testing.assert_allclose(found.K[:, 0], [1.0, 1e-7], rtol=1e-3)


@pytest.mark.parametrize("gap", [1e-3, 1e-6])
def test_tolerance_decides(gap):
    Q = np.linalg.qr(RNG.normal(size=(40, 3)))[0]
    J = Q @ np.array([[1.0, 1.0, 0], [0, gap, 0], [0, 0, 1.0]])
    assert combinations(J, "abc", tolerance=gap / 10).rank == 3
    assert combinations(J, "abc", tolerance=gap * 2).rank == 2


def test_more_parameters_than_measurements():
    J = RNG.normal(size=(3, 7))
    found = combinations(J, "abcdefg")
    assert found.rank == 3 and found.kept == (0, 1, 2)
    np.testing.assert_allclose(J[:, 3:], J[:, :3] @ found.K, rtol=1e-9)
    wide = combinations(J.reshape(3, 1, 7), "abcdefg")  # leading axes count measurements
    np.testing.assert_array_equal(wide.K, found.K)


def test_single_precision():
    J = RNG.normal(size=(60, 4)) @ RNG.normal(size=(4, 8))
    assert combinations(J.astype(np.float32), "abcdefgh").rank == 4


def test_nothing_moves():
    found = combinations(np.zeros((5, 2)), "ab")
    assert found.rank == 0 and found.hidden == ("a", "b") and found.terms() == ()
    assert found.summary().startswith("0 of 2 are identifiable") and found.gap == (0.0, 0.0)
    assert found.free_directions.tolist() == [[1.0, 0.0], [0.0, 1.0]]


def test_what_other_numbers_could_make_is_not_seen():
    """Of three numbers, one is hidden by a fourth, such as an initial state; a fifth moves
    nothing."""
    rng = np.random.default_rng(0)
    J = rng.normal(size=(40, 3))
    others = np.column_stack([2 * J[:, 1] + J[:, 0], np.zeros(40)])
    R = np.linalg.qr(np.column_stack([J, others, rng.normal(size=40)]), mode="r")
    assert combinations(R[:, :3], ["a", "b", "c"]).rank == 3  # if the others were known
    found = combinations(project_out_others(R, 3), ["a", "b", "c"])
    assert found.rank == 2 and found.single == ("c",)
    np.testing.assert_array_equal(project_out_others(R[:, [0, 1, 2, 5]], 3), R[:, :3])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rounding_is_no_information(dtype):
    """A third column that is the sum of two up to rounding of its dtype: rank, intervals and
    covariance agree on it."""
    J = np.random.default_rng(0).normal(size=(50, 2))
    J = np.column_stack([J, J @ [1.0, 1.0]]).astype(dtype)
    assert combinations(J, ["a", "b", "c"]).rank == 2
    said = estimates(["a", "b", "c"], np.zeros(3), J, 1.0)
    assert said.free.shape[1] == 1 and np.isinf(said.sigma).all()
