"""`identify` on simulated recordings whose truth is known."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import (
    Channel,
    Grid,
    Inertia,
    Recording,
    Setup,
    Unknown,
    from_log_cholesky,
    identify,
    inertial_parameters_of,
    pseudo_inertia_of,
    to_log_cholesky,
)
from rbjax.sysid.simulation import motion
from rbjax.sysid.unknowns import Unknowns

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
    assert found.ok and found.found.found == ("mass", "damping")
    np.testing.assert_allclose([*found.values.values()], [1.4, 0.13], rtol=1e-9)
    np.testing.assert_allclose(found.model.bodies.mass, [1.4], rtol=1e-9)
    verdict = found.on([seen(2)])
    assert verdict.rms < 1e-8


def test_noise_is_estimated_and_intervals_are_those_of_the_slopes():
    """Three recordings, positions alone, starts sought; sigma of the mass by an independent
    Jacobian."""
    noise = 2e-3
    runs = [seen(k, noise) for k in range(3)]
    runs = [Recording(r.name, {s: r[s] for s in ("q", "ctrl")}) for r in runs]
    found = identify(GUESS, runs, {"mass": MASS, "damping": DAMPING}, starts=True)
    assert found.ok
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
    assert "holds" in found.on([seen(7)]).sentence


@pytest.mark.slow
def test_outliers_count_less_with_huber():
    run = seen(0, 1e-3)
    q = np.array(run["q"].values)
    q[8::17] += 0.8
    bad = Recording("outliers", {"q": Channel(run["q"].t, q, noise=[1e-3]), "ctrl": run["ctrl"]})
    model = GUESS.replace(joints=GUESS.joints.replace(damping=jnp.array([0.1])))
    plain, robust = (
        identify(model, bad, {"mass": MASS, "damping": DAMPING}, starts=True, loss=loss)
        for loss in ("squares", "huber")
    )
    off = [abs(f.values["mass"] - 1.4) for f in (plain, robust)]
    assert off[1] < 0.01 and off[1] < off[0] / 5


@pytest.mark.slow
def test_short_pieces_find_a_motion_that_a_long_one_loses():
    model = GUESS.replace(bodies=GUESS.bodies.replace(mass=jnp.array([40.0])))
    found = identify(model, seen(0, count=400), {"mass": MASS}, pieces=0.2, steps=60)
    assert found.ok or found.values["mass"] > 0
    truth = identify(GUESS, seen(0, count=400), {"mass": MASS})
    np.testing.assert_allclose(found.values["mass"], truth.values["mass"], rtol=1e-3)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"unknowns": {"friction": Unknown("joints.springref", 0)}}, "friction .* moves nothing"),
        ({"unknowns": {}}, "expected a dict"),
        ({"recordings": []}, "expected one Recording"),
        ({"loss": "cubes"}, 'expected "squares" or "huber"'),
        ({"steps": 0}, "steps"),
        ({"recordings": Recording("v", {"v": Channel([0, 0.1, 0.2], [0.0, 1, 2])})}, "expected q"),
    ],
)
def test_bad_arguments_are_named(change, error):
    given = {"recordings": seen(0, count=20), "unknowns": {"mass": MASS}} | change
    with pytest.raises(rb.InputError, match=error):
        identify(GUESS, **given)


@pytest.mark.slow
def test_fifty_five_numbers_of_an_arm():
    """The arm of MuJoCo's own test: five armatures from a fiftieth of their value, five bodies off
    by a tenth: all that can be found is, the rest keeps a body possible."""
    given = json.loads((Path(__file__).parents[1] / "oracles" / "arm5.json").read_text())
    with pytest.warns(UserWarning, match="joint limits"):
        model = rb.load(given["mjcf"])
    T, N = 0.002, 999
    t = np.arange(N + 1) * T
    ctrl = np.array([5, 4, 3, 2, 1.0]) * np.sin(
        2 * np.pi * np.array([0.5, 0.7, 0.4, 0.9, 0.6]) * t[:-1, None] + np.arange(5) / 2
    )
    grid, setup = Grid(T, 1, "dop853"), Setup.of(model)
    path = motion(lambda p: setup, jnp.zeros(1), model.default_state(), jnp.asarray(ctrl), grid)
    for k, state in given["exact_for_held_controls"].items():
        np.testing.assert_allclose([*path.q[int(k)], *path.v[int(k)]], state, atol=1e-11)
    unknowns = {"armature": Unknown("joints.armature", positive=True)}
    unknowns |= {f"link{k + 1}": Inertia(f"link{k + 1}") for k in range(5)}
    of = Unknowns.of("test", unknowns, setup)
    truth = np.asarray(of.read(setup))
    guess, rng = truth.copy(), np.random.default_rng(0)
    guess[:5] = 0.01
    for k in range(5, 55, 10):
        theta = to_log_cholesky(pseudo_inertia_of(truth[k : k + 10])) + 0.1 * rng.normal(size=10)
        guess[k : k + 10] = inertial_parameters_of(from_log_cholesky(theta))
    run = Recording("arm", {
        "q": Channel(t, path.q), "v": Channel(t, path.v), "ctrl": Channel(t[:-1], ctrl),
    })  # fmt: skip
    found = identify(of.write(setup, jnp.asarray(guess)), run, unknowns, grid=grid, pieces=0.1)
    p = np.array([*found.values.values()])
    assert found.ok and found.found.rank == 32
    np.testing.assert_allclose(found.found.combine(p), found.found.combine(truth), atol=1e-9)
    assert {f"armature[{k}]" for k in (2, 3, 4)} <= set(found.found.found)
    assert set(found.found.hidden) == {f"{link}.{k}" for link, k in map(tuple, given["never_show"])}
    assert found.found.term(0).startswith("armature[0] + link1.Izz")
    for k in range(5, 55, 10):
        assert np.linalg.eigvalsh(pseudo_inertia_of(p[k : k + 10])).min() > 0
