"""Repetitions of an experiment: intervals that hold, scatter that the covariance foretells."""

import dataclasses
import functools

import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import Channel, Identified, Recording, Status, Unknown, identify, monte_carlo


@functools.cache
def swung(loss: str = "squares", noise: float = 1e-3) -> Identified:
    model, t = rb.load("pendulum"), np.arange(81) * 0.02
    start = rb.State(np.ones(1), np.zeros(1))
    path = rb.rollout(model, start, None, 0.02, steps=80, integrator="rk4")
    off = noise * np.random.default_rng(0).normal(size=path.q.shape)
    run = Recording("swing", {"q": Channel(t, path.q + off)})
    return identify(
        model, run, {"drag": Unknown("joints.damping", 0)}, estimate_initial_state=True, loss=loss
    )


@pytest.mark.slow
def test_intervals_hold_and_the_scatter_is_the_one_foretold() -> None:
    found = swung()
    again = monte_carlo(found, 100, level=0.9)
    assert again.names == ("drag",) and again.identifiable.all() and not again.failed
    assert abs(again.coverage - 0.9) < 3 * np.sqrt(0.9 * 0.1 / 100)
    assert again.by_name == {"drag": again.coverage}
    foretold = found.estimates.interval("drag").sigma
    np.testing.assert_allclose(again.scatter, foretold, rtol=3 / np.sqrt(2 * 100))
    near = np.abs(again.sigma / foretold - 1) < 0.3
    assert near.mean() > 0.94  # one in a hundred is coloured by chance, and has the sandwich form
    bias = again.values.mean(0) - again.truth
    assert abs(bias) < 4 * foretold / np.sqrt(100)


@pytest.mark.slow
def test_noise_of_attitudes_leaves_unit_quaternions() -> None:
    model, t = rb.load("free_body"), np.arange(31) * 0.02
    start = rb.State(model.default_state().q, np.array([0.1, 0, 0.2, 1.0, 2.0, 3.0]))
    path = rb.rollout(model, start, None, 0.02, steps=30, integrator="rk4")
    spin = {"inertia": Unknown("bodies.inertia", (0, 0, 0), positive=True)}
    channels = {
        "q": Channel(t, path.q, noise=np.full(7, 1e-3)),
        "v": Channel(t, path.v, noise=np.full(6, 1e-2)),
    }
    again = monte_carlo(identify(model, Recording("thrown", channels), spin), 5)
    assert not again.failed and (again.values > 0).all()
    off = np.abs(again.values - again.truth) / again.sigma
    assert 0.01 < off.max() < 4


@pytest.mark.slow
def test_outliers_are_drawn_with_the_residuals_of_a_robust_fit() -> None:
    again = monte_carlo(swung("huber"), 30)
    assert not again.failed and 0.8 < again.coverage <= 1.0


def test_it_repeats_the_fit_of_the_user(monkeypatch) -> None:
    """From the first guess and with the options of the fit, not from the numbers that it found;
    recordings differ in their noise only."""
    from rbjax.sysid.judgement import repeated_fits

    found, asked = swung(), []

    def fitted(setup, sought, runs, how, **more):
        asked.append((setup, runs, how))
        return found

    monkeypatch.setattr(repeated_fits, "fit_in_stages", fitted)
    again = monte_carlo(found, 3)
    assert len(asked) == 3 and again.failed == 0
    for setup, runs, how in asked:
        assert setup.model.joints.damping[0] == found.guess["drag"] != found.values["drag"]
        assert how == found.options._replace(grid=found.grid)
        off = runs[0]["q"].values - found.traces["swing"]["q"].simulated
        assert 0.5e-3 < off.std() < 2e-3
    first, second = (asked[k][1][0]["q"].values for k in (0, 1))
    assert np.abs(first - second).max() > 1e-4


def test_a_fit_without_noise_is_not_repeated():
    with pytest.raises(rb.InputError, match="no noise"):
        monte_carlo(swung(noise=0.0))


@pytest.mark.parametrize(("ok", "good"), [(True, True), (True, False), (False, False)])
def test_repetitions_that_fail_are_counted(monkeypatch, ok, good) -> None:
    """And those whose verdict is good."""
    from rbjax.sysid.judgement import repeated_fits

    found = swung()
    verdict = dataclasses.replace(found.verdict, failed=() if good else ("R2",))
    one = dataclasses.replace(found, status=Status.of(ok), verdict=verdict)
    monkeypatch.setattr(repeated_fits, "fit_in_stages", lambda *x, **more: one)
    again = monte_carlo(found, 3)
    assert again.failed == 3 * (not ok) and again.good == 3 * good
    assert again.coverage == 1.0 and again.inside.shape == (3, 1)
