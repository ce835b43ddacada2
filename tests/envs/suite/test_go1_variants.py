"""Go1 on rough ground, with randomised robots, with pushes, and derivatives of its rewards."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from tests.envs.suite import walking

COUNT = 4


def states(env, seed=0):
    return jax.vmap(env.reset)(jax.random.split(jax.random.key(seed), COUNT))[1]


def stepped(env, state, action, params=None):
    keys = jax.random.split(jax.random.key(7), COUNT)
    return jax.vmap(env.step_once, (0, 0, 0, None))(keys, state, action, params)


def test_level_ground_is_a_floor():
    rough = rb.envs.make("go1_joystick_rough")
    model = rough.default_params.model
    assert model.geoms.heights[0].shape == (256, 256) and model.geoms.friction[0, 0] == 1.0
    level = model.geoms.replace(heights=(0 * model.geoms.heights[0],))
    params = rough.default_params.replace(model=model.replace(geoms=level))
    state = states(rough)
    q = state.state.q.at[:, 2].set(jnp.array([0.26, 0.27, 0.28, 0.4]))
    state = state.replace(state=state.state.replace(q=q))
    action = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (COUNT, 12)))
    _, after, *_ = stepped(rough, state, action, params)
    mj = walking.compiled("go1")
    mj.geom("floor").friction[0] = 1.0
    for i in range(COUNT):
        due = walking.Robot(mj, q[i], state.state.v[i], after.ctrl[i]).steps(5)
        np.testing.assert_allclose(after.state.q[i], due.data.qpos, atol=1e-12)
        touch = [due.touch(foot, "floor") for foot in ("FR", "FL", "RR", "RL")]
        np.testing.assert_array_equal(after.variables["last_contact"][i], touch)
    assert np.asarray(after.variables["last_contact"]).sum() >= 8


def test_it_stands_on_rough_ground():
    env = rb.envs.make("go1_joystick_rough")
    obs, state = env.reset(jax.random.key(0))
    assert float(state.state.q[2]) == 0.35
    policy = lambda obs, key: jnp.zeros(12, obs["policy"].dtype)  # noqa: E731
    _, state, path = env.unroll(jax.random.key(1), obs, state, policy, 75)
    assert not np.asarray(path["done"]).any() and abs(state.state.v).max() < 0.3
    assert np.asarray(state.variables["last_contact"]).sum() >= 3
    # the feet stand on ground of 0 to 0.05 m
    assert 0.2 < float(state.state.q[2]) < 0.33


def test_randomised_robots_move_as_in_mujoco():
    env = rb.envs.make("go1_joystick_flat", randomise=True)
    state = states(env)
    action = jnp.asarray(np.random.default_rng(0).uniform(-0.5, 0.5, (COUNT, 12)))
    _, after, *_ = stepped(env, state, action)
    for i in range(COUNT):
        mj, drawn = (
            walking.compiled("go1"),
            jax.tree.map(lambda x, i=i: np.asarray(x[i]), state.drawn),
        )
        assert 0.4 <= drawn["floor_friction"] <= 1.0
        assert (abs(drawn["joint_zero"]) <= 0.05).all() and (drawn["joint_zero"][:7] == 0).all()
        for name, low, high, free in (
            ("friction_loss", 0.9, 1.1, 6), ("armature", 1.0, 1.05, 6), ("masses", 0.9, 1.1, 0),
        ):  # fmt: skip
            assert ((drawn[name] >= low) & (drawn[name] <= high)).all(), name
            assert (drawn[name][:free] == 1).all() and np.ptp(drawn[name]) > 0
        assert (abs(drawn["center_of_mass"][0]) <= 0.05).all()
        assert abs(drawn["load"][0]) <= 1 and (drawn["load"][1:] == 0).all()
        mj.geom("floor").friction[0] = drawn["floor_friction"]
        mj.dof_frictionloss[:] *= drawn["friction_loss"]
        mj.dof_armature[:] *= drawn["armature"]
        mj.body_mass[1:] = mj.body_mass[1:] * drawn["masses"] + drawn["load"]
        mj.body_ipos[1:] += drawn["center_of_mass"]
        mj.qpos0[:] += drawn["joint_zero"]
        mujoco.mj_setConst(mj, mujoco.MjData(mj))
        due = walking.Robot(mj, state.state.q[i], state.state.v[i], after.ctrl[i]).steps(5)
        np.testing.assert_allclose(after.state.q[i], due.data.qpos, atol=1e-11)
        np.testing.assert_allclose(after.state.v[i], due.data.qvel, atol=1e-9)


def test_pushes():
    env = rb.envs.make("go1_joystick_flat", pushes=True)
    assert env.observation_size["critic"] == 123
    values = env.default_params.values | {
        "push_wait": jnp.array([0.05, 0.05]), "push_speed": jnp.array([3.0, 3.0]),
        "push_duration": jnp.array([0.2, 0.2]),
    }  # fmt: skip
    params = env.default_params.replace(values=values)
    obs, state = env.reset(jax.random.key(0), params)
    policy = lambda obs, key: jnp.zeros(12, obs["policy"].dtype)  # noqa: E731
    *_, path = env.unroll(jax.random.key(1), obs, state, policy, 20, params)
    force = np.asarray(path["obs"]["critic"])[:, 119:]
    size, acts = np.linalg.norm(force[:, :3], axis=1), force[:, 3]
    np.testing.assert_array_equal(acts, size > 0)
    mass = float(env.task.model.bodies.mass.sum())
    assert np.isclose(size.max(), mass * 3.0 / 0.4, rtol=0.03) and acts.sum() >= 8


def test_derivatives_of_the_reward():
    """By the action, against central differences: within a phase of contact."""
    env = rb.envs.make("go1_joystick_flat", kernel=False)
    _, state = env.reset(jax.random.key(0))
    q = state.state.q.at[2].set(0.32)  # in the air, so that no contact begins or ends
    v = 0.1 * jax.random.normal(jax.random.key(1), (18,))
    state = state.replace(state=state.state.replace(q=q, v=v))
    last = 0.1 * jax.random.normal(jax.random.key(2), (12,))

    @jax.jit
    def reward(action):
        *_, info = env.step_once(jax.random.key(3), state, action)
        return sum(info["rewards"].values())

    action = last
    found = jax.grad(reward)(action)
    assert jnp.isfinite(found).all() and (found != 0).all()
    for k in range(0, 12, 5):
        h = 1e-6 * jnp.eye(12)[k]
        due = (reward(action + h) - reward(action - h)) / 2e-6
        # the error of a central difference with rounding of 1e-15 / 1e-6
        np.testing.assert_allclose(found[k], due, atol=1e-6, rtol=1e-5)
