"""What recordings can identify, before a fit."""

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import Channel, Grid, Inertia, Recording, Unknown, identifiability, identify

GRID = Grid(0.02, 1, "semi_implicit_euler")


@pytest.fixture(scope="module")
def swing():
    model = rb.load("pendulum")
    model = model.replace(joints=model.joints.replace(damping=jnp.array([0.2])))
    t = np.arange(101) * 0.02
    seen = rb.rollout(model, rb.State(jnp.array([1.0]), jnp.zeros(1)), np.zeros((100, 1)), 0.02)
    return model, Recording("swing", {"q": Channel(t, seen.q), "v": Channel(t, seen.v)})


def test_combinations_are_those_of_a_fit(swing):
    model, run = swing
    sought = {"rod": Inertia("rod"), "damping": Unknown("joints.damping", 0, positive=True)}
    before = identifiability(model, run, sought, grid=GRID)
    after = identify(model, run, sought, grid=GRID, restarts=0).identifiable
    # moment of gravity, moment of inertia and friction
    assert before.rank == after.rank == 3
    assert before.hidden == after.hidden and "rod.Iyz" in before.hidden
    np.testing.assert_allclose(before.K, after.K, atol=1e-5)


def test_an_unknown_without_effect_is_hidden(swing):
    model, run = swing
    sought = {"mass": Unknown("bodies.mass", 0), "bias": Unknown("sensors.q.bias", 0)}
    there = identifiability(model, run, sought, grid=GRID, estimate_initial_state=False)
    assert there.rank == 2 and "2 of 2" in there.summary()
