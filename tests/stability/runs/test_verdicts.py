"""Verdicts on runs made by hand, one of each kind; no verdict is nan."""

import numpy as np
import pytest

import rbjax as rb
from rbjax.stability import Outcome, verdict

T = np.linspace(0.0, 10.0, 201)
TRUE = np.stack([np.cos(T), np.sin(T)], 1)
NOISE = np.random.default_rng(0).normal(size=T.shape)


def test_holds_with_its_largest_error() -> None:
    xs = TRUE.copy()
    xs[70, 1] += 3e-4
    energy = 1e-4 * np.sin(5 * T)
    found = verdict(T, xs, TRUE, invariants={"energy": energy}, manifold=1e-9 * NOISE)
    assert found.outcome is Outcome.HOLDS
    assert found.value == found.error == pytest.approx(3e-4, rel=1e-12)


def test_blows_up_at_the_first_bad_state() -> None:
    for bad in (np.nan, np.inf, -2e3):
        xs = TRUE + 1e-3
        xs[120:] = bad
        found = verdict(T, xs, TRUE)
        assert found.outcome is Outcome.BLOWS_UP
        assert found.value == T[120]
        assert found.error == pytest.approx(1e-3)  # while it was sound


def test_blows_up_from_the_first_state() -> None:
    found = verdict(T, np.full_like(TRUE, np.nan), TRUE)
    assert found == (Outcome.BLOWS_UP, 0.0, "", 0.0)


def test_a_size_is_that_of_the_motion() -> None:
    assert verdict(T, 5e3 * TRUE, 5e3 * TRUE, size=5e3).outcome is Outcome.HOLDS
    assert verdict(T, 5e3 * TRUE, 5e3 * TRUE).outcome is Outcome.BLOWS_UP


@pytest.mark.parametrize("ending", [Outcome.NO_ROOT, Outcome.OUT_OF_STEPS, Outcome.BLOWS_UP])
def test_what_the_solver_says_of_its_end(ending: Outcome) -> None:
    xs = np.where(T[:, None] <= 4.0, TRUE + 1e-5, 77.0)  # what comes after the end is not judged
    found = verdict(T, xs, TRUE, ending=ending, reached=4.01)
    assert found.outcome is ending
    assert found.value == 4.01
    assert found.error == pytest.approx(1e-5)


def test_a_state_that_left_before_its_root_was_lost_has_blown_up() -> None:
    xs = TRUE.copy()
    xs[50:] *= 1e6
    found = verdict(T, xs, TRUE, ending=Outcome.NO_ROOT, reached=4.0)
    assert found.outcome is Outcome.BLOWS_UP and found.value == T[50]


def test_leaves_the_manifold() -> None:
    found = verdict(T, TRUE, TRUE, manifold=2e-3 * T)
    assert found == (Outcome.OFF_MANIFOLD, pytest.approx(2e-2), "", 0.0)


def test_drifts_by_the_invariant_that_does() -> None:
    energy, momentum = 1e-3 * np.sin(5 * T), -1e-2 * T + 1e-3 * np.sin(5 * T)
    found = verdict(T, TRUE, TRUE, invariants={"energy": energy, "momentum": momentum})
    assert found.outcome is Outcome.DRIFTS and found.what == "momentum"
    assert found.value == pytest.approx(-0.1, rel=0.02)


def test_a_small_trend_is_no_failure() -> None:
    assert verdict(T, TRUE, TRUE, invariants={"energy": 1e-6 * T}).outcome is Outcome.HOLDS
    found = verdict(T, TRUE, TRUE, invariants={"energy": 1e-6 * T}, tolerance=1e-6)
    assert found.outcome is Outcome.DRIFTS


def test_loses_the_motion() -> None:
    found = verdict(T, TRUE[::-1], TRUE)
    assert found.outcome is Outcome.LOST
    assert found.value == np.abs(TRUE[::-1] - TRUE).max()


def test_without_a_reference_there_is_no_error() -> None:
    found = verdict(T, TRUE[:, 0])
    assert found == (Outcome.HOLDS, 0.0, "", None)


def test_never_nan() -> None:
    """The numbers of a verdict are finite for any run."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        xs = TRUE * 10.0 ** rng.uniform(-3, 3) + rng.normal(size=TRUE.shape)
        bad = rng.choice([np.nan, np.inf, -np.inf, 1e300], size=TRUE.shape)
        xs = np.where(rng.random(TRUE.shape) < rng.choice([0, 0.001, 0.1, 1]), bad, xs)
        ending = rng.choice([None, Outcome.NO_ROOT, Outcome.OUT_OF_STEPS, Outcome.BLOWS_UP])
        found = verdict(T, xs, TRUE, ending=ending, reached=rng.uniform(0, 10))
        assert np.isfinite([found.value, found.error]).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((T[:5], TRUE), r"ts \(5,\) and xs \(201, 2\)"),
        ((T[:0], TRUE[:0]), "expected"),
        ((T * np.nan, TRUE), "times that are not finite"),
        ((T, TRUE, TRUE[:, :1]), r"reference \(201, 1\)"),
        ((T, TRUE, TRUE * np.nan), "reference that is not finite"),
    ],
)
def test_runs_that_cannot_be_judged(arguments, words: str) -> None:
    with pytest.raises(rb.InputError, match=words):
        verdict(*arguments)


def test_series_that_are_not_finite_are_refused() -> None:
    with pytest.raises(rb.InputError, match="manifold"):
        verdict(T, TRUE, TRUE, manifold=T * np.nan)
    with pytest.raises(rb.InputError, match="not finite"):
        verdict(T, TRUE, TRUE, invariants={"energy": T * np.nan})
