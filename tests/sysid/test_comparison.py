"""Held-out verdicts, and the comparison of nested models by their rates of error."""

import numpy as np
import pytest

from rbjax.sysid.statistics import Scored, compare, held_out, whiteness

RNG = np.random.default_rng(0)
RUNS = {f"run {k}": RNG.normal(size=(200, 2)) for k in range(6)}


def half(first, factor=1.0):
    return {n: factor * r for k, (n, r) in enumerate(RUNS.items()) if (k < 3) == first}


@pytest.mark.parametrize(
    ("factor", "holds", "words"),
    [(1.0, True, "holds"), (1.6, False, "is weaker"), (5.0, False, "fails")],
)
def test_verdicts(factor, holds, words):
    # errors of 1 in a motion of 10 are R2 = 0.99, which is the least that holds; of 30 0.999
    measured = {n: r + 30 * RNG.normal(size=r.shape) for n, r in half(False, factor).items()}
    found = held_out(half(True), half(False, factor), measured=measured, noise=1.0, unit="mrad")
    rms = np.sqrt(np.mean(np.concatenate(list(half(False, factor).values())) ** 2))
    assert abs(found.rms / rms - 1) < 1e-14
    assert found.success is holds and found.summary().startswith(
        f"the model {words}: on 3 recordings"
    )
    assert ("lacks something" in found.summary()) == (factor == 5.0)
    left = sum(np.sum(r**2) for r in half(False, factor).values())
    there = sum(np.sum((y - y.mean(0)) ** 2) for y in measured.values())
    assert abs(found.r_squared - (1 - left / there)) < 1e-14
    assert max(found.by_recording, key=found.by_recording.get) in found.summary()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"measured": 1.0}, "R2 is"),
        ({"noise": 0.5}, "times the noise, above"),
        ({"slow": True}, "not white"),
    ],
)
def test_each_check_that_fails_is_named(change, said):
    unseen = half(False)
    measured = {
        n: r + change.get("measured", 30.0) * RNG.normal(size=r.shape) for n, r in unseen.items()
    }
    if "slow" in change:
        unseen = {n: np.cumsum(r, 0) / 10 for n, r in unseen.items()}
    found = held_out(half(True), unseen, measured=measured, noise=change.get("noise", 1.0))
    assert not found.success and said in found.summary() and any(said in f for f in found.failed)
    assert not found.summary().startswith("the model holds")


def test_samples_that_did_not_arrive_do_not_count():
    holed = {n: np.where(r > 1, np.nan, r) for n, r in half(False).items()}
    kept = {n: r[r <= 1] for n, r in half(False).items()}
    assert abs(held_out(half(True), holed).rms - held_out(half(True), kept).rms) < 1e-15


def experiment(rng, slope, noise=None, samples=200):
    t = np.linspace(-1, 1, samples)
    y = 1 + slope * t + (rng.normal(size=samples) if noise is None else noise)
    squares = [float(np.sum((y - np.polyval(np.polyfit(t, y, d), t)) ** 2)) for d in (0, 1)]
    return Scored("constant", squares[0], 1), Scored("line", squares[1], 2), y - y.mean()


def test_a_term_that_is_not_there_is_seldom_taken():
    """By chance in at most 1 % of cases; a term of 4 standard deviations in nearly all."""
    rng = np.random.default_rng(1)
    taken = np.mean([compare(*experiment(rng, 0.0)[:2], 200).significant for _ in range(400)])
    assert taken <= 0.0275  # 1 % and 3.5 standard deviations of 400 draws
    sigma = np.sqrt(3 / 200)
    found = np.mean([compare(*experiment(rng, 5 * sigma)[:2], 200).significant for _ in range(200)])
    assert found > 0.95


def test_numbers_by_hand():
    found = compare(Scored("a", 20.0, 2), Scored("b", 10.0, 4), 34)
    assert abs(found.F / 15 - 1) < 1e-14  # (10/2) / (10/30)
    assert found.p_value == pytest.approx((1 + 2 * 15 / 30) ** -15, rel=1e-12)  # F with 2 and 30
    assert found.aic == pytest.approx(4 - 34 * np.log(2), rel=1e-14)
    assert found.bic == pytest.approx(2 * np.log(34) - 34 * np.log(2), rel=1e-14)
    assert found.significant and "b is needed in place of a: F = 15, p = 3e-05" in found.summary()
    same = compare(Scored("a", 10.0, 2), Scored("b", 10.0, 3), 34)
    assert not same.significant and "is not needed" in same.summary() and same.F == 0


def test_correlated_residuals_need_effective_samples():
    """A slow disturbance looks like a line; with the effective number of samples it does not."""
    rng = np.random.default_rng(2)
    naive = honest = 0
    for _ in range(100):
        slow = np.convolve(rng.normal(size=230), np.ones(31) / 5, "valid")
        small, large, r = experiment(rng, 0.0, slow)
        naive += compare(small, large, 200).significant
        honest += compare(small, large, max(whiteness(r).effective_samples, 3)).significant
    assert naive > 40 and honest < 10
