"""`many_starts` where one start ends in a wrong minimum."""

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import (
    Channel,
    Derived,
    FixedTotal,
    Grid,
    Inertia,
    Recording,
    Setup,
    Shared,
    Unknown,
    identify,
    many_starts,
)
from rbjax.sysid.estimators import multi_start
from rbjax.sysid.estimators.staged_fit import StagedFit
from rbjax.sysid.parameters.unknown_vector import Unknowns, draw_guesses

MODEL = rb.load("pendulum")
ROTOR = {"armature": Unknown("joints.armature", 0, positive=True)}
T = 0.02


def turning(armature):
    return MODEL.replace(joints=MODEL.joints.replace(armature=jnp.array([armature])))


#: the recording's steps and those of half their length, which a fit may take, differ by 3e-8
STEPS = 1e-7


def long_run(armature=0.9, count=400):
    """Eight seconds of free swinging: eight periods, and a wrong frequency loses count of them."""
    start = rb.State(jnp.array([1.2]), jnp.array([0.0]))
    path = rb.rollout(turning(armature), start, jnp.zeros((count, 1)), T, integrator="rk4")
    t = np.arange(count + 1) * T
    return Recording("free", {"q": Channel(t, path.q), "v": Channel(t, path.v)})


@pytest.mark.slow
def test_a_wrong_frequency_has_many_minima_and_many_starts_find_the_best():
    run, guess = long_run(), turning(0.05)
    single = identify(guess, run, ROTOR, restarts=0)
    assert single.success and single.rms["q"] > 0.1  # it ends, but not at the truth
    assert not single.verdict.success
    # by default a poor fit is tried from other starts, one of which grows to the truth
    np.testing.assert_allclose(identify(guess, run, ROTOR).values["armature"], 0.9, rtol=STEPS)
    found = many_starts(guess, run, ROTOR, guesses=12, spread=3.5, finalists=8)
    np.testing.assert_allclose(found.best.values["armature"], 0.9, rtol=STEPS)
    assert found.best.guess["armature"] == pytest.approx(0.05) and found.best.success
    assert found.guesses.shape == (12, 1) and found.guesses[0] == pytest.approx(0.05)
    assert np.argmin(found.costs) in found.basins[0].guesses
    assert found.best_guess in found.basins[0].guesses
    assert 1 < len(found.basins) <= 8  # the others are other frequencies
    assert found.basins[1].cost > 1e3 * found.basins[0].cost
    assert f"{len(found.basins)} basins" in found.summary()


def test_guesses_that_are_given():
    run = long_run()
    found = many_starts(turning(0.05), run, ROTOR, guesses=[[0.02], [0.8], [1.0]])
    np.testing.assert_allclose(found.best.values["armature"], 0.9, rtol=STEPS)
    assert set(found.basins[0].guesses) == {1, 2}


def test_guesses_are_drawn_where_they_can_be():
    model = rb.load("double_pendulum")
    setup = Setup.of(model)
    mass = Unknown("bodies.mass", 0, positive=True)
    members = {
        "body": Inertia(1),
        "damping": Shared((Unknown("joints.damping", positive=True),)),
        "weighed": FixedTotal("bodies.mass", (0, 1), 3.0),
        "mass": mass,
        "bias": Unknown("sensors.q.bias", scale=0.01),
        "share": Derived((0.4,), lambda target, p: target, bounds=(0.0, 1.0)),
    }
    model = model.replace(joints=model.joints.replace(damping=jnp.full(2, 0.1)))
    setup = setup.replace(model=model)
    of = Unknowns.of("test", members, setup)
    p = draw_guesses(of, setup, 32, 1.0, 0)
    assert p.shape == (32, sum(of.sizes))
    np.testing.assert_array_equal(p[0], np.asarray(of.read(setup)))
    assert all(np.isfinite(of.divergence(x, x).value) for x in p)
    names = list(of.names)
    damping = p[:, names.index("damping[0]")]
    assert 0.1 / np.e < damping.min() < 0.05 and 0.2 < damping.max() < 0.1 * np.e
    share, bias = p[:, -1], p[:, -2]
    assert share.min() < 0.05 and share.max() > 0.95 and np.abs(bias).max() <= 0.01
    assert len(np.unique(p, axis=0)) == 32


def test_guesses_are_searched_with_steps_that_were_checked(monkeypatch):
    """Before any search, and with the grid that came out of it."""

    class Stop(Exception):
        pass

    def search(of, *args, **how):
        raise Stop(of.grid)

    checked = Grid(T / 4)
    monkeypatch.setattr(StagedFit, "shorten_steps", lambda fit: setattr(fit, "grid", checked))
    monkeypatch.setattr(multi_start, "search_together", search)
    t = np.arange(20) * T
    still = Recording("still", {"q": Channel(t, np.zeros(20)), "v": Channel(t, np.zeros(20))})
    with pytest.raises(Stop) as found:
        many_starts(turning(0.05), still, ROTOR, guesses=2, spread=1.0)
    assert found.value.args == (checked,)
