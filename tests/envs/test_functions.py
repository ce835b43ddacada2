"""Small functions of `rb.envs` against plain NumPy: totals, randomisations, gait clocks, starts."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs import terms
from rbjax.viewer import motion_of_policy

QUADRUPED = rb.load("quadruped")
PARAMS = SimpleNamespace(model=QUADRUPED)


def drawn(randomisation, seed=0):
    """The value of a randomisation, and the model with it."""
    value = randomisation.draw(jax.random.key(seed), PARAMS)
    return np.asarray(value), randomisation.apply(QUADRUPED, value)


def test_totals():
    rewards = {"a": 0.5, "b": -0.25, "c": 2.0}
    assert rb.envs.sum_of_rewards(rewards, 0.1) == pytest.approx(0.225)
    assert terms.product_of_rewards(rewards, 0.1) == pytest.approx(-0.25)


def test_scale_and_offset():
    def both(model):
        return [model.bodies.mass, model.bodies.inertia]

    value, model = drawn(rb.envs.random_scale("load", both, 0.5, 2.0))
    assert value.shape == () and 0.5 <= value <= 2
    for new, old in zip(both(model), both(QUADRUPED), strict=True):
        np.testing.assert_allclose(new, value * np.asarray(old))
    low, high = np.zeros(QUADRUPED.nb), np.arange(QUADRUPED.nb) / 10
    value, model = drawn(rb.envs.random_offset("added", lambda m: m.bodies.mass, low, high))
    assert value[0] == 0 and (value <= high).all() and (value[1:] > 0).all()
    np.testing.assert_allclose(model.bodies.mass - QUADRUPED.bodies.mass, value, atol=1e-15)
    value, _ = drawn(rb.envs.random_scale("each", lambda m: m.bodies.mass, 0.9, 1.1, each=True))
    assert len(set(value.tolist())) == QUADRUPED.nb


def test_randomisations_of_robots():
    trunk, old = QUADRUPED.body("trunk"), QUADRUPED.bodies
    value, model = drawn(terms.shift_center_of_mass(QUADRUPED, "trunk", 0.05))
    moved = np.asarray(model.bodies.com - old.com)
    assert 0 < np.abs(moved[trunk]).max() <= 0.05
    assert not np.delete(moved, trunk, 0).any()
    masses, load = terms.mass_randomisations(QUADRUPED, "trunk", factor=(0.9, 1.1), added=1.0)
    value, model = drawn(masses)
    assert (value >= 0.9).all() and (value <= 1.1).all()
    np.testing.assert_allclose(model.bodies.mass, value * old.mass)
    _, model = drawn(load)
    added = np.asarray(model.bodies.mass - old.mass)
    assert 0 < abs(added[trunk]) <= 1 and not np.delete(added, trunk).any()
    loss, armature, zero = terms.joint_randomisations(
        QUADRUPED, friction=(0.9, 1.1), armature=(1.0, 1.05), zero=0.05
    )
    assert loss.name == "friction_loss"
    value, model = drawn(armature)
    assert (value[:6] == 1).all() and (value[6:] > 1).all() and (value <= 1.05).all()
    value, model = drawn(zero)
    change = np.asarray(model.joints.reference - QUADRUPED.joints.reference)
    assert not change[:7].any() and 0 < np.abs(change).max() <= 0.05


def test_friction():
    model = rb.load(
        """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
        <body><freejoint/><geom name="ball" size="0.1"/></body></worldbody>
        <contact><pair geom1="floor" geom2="ball" friction="1 1 0.1 0.1 0.1"/></contact></mujoco>"""
    )
    for kind, field, changed in (
        (terms.set_friction, "friction", (slice(0, 1), slice(0, 1))),
        (terms.set_pair_friction, "pair_friction", (slice(0, 1), slice(0, 2))),
    ):
        randomisation = kind("floor", [0], 0.2, 0.4)
        value = randomisation.draw(jax.random.key(0), None)
        due = np.array(getattr(model.geoms, field))
        due[changed] = value
        new = randomisation.apply(model, value)
        assert 0.2 <= value <= 0.4
        np.testing.assert_allclose(getattr(new.geoms, field), due)


def test_gait():
    phases = jnp.array([0.3, -2.0])
    body = rb.load("free_body")
    state = body.default_state()

    def read(command, speed, heights):
        moving = state.replace(v=state.v.at[0].set(speed))
        to = SimpleNamespace(
            variables={"phase": phases, "command": jnp.asarray(command)},
            after=rb.forces.Context.of(body, 0.0, moving, None),
        )

        class Lifted(terms.Feet):
            def heights(self, transition):
                return jnp.asarray(heights)

        feet = Lifted(("left", "right"), ())
        assert terms.phase_cosines(to).tolist() == pytest.approx([*np.cos(phases), *np.sin(phases)])
        return float(terms.follow_phase(feet, 0.1, "box")(to))

    x = (np.asarray(phases) + np.pi) / (2 * np.pi)
    y = np.where(x <= 0.5, 2 * x, 2 * x - 1)
    b = y**3 + 3 * y**2 * (1 - y)
    z = 0.1 * np.where(x <= 0.5, b, 1 - b)
    assert read([0.5, 0, 0], 0.0, z) == pytest.approx(1)
    off = np.exp(-(0.05**2) / 0.01)
    assert read([0.5, 0, 0], 0.0, z + np.array([0.05, 0])) == pytest.approx(off)
    assert read([0.0, 0, 0], 0.0, z) == 0  # it should stand still
    assert read([0.0, 0, 0], 0.5, z) == pytest.approx(1)  # and moves


def test_planar_start():
    model = rb.load("cart_pole")
    start = terms.planar_start(model, model.joint_names[1])
    q = np.stack([start(k, None).q for k in jax.random.split(jax.random.key(0), 50)])
    low, high = np.where(np.isfinite(model.joints.range), model.joints.range, 0)[0]
    assert (q[:, 0] >= low).all() and (q[:, 0] <= high).all()
    assert np.abs(q[:, 1]).max() <= np.pi and np.ptp(q[:, 1]) > 5


def test_random_base():
    def draw(key):
        return terms.random_base(*jax.random.split(key), 0.3, 0.2)

    q = np.asarray(jax.vmap(draw)(jax.random.split(jax.random.key(0), 200)))
    assert (abs(q[:, :2]) <= 0.2).all() and np.ptp(q[:, :2]) > 0.35
    np.testing.assert_allclose(q[:, 2], 0.3)
    assert (q[:, 4:6] == 0).all() and np.ptp(2 * np.arctan2(q[:, 6], q[:, 3])) > 6
    np.testing.assert_allclose((q[:, 3:] ** 2).sum(1), 1.0)


def test_clipped_sum():
    rewards = {"a": 3.0, "b": -1.0}
    assert terms.clipped_sum(-1.0, 1.5)(rewards, 0.02) == 1.5
    assert terms.clipped_sum(-1.0, 1.5, times_dt=True)(rewards, 0.02) == pytest.approx(0.04)
    assert terms.clipped_sum(0.0, 1.0)({"a": -3.0}, 0.02) == 0.0


def test_motion_of_a_policy():
    env = rb.envs.make("cart_pole_balance")
    found = motion_of_policy(env, lambda obs, key: jnp.zeros(1, obs.dtype), samples=2, seconds=0.05)
    assert found.trajectory.q.shape == (2, 6, 2)
