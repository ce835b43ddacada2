"""Unknowns: what they write they read, what is impossible is infinitely far, bad ones are named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import (
    PD,
    Channel,
    Derived,
    FixedTotal,
    Grid,
    Inertia,
    Recording,
    Setup,
    Shared,
    Tilt,
    Unknown,
    identify,
)
from rbjax.sysid.parameters import log_determinant_divergence, pseudo_inertia_of
from rbjax.sysid.parameters.unknown_vector import Unknowns, draw_guesses

MODEL = rb.load("arm7")
MASSES = np.asarray(MODEL.bodies.mass)
ALL = {
    "free": Unknown("joints.damping", (slice(0, 2),)),
    "positive": Unknown("bodies.mass", 2, positive=True),
    "bounded": Unknown("joints.armature", 1, bounds=(-1.0, 2.0)),
    "inertia": Inertia(4),
    "shared": Shared(
        (Unknown("bodies.mass", 5, positive=True), Unknown("bodies.mass", 6)), (1.0, 2.0)
    ),
    "total": FixedTotal("bodies.mass", (0, 1, 3), float(MASSES[[0, 1, 3]].sum())),
    "tilt": Tilt(),
}


@pytest.mark.parametrize("name", ALL)
def test_what_is_written_is_read(name):
    u = ALL[name]
    p = np.asarray(u.read(MODEL)) * 1.01 + 0.001
    assert len(u.names(name, MODEL)) == p.size
    np.testing.assert_allclose(u.read(u.write(MODEL, jnp.asarray(p))), p, rtol=1e-12)
    slopes = jax.jacfwd(lambda p: u.read(u.write(MODEL, p)))(jnp.asarray(p))
    np.testing.assert_allclose(slopes, np.eye(p.size), atol=1e-10)


@pytest.mark.parametrize("name", ALL)
def test_derivatives_of_divergences(name):
    u = ALL[name]
    p0 = np.asarray(u.read(MODEL), float)
    p = p0 * 1.02 + 1e-4
    found, zero = u.divergence(p, p0), u.divergence(p0, p0)
    assert abs(zero.value) < 1e-12
    assert np.abs(zero.slope).max() < 1e-6 * np.abs(found.curvature).max()
    assert found.value > 0 and np.linalg.eigvalsh(found.curvature).min() > 0
    for k in range(p.size):
        e = np.zeros(p.size)
        e[k] = 1e-5 * max(abs(p[k]), 1e-2)
        ahead, back = u.divergence(p + e, p0), u.divergence(p - e, p0)
        slope = (ahead.value - back.value) / (2 * e[k])
        atol = 1e-5 * np.abs(found.slope).max()
        np.testing.assert_allclose(found.slope[k], slope, rtol=1e-3, atol=atol)
        curved = (ahead.slope - back.slope) / (2 * e[k])
        atol = 1e-4 * np.abs(found.curvature).max()
        np.testing.assert_allclose(found.curvature[k], curved, rtol=1e-3, atol=atol)


def test_the_divergence_of_inertias_is_that_of_pseudo_inertias():
    u = ALL["inertia"]
    p0 = np.asarray(u.read(MODEL))
    p = p0 * 1.1
    want = log_determinant_divergence(pseudo_inertia_of(p), pseudo_inertia_of(p0))
    np.testing.assert_allclose(u.divergence(p, p0).value, want, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "p"), [("positive", [-1.0]), ("bounded", [2.1]), ("bounded", [-1.5])]
)
def test_the_impossible_is_infinitely_far(name, p):
    u = ALL[name]
    assert u.divergence(np.array(p), np.asarray(u.read(MODEL))).value == np.inf


def test_a_body_without_a_density_is_infinitely_far():
    p0 = np.asarray(ALL["inertia"].read(MODEL))
    p = p0.copy()
    p[9] = p[4] + p[6] + 1.0  # Izz above Ixx + Iyy
    assert ALL["inertia"].divergence(p, p0).value == np.inf


def test_shared_numbers_and_totals():
    p = jnp.array([0.3])
    shared = ALL["shared"].write(MODEL, p)
    np.testing.assert_allclose(shared.bodies.mass[5:7], [0.3, 0.6])
    total = ALL["total"].write(MODEL, jnp.array([0.5, 0.7]))
    np.testing.assert_allclose(total.bodies.mass[jnp.array([0, 1, 3])].sum(), ALL["total"].total)


def test_tilted_gravity_keeps_its_size():
    tilted = Tilt().write(MODEL, jnp.array([0.1, -0.2]))
    np.testing.assert_allclose(jnp.linalg.norm(tilted.gravity), 9.81, rtol=1e-12)
    np.testing.assert_allclose(Tilt().read(tilted), [0.1, -0.2], rtol=1e-12)


def test_a_setup_has_leaves_beside_its_model():
    setup = Setup.of(MODEL, PD(jnp.full(7, 20.0), jnp.ones(7)), delay=0.01)
    u = {
        "gain": Unknown("controller.kp"),
        "bias": Unknown("sensors.q.bias", 0),
        "late": Unknown("delay", positive=True),
        "link": Derived((1.0,), lambda s, p: Unknown("bodies.mass", 0).write(s, 2 * p)),
        "mass": Unknown("bodies.mass", 3),
    }
    all_of = Unknowns.of("test", u, setup)
    assert all_of.names[-3:] == ("late", "link", "mass") and sum(all_of.sizes) == 11
    p = np.asarray(all_of.read(setup)) + 0.5
    after = all_of.write(setup, jnp.asarray(p))
    np.testing.assert_allclose(after.controller.kp, 20.5)
    np.testing.assert_allclose(after.delay, 0.51)
    np.testing.assert_allclose(after.model.bodies.mass[0], 3.0)
    assert all_of.limits(setup) == {"late": (0.0, np.inf)}


@pytest.mark.parametrize(
    ("bounds", "low", "high"),
    [
        ((0.0, np.inf), 0.0, np.inf),
        ((-np.inf, 2.0), -np.inf, 2.0),
        ((-np.inf, np.inf), -np.inf, np.inf),
        ((0.0, 2.0), 0.0, 2.0),
    ],
)
def test_infinite_sides_of_bounds(bounds, low, high):
    """An infinite side bounds nothing: finite distances, slopes that are right, guesses inside."""
    u = Unknown("bodies.mass", 0, bounds=bounds)
    p, p0, h = np.array([1.2]), np.array([1.0]), 1e-6
    D = u.divergence(p, p0)
    assert np.isfinite(D.value) and D.value > 0 and (np.linalg.eigvalsh(D.curvature) > 0).all()
    numeric = (u.divergence(p + h, p0).value - u.divergence(p - h, p0).value) / (2 * h)
    np.testing.assert_allclose(D.slope, [numeric], rtol=1e-6)
    assert np.isinf(u.divergence(np.array([-1.0]), p0).value) == (low == 0.0)
    assert np.isinf(u.divergence(np.array([3.0]), p0).value) == (high == 2.0)
    sought = Unknowns.of("test", {"mass": u}, rb.load("pendulum"))
    guesses = draw_guesses(sought, rb.load("pendulum"), 8, 1.0, 0)
    assert np.isfinite(guesses).all() and (guesses > low).all() and (guesses < high).all()


def test_rows_of_normal_priors():
    """Of the entries of two unknowns with a prior, beside one without."""
    members = {
        "a": Unknown("bodies.mass", prior=(2.0, 0.5)), "b": Unknown("joints.damping"),
        "c": Unknown("joints.armature", prior=(0.0, 4.0)),
    }  # fmt: skip
    rows = Unknowns(members, (2, 1, 1), ()).prior_rows(np.array([3.0, 2.0, 7.0, 8.0]))
    due = [[2, 0, 0, 0, 2], [0, 2, 0, 0, 0], [0, 0, 0, 0.25, 2]]
    np.testing.assert_array_equal(rows, due)
    assert Unknowns({}, (), ()).prior_rows(np.zeros(0)).shape == (0, 1)


@pytest.mark.slow
def test_a_prior_is_combined_with_the_data_by_their_variances():
    """Data that say little of the damping: the estimate and its sigma are those of Bayes' rule."""
    t, rng = np.arange(101) * 0.01, np.random.default_rng(0)
    model = rb.load("pendulum")
    path = rb.rollout(model, rb.State(np.ones(1), np.zeros(1)), None, 0.01, steps=100)
    q = Channel(t, path.q + 0.02 * rng.normal(size=(101, 1)), noise=[0.02])
    run = Recording("swing", {"q": q}, initial_state=rb.State(np.ones(1), np.zeros(1)))
    known = {"grid": Grid(0.01), "restarts": 0}
    free = identify(model, run, {"d": Unknown("joints.damping", 0)}, **known)
    sigma = float(free.estimates.sigma[0] / free.statistics.scale["q[0]"])
    mean = free.values["d"] + 0.2 * sigma
    held = identify(model, run, {"d": Unknown("joints.damping", 0, prior=(mean, sigma))}, **known)
    np.testing.assert_allclose(held.values["d"] - free.values["d"], 0.1 * sigma, rtol=0.05)
    np.testing.assert_allclose(held.estimates.sigma[0], sigma / np.sqrt(2), rtol=0.1)
