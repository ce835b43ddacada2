"""Go1 joystick tasks against MuJoCo C and the equations of MuJoCo Playground."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.envs.suite import walking
from tests.envs.suite.walking import samples

FEET = ("FR", "FL", "RR", "RL")
HOME = np.array([0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2)
STEPS = 12


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("go1_joystick_flat")


@pytest.fixture(scope="module")
def walk(env):
    """Transitions of random actions."""
    params, state = walking.quiet(env)
    # one robot stands still by command, one falls, two fly, one with a bent knee
    command = state.variables["command"].at[0].set(0.0)
    q = state.state.q.at[1, 3:7].set(jnp.array([0.0, 1.0, 0.0, 0.0])).at[1:4, 2].add(0.3)
    q = q.at[3, 9].set(-3.5)
    state = state.replace(
        variables=state.variables | {"command": command}, state=state.state.replace(q=q)
    )
    return walking.transitions(env, params, state, STEPS, lambda k: k % 4 < 2)


def test_sizes(env):
    assert env.observation_size == {"policy": 48, "critic": 123}
    assert env.action_size == 12 and env.dt == pytest.approx(0.02) and env.episode == 1000
    names = {g: [t.name for t in terms] for g, terms in env.task.observations.items()}
    assert names["critic"][:7] == names["policy"]


def test_a_control_step_is_five_steps_of_mujoco(walk):
    model = walking.compiled("go1")
    for before, _, _, after, *_ in samples(walk):
        due = walking.Robot(model, before.state.q, before.state.v, after.ctrl).steps(5)
        # rounding of five steps with stiff contacts; 7e-14 measured
        np.testing.assert_allclose(after.state.q, due.data.qpos, atol=1e-12)
        np.testing.assert_allclose(after.state.v, due.data.qvel, atol=1e-11)


def test_the_servos_hold_the_home_pose_plus_half_the_action(walk):
    limits = walking.compiled("go1").actuator_ctrlrange
    for _, action, _, after, *_ in samples(walk):
        np.testing.assert_allclose(after.ctrl, np.clip(HOME + 0.5 * action, *limits.T), atol=1e-15)


def playground_terms(before, action, after, done, robot):
    """The weighted reward terms of Playground's joystick task for Go1."""
    _, R, v, w = robot.site("imu")
    q, qd = robot.joints
    old, command = before.variables, before.variables["command"]
    moving = np.linalg.norm(command) > 0.01
    contact = np.array([robot.touch(foot, "floor") for foot in FEET])
    feet = [robot.site(foot) for foot in FEET]
    z = np.array([p[2] for p, *_ in feet])
    speed = np.array([np.hypot(u[0], u[1]) for _, _, u, _ in feet])
    air, peak = old["air_time"] + 0.02, np.maximum(old["swing_peak"], z)
    landing = (old["air_time"] > 0) & (contact | (old["last_contact"] > 0))
    tau = robot.forces
    lower, upper = 0.95 * robot.model.jnt_range[1:].T
    out = np.maximum(lower - q, 0) + np.maximum(q - upper, 0)
    offset = q - HOME
    own = R.T @ v
    terms = {
        "tracking_lin_vel": np.exp(-np.sum((command[:2] - own[:2]) ** 2) / 0.25),
        "tracking_ang_vel": 0.5 * np.exp(-((command[2] - (R.T @ w)[2]) ** 2) / 0.25),
        "lin_vel_z": -0.5 * v[2] ** 2,
        "ang_vel_xy": -0.05 * (w[0] ** 2 + w[1] ** 2),
        "orientation": -5.0 * (R[0, 2] ** 2 + R[1, 2] ** 2),
        "dof_pos_limits": -out.sum(),
        "pose": 0.5 * np.exp(-np.sum(offset**2 * np.tile([1.0, 1.0, 0.1], 4))),
        "termination": -float(done),
        "stand_still": -np.abs(offset).sum() * (not moving),
        "torques": -2e-4 * (np.linalg.norm(tau) + np.abs(tau).sum()),
        "action_rate": -0.01 * np.sum((action - before.action) ** 2),
        "energy": -0.001 * np.sum(np.abs(qd) * np.abs(tau)),
        "feet_clearance": -2.0 * np.sum(np.abs(z - 0.1) * np.sqrt(speed)),
        "feet_height": -0.2 * np.sum((peak / 0.1 - 1) ** 2 * landing) * moving,
        "feet_slip": -0.1 * np.sum(speed**2 * contact) * moving,
        "feet_air_time": 0.1 * np.sum((air - 0.1) * landing) * moving,
    }
    variables = {
        "air_time": air * ~contact, "swing_peak": peak * ~contact, "last_contact": contact * 1.0
    }  # fmt: skip
    return terms, variables


def test_rewards_and_variables(walk):
    model, seen = walking.compiled("go1"), {}
    for before, action, _, after, reward, done, info in samples(walk):
        robot = walking.Robot(model, after.state.q, after.state.v, after.ctrl)
        terms, variables = playground_terms(before, action, after, done, robot)
        assert info["rewards"].keys() == terms.keys()
        for name, due in terms.items():
            seen[name] = max(seen.get(name, 0.0), abs(due))
            # the same state in both; rounding of velocities of about 10
            np.testing.assert_allclose(info["rewards"][name], due, atol=1e-12, err_msg=name)
        np.testing.assert_allclose(reward, np.clip(0.02 * sum(terms.values()), 0, 1e4), atol=1e-12)
        for name, due in variables.items():
            np.testing.assert_allclose(after.variables[name], due, atol=1e-12, err_msg=name)
    assert min(seen.values()) > 0, f"terms that the states do not reach: {seen}"


def test_observations(walk):
    model = walking.compiled("go1")
    for _, action, obs, after, *_ in samples(walk):
        robot = walking.Robot(model, after.state.q, after.state.v, after.ctrl)
        _, R, v, w = robot.site("imu")
        q, qd = robot.joints
        state = [R.T @ v, R.T @ w, -R[2], q - HOME, qd, action, after.variables["command"]]
        np.testing.assert_allclose(obs["policy"], np.concatenate(state), atol=1e-12)
        feet = np.concatenate([robot.site(foot)[2] for foot in FEET])
        rest = [w, q - HOME, qd, robot.forces, after.variables["last_contact"], feet]
        rest += [after.variables["air_time"], np.zeros(4)]
        privileged = [*state, R.T @ w, obs["critic"][51:54], -R[2], R.T @ v, *rest]
        np.testing.assert_allclose(obs["critic"], np.concatenate(privileged), atol=1e-11)


def test_accelerometer_is_the_mean_of_the_last_physics_step(walk):
    """Its integral over a step is the change of velocity less gravity, at a frame of the base."""
    model = walking.compiled("go1")
    for before, _, obs, after, *_ in samples(walk):
        robot = walking.Robot(model, before.state.q, before.state.v, after.ctrl).steps(4)
        old = robot.data.qvel.copy()
        last = robot.steps(1)
        data = last.data
        data.qacc[:] = (data.qvel - old) / model.opt.timestep
        mujoco.mj_rnePostConstraint(model, data)
        six = np.zeros(6)
        site = model.site("imu").id
        mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_SITE, site, six, 1)
        np.testing.assert_allclose(obs["critic"][51:54], six[3:], atol=1e-8)


def test_reset(env):
    keys = jax.random.split(jax.random.key(3), 512)
    obs, state = jax.vmap(env.reset)(keys)
    q, v = np.asarray(state.state.q), np.asarray(state.state.v)
    assert (abs(q[:, :2]) <= 0.5).all() and np.allclose(q[:, 2], 0.278)
    yaw = 2 * np.arctan2(q[:, 6], q[:, 3])
    assert np.allclose(q[:, 4:6], 0) and np.allclose(np.linalg.norm(q[:, 3:7], axis=1), 1)
    assert np.allclose(q[:, 7:], HOME) and (abs(v[:, :6]) <= 0.5).all() and (v[:, 6:] == 0).all()
    # uniform: standard deviation (high - low) / sqrt(12), whose estimate of 512 is within 10 %
    for values, width in ((q[:, 0], 1.0), (yaw, 2 * np.pi), (v[:, 3], 1.0)):
        assert abs(values.std() / (width / np.sqrt(12)) - 1) < 0.1
    command = np.asarray(state.variables["command"])
    assert (abs(command) <= [1.5, 0.8, 1.2]).all()
    assert np.allclose(abs(command).mean(0), [0.75, 0.4, 0.6], rtol=0.1)
    # exponential with a mean of 5 s, 250 steps; the mean of 512 is within 20 %
    assert abs(np.asarray(state.variables["command_steps"]).mean() / 250 - 1) < 0.2
    noise = np.asarray(obs["policy"]) - np.asarray(jax.vmap(env.reset, (0, None))(
        keys, env.default_params.replace(noise=jnp.zeros(())))[0]["policy"])  # fmt: skip
    half = np.repeat([0.1, 0.2, 0.05, 0.03, 1.5, 0.0, 0.0], [3, 3, 3, 12, 12, 12, 3])
    assert (abs(noise) <= half + 1e-12).all()
    # the critic has the same noise
    np.testing.assert_array_equal(obs["critic"][:, :48], obs["policy"])
    assert np.allclose(noise.std(0)[:33], half[:33] / np.sqrt(3), rtol=0.15)


def test_a_robot_on_its_back_has_fallen(walk):
    done = np.array([transition[5] for transition in walk])
    assert done[0, 1] and not done[:, 0].any()


def test_actions_of_zero_stand_for_a_second(env):
    _, state = stand(env)
    assert 0.2 < float(state.state.q[2]) < 0.3


def stand(env):
    """Run zero actions from a reset without velocity, for a second."""
    obs, state = env.reset(jax.random.key(5))
    state = state.replace(state=state.state.replace(v=jnp.zeros_like(state.state.v)))
    policy = lambda obs, key: jnp.zeros(12, obs["policy"].dtype)  # noqa: E731
    obs, state, path = env.unroll(jax.random.key(6), obs, state, policy, 50)
    assert not np.asarray(path["done"]).any() and (np.asarray(path["reward"])[5:] > 0).all()
    R = rb.forward_kinematics(env.task.model, state.state.q).R[0]
    assert R[2, 2] > 0.99 and abs(state.state.v).max() < 0.2
    return obs, state


def test_actions_of_zero_stand_in_single_precision():
    with jax.enable_x64(False):
        env = rb.envs.make("go1_joystick_flat")
        obs, _ = stand(env)
        assert obs["policy"].dtype == jnp.float32
