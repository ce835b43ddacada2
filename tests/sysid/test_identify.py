"""`identify` on simulated recordings whose truth is known."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.problems import GO2, ORACLES, arm, quadruped
from rbjax.sysid import Channel, Recording, Unknown, identify
from rbjax.sysid.parameters import pseudo_inertia_of

MODEL = rb.load("pendulum")
MASS = Unknown("bodies.mass", 0, positive=True)
DAMPING = Unknown("joints.damping", 0, positive=True)
T = 0.01


def seen(seed=0, noise=0.0, count=150, damping=0.13, mass=1.4):
    """A recording of a heavier and more damped pendulum, its joint read with noise."""
    rng = np.random.default_rng(seed)
    model = MODEL.replace(
        bodies=MODEL.bodies.replace(mass=jnp.array([mass])),
        joints=MODEL.joints.replace(damping=jnp.array([damping])),
    )
    t = np.arange(count + 1) * T
    ctrl = 3 * np.sin(2.0 * t[:-1] + seed)[:, None]
    start = rb.State(jnp.array([0.3]), jnp.array([0.2]))
    path = rb.rollout(model, start, ctrl, T, integrator="rk4", kernel=False)
    q = np.asarray(path.q) + noise * rng.normal(size=(count + 1, 1))
    return Recording(f"run {seed}", {
        "q": Channel(t, q), "v": Channel(t, path.v), "ctrl": Channel(t[:-1], ctrl),
    })  # fmt: skip


GUESS = MODEL.replace(joints=MODEL.joints.replace(damping=jnp.array([0.02])))


def test_noise_free_recordings_give_the_numbers():
    runs = [seen(0), seen(1, count=90)]
    found = identify(GUESS, runs, {"mass": MASS, "damping": DAMPING})
    assert found.success and found.identifiable.single == ("mass", "damping")
    np.testing.assert_allclose([*found.values.values()], [1.4, 0.13], rtol=1e-9)
    np.testing.assert_allclose(found.model.bodies.mass, [1.4], rtol=1e-9)
    verdict = found.validate([seen(2)])
    assert verdict.rms < 1e-8


@pytest.mark.slow
def test_noise_is_estimated_and_intervals_are_those_of_the_slopes():
    """Three recordings, positions only, starts sought; sigma of the mass by an independent
    Jacobian."""
    noise = 2e-3
    runs = [seen(k, noise) for k in range(3)]
    runs = [Recording(r.name, {s: r[s] for s in ("q", "ctrl")}) for r in runs]
    found = identify(GUESS, runs, {"mass": MASS, "damping": DAMPING}, estimate_initial_state=True)
    assert found.success
    np.testing.assert_allclose(found.rms["q"], [noise], rtol=0.15)
    for name, truth in (("mass", 1.4), ("damping", 0.13)):
        interval = found.estimates.interval(name)
        assert abs(interval.value - truth) < 4 * interval.sigma
    h = 1e-4
    a, b = ([np.asarray(r["q"].values)[:, 0] for r in (seen(k, mass=1.4 + d) for k in range(3))]
            for d in (h, -h))  # fmt: skip
    slope = (np.concatenate(a) - np.concatenate(b)) / (2 * h)
    least = noise / np.linalg.norm(slope)  # were all else known
    assert least < found.estimates.interval("mass").sigma < 10 * least
    unseen = seen(7, noise)  # its first sample is noisy, so its start is sought, too
    unseen = Recording(unseen.name, {s: unseen[s] for s in ("q", "ctrl")})
    assert 0.8 < found.validate([unseen]).ratio < 1.25


@pytest.mark.parametrize(
    ("q", "error"),
    [
        (Channel([0, 0.1, 0.2], [np.nan, 1, 2], dropped="nan"), "first sample of q .* did not"),
        (Channel([0, 0.1, 0.2], np.ones((3, 2))), "has 2 columns"),
    ],
)
def test_recordings_that_cannot_be_simulated_are_named(q, error):
    with pytest.raises(rb.InputError, match=error):
        identify(GUESS, Recording("x", {"q": q}), {"mass": MASS})


@pytest.mark.slow
def test_outliers_count_less_with_huber():
    run = seen(0, 1e-3)
    q = np.array(run["q"].values)
    q[8::17] += 0.8
    bad = Recording("outliers", {"q": Channel(run["q"].t, q, noise=[1e-3]), "ctrl": run["ctrl"]})
    model = GUESS.replace(joints=GUESS.joints.replace(damping=jnp.array([0.1])))
    plain, robust = (
        identify(
            model, bad, {"mass": MASS, "damping": DAMPING}, estimate_initial_state=True, loss=loss
        )
        for loss in ("squares", "huber")
    )
    off = [abs(f.values["mass"] - 1.4) for f in (plain, robust)]
    assert off[1] < 0.01 and off[1] < off[0] / 5


@pytest.mark.slow
def test_short_pieces_find_a_motion_that_a_long_one_loses():
    model = GUESS.replace(bodies=GUESS.bodies.replace(mass=jnp.array([40.0])))
    found = identify(model, seen(0, count=400), {"mass": MASS}, segments=0.2, max_evaluations=60)
    assert found.success or found.values["mass"] > 0
    truth = identify(GUESS, seen(0, count=400), {"mass": MASS})
    np.testing.assert_allclose(found.values["mass"], truth.values["mass"], rtol=1e-3)


def test_an_unknown_without_effect_is_named():
    still = {"friction": Unknown("joints.springref", 0)}
    with pytest.raises(rb.InputError, match=r"friction .* moves nothing"):
        identify(GUESS, seen(0, count=20), still)


@pytest.mark.slow
def test_fifty_five_numbers_of_an_arm():
    """All that can be found is; the rest leaves bodies possible."""
    setup, run, unknowns, truth, how = arm()
    found = identify(setup, run, unknowns, **how)
    p = np.array([*found.values.values()])
    assert found.success and found.identifiable.rank == 32
    np.testing.assert_allclose(
        found.identifiable.combine(p), found.identifiable.combine(truth), atol=1e-9
    )
    assert {f"armature[{k}]" for k in (2, 3, 4)} <= set(found.identifiable.single)
    hidden = json.loads((ORACLES / "arm5.json").read_text())["never_show"]
    assert set(found.identifiable.hidden) == {f"{link}.{k}" for link, k in hidden}
    assert found.identifiable.term(0).startswith("armature[0] + link1.Izz")
    for k in range(5, 55, 10):
        assert np.linalg.eigvalsh(pseudo_inertia_of(p[k : k + 10])).min() > 0


@pytest.mark.slow
@pytest.mark.skipif(not GO2.exists(), reason=f"{GO2} is not there")
def test_forty_nine_numbers_of_a_quadruped():
    """Friction, bias and delay from noisy angles: as near as the noise allows (the bound of Cramer
    and Rao), and intervals that hold."""
    setup, run, unknowns, truth, how = quadruped()
    found = identify(setup, run, unknowns, **how)
    assert found.success and found.identifiable.rank == 49
    off = np.abs(np.array([*found.values.values()]) - truth) / found.estimates.sigma
    assert off.max() < 4 and 42 <= (off < 1.96).sum() <= 49
    np.testing.assert_allclose(found.rms["q"], 5e-4, rtol=0.03)
    least = {"armature[0]": 1.430e-5, "viscous[2]": 1.584e-4, "coulomb[1]": 4.988e-4,
             "bias[0]": 1.540e-4, "delay": 9.509e-7}  # fmt: skip
    for name, sigma in least.items():
        np.testing.assert_allclose(found.estimates.interval(name).sigma, sigma, rtol=0.06)


def test_recordings_that_are_constant_are_fitted():
    """Their roughness is zero, by which no error can be divided."""
    t, rest = np.arange(51) * 0.01, np.zeros((51, 1))
    run = Recording("rest", {"q": Channel(t, rest + 0.1), "ctrl": Channel(t[:-1], rest[:-1])})
    found = identify(rb.load("pendulum"), run, {"mass": Unknown("bodies.mass", 0)}, restarts=0)
    assert np.isfinite(float(found.values["mass"]))
