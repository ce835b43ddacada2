"""Small functions of `rb.envs` against plain NumPy: totals, randomisations, gait clocks, starts."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs import terms
from rbjax.errors import InputError
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


def test_a_factor_of_each_body_scales_its_mass_and_its_inertia():
    factors = np.linspace(0.5, 2.0, QUADRUPED.nb)
    both = lambda model: [model.bodies.mass, model.bodies.inertia]  # noqa: E731
    new = rb.envs.random_scale("load", both, factors, factors).apply(QUADRUPED, factors)
    np.testing.assert_allclose(new.bodies.mass, factors * QUADRUPED.bodies.mass)
    due = factors[:, None, None] * np.asarray(QUADRUPED.bodies.inertia)
    np.testing.assert_allclose(new.bodies.inertia, due)
    scale = rb.envs.random_scale("m", lambda m: [m.bodies.mass, m.joints.damping], 0.5, 2.0)
    with pytest.raises(InputError, match=r"the first axes of"):
        scale.apply(QUADRUPED, factors)
    for where in (lambda model: model.timestep, lambda model: []):
        with pytest.raises(InputError, match="expected a leaf of the model"):
            drawn(rb.envs.random_scale("m", where, 0.5, 2.0))


def test_joints_of_an_arm_and_a_free_body():
    arm = rb.load(
        """<mujoco><worldbody>
        <body><freejoint/><geom size="0.1"/></body>
        <body pos="1 0 0"><joint axis="0 0 1"/><geom size="0.1" pos="0.1 0 0"/>
          <body pos="0.2 0 0"><joint type="slide"/><geom size="0.1"/></body></body>
        </worldbody></mujoco>"""
    )
    _, armature, zero = terms.joint_randomisations(
        arm, friction=(1.0, 1.0), armature=(0.5, 0.9), zero=0.1
    )
    params = SimpleNamespace(model=arm)
    assert (armature.draw(jax.random.key(0), params) < 1).tolist() == [False] * 6 + [True] * 2
    assert (zero.draw(jax.random.key(0), params) != 0).tolist() == [False] * 7 + [True] * 2
    ball = rb.load(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(InputError, match="no hinge and no slide"):
        terms.joint_randomisations(ball, friction=(1, 1), armature=(1, 1), zero=0.1)


def test_masses_and_friction_that_do_not_exist():
    with pytest.raises(InputError, match="so that its mass stays above zero"):
        terms.mass_randomisations(QUADRUPED, "trunk", factor=(0.9, 1.1), added=1000.0)
    pendulum = rb.load("two_link")
    count = 0 if pendulum.geoms is None else len(pendulum.geoms.friction)
    for index in (-1, count):
        with pytest.raises(InputError, match=rf"geoms has \[{index}\]"):
            terms.set_friction("floor", [index], 0.2, 0.4).apply(pendulum, 0.3)


def test_a_drawn_integer_stays_an_integer():
    model, table = rb.load("cart_pole"), jnp.array([0.5, 1.0, 2.0])
    change = rb.envs.Randomisation(
        "which", lambda key, params: jax.random.randint(key, (), 0, 3),
        lambda model, i: model.replace(
            bodies=model.bodies.replace(mass=model.bodies.mass * table[i])
        ),
    )  # fmt: skip
    task = rb.envs.Task(
        "small", model, start=lambda key, params: model.random_state(key),
        observations={"policy": (rb.envs.Observation("v", lambda to: to.after.v),)},
        rewards=(rb.envs.Reward("mass", lambda to: to.params.model.bodies.mass.sum()),),
        randomise=(change,), total_reward=lambda rewards, dt: sum(rewards.values()),
    )  # fmt: skip
    env, keys = rb.envs.Environment(task), jax.random.split(jax.random.key(0), 8)
    _, state = jax.vmap(env.reset)(keys)
    found = jax.vmap(env.step)(keys, state, jnp.zeros((8, 1)))[2]
    np.testing.assert_allclose(found, table[state.drawn["which"]] * model.bodies.mass.sum())
    assert len(set(state.drawn["which"].tolist())) == 3


def test_flags_of_tasks():
    with pytest.raises(InputError, match="randomise is 'False', expected True or False"):
        rb.envs.make("park_trailer", randomise="False")
    for speed in (-1.0, float("nan"), "fast"):
        with pytest.raises(InputError, match="walker_walk: speed is"):
            rb.envs.make("walker_walk", speed=speed)


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
