"""The G1 joystick task against MuJoCo C and the equations of MuJoCo Playground."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.envs.suite import walking
from tests.envs.suite.walking import samples

FEET = ("left_foot", "right_foot")
HOME = np.array(
    [-0.312, 0, 0, 0.669, -0.363, 0] * 2 + [0, 0, 0.073]
    + [0.2, 0.2, 0, 0.6, 0, 0, 0] + [0.2, -0.2, 0, 0.6, 0, 0, 0]
)  # fmt: skip
HIP_ROLL, HIP_YAW, KNEE = [1, 7], [2, 8], [3, 9]
STEPS = 6


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("g1_joystick")


@pytest.fixture(scope="module")
def walk(env):
    """Transitions of random actions."""
    params, state = walking.quiet(env)
    # a zero and a lateral command, one falls, one crosses its feet, one its hands and thighs, one
    # flies, one lands hard, one bends its knees too far
    command = state.variables["command"].at[0].set(0.0).at[1].set(jnp.array([0.5, 0.4, 0.2]))
    air = state.variables["air_time"].at[5:7].set(0.3)
    q = state.state.q.at[2, 3:7].set(jnp.array([0.0, 1.0, 0.0, 0.0])).at[2, 2].add(0.5)
    q = q.at[3, jnp.array([8, 14])].set(jnp.array([-0.3, 0.3])).at[5, 2].add(0.1)
    q = q.at[4, jnp.array([22, 23, 25])].set(jnp.array([0.3, -0.1, 1.9])).at[4, 7:19].set(HOME[:12])
    q = q.at[7, jnp.array([10, 16])].set(2.87)
    v = state.state.v.at[6, 2].set(-2.0)
    state = state.replace(
        variables=state.variables | {"command": command, "air_time": air},
        state=state.state.replace(q=q, v=v),
    )
    return walking.transitions(env, params, state, STEPS, lambda k: k < 2)


def test_sizes(env):
    # what a robot cannot measure: 15 of its base, joints twice, height, forces, 2 contacts, feet
    hidden = 15 + 2 * 29 + 1 + 29 + 2 + 6 + 2
    assert env.observation_size == {"policy": 103, "critic": 103 + hidden}
    assert env.action_size == 29 and env.dt == pytest.approx(0.02) and env.episode == 1000


def test_a_control_step_is_ten_steps_of_mujoco(walk):
    model = walking.compiled("g1")
    for before, _, _, after, *_ in samples(walk):
        due = walking.Robot(model, before.state.q, before.state.v, after.ctrl).steps(10)
        # rounding of ten steps with stiff contacts; 2e-13 measured for random actions
        np.testing.assert_allclose(after.state.q, due.data.qpos, atol=1e-11)
        np.testing.assert_allclose(after.state.v, due.data.qvel, atol=1e-9)


def foot_height(phase):
    """Playground's get_rz."""
    x = (phase + np.pi) / (2 * np.pi)

    def bezier(y0, y1, x):
        return y0 + (y1 - y0) * (x**3 + 3 * (x**2 * (1 - x)))

    return np.where(x <= 0.5, bezier(0, 0.15, 2 * x), bezier(0.15, 0, 2 * x - 1))


def loads(robot, rate, touch):
    """Vertical forces on the feet, from the wrench of the floor on the robot."""
    robot.data.qacc[:] = rate
    wrench = np.zeros(robot.model.nv)
    mujoco.mj_rne(robot.model, robot.data, 1, wrench)
    R = robot.data.xmat[1].reshape(3, 3)
    force, moment = wrench[:3], R @ wrench[3:6] + np.cross(robot.data.qpos[:3], wrench[:3])
    fz = max(force[2], 0.0)
    if not touch.all():
        return fz * touch
    center = np.array([-moment[1], moment[0]]) / force[2]
    left, right = (robot.site(foot)[0][:2] for foot in FEET)
    share = np.dot(center - left, right - left) / np.dot(right - left, right - left)
    share = np.clip(share, 0, 1)
    return fz * np.array([1 - share, share])


def playground_terms(before, action, after, done, robot):
    """The weighted reward terms of Playground's joystick task for G1."""
    _, R, v, w = robot.site("imu_in_pelvis")
    _, T, _, wt = robot.site("imu_in_torso")
    q, _ = robot.joints
    old, c = before.variables, before.variables["command"]
    touch = np.array([robot.touch(foot, "floor") for foot in FEET])
    z = np.array([robot.site(foot)[0][2] for foot in FEET])
    air = old["air_time"] + 0.02
    landing = (old["air_time"] > 0) & (touch | (old["last_contact"] > 0))
    own = R.T @ v
    center, half = (
        robot.model.jnt_range[1:].mean(1),
        0.5 * np.ptp(robot.model.jnt_range[1:], axis=1),
    )
    out = np.maximum(np.abs(q - center) - 0.95 * half, 0)
    offset = q - HOME
    hip = np.abs(offset[HIP_YAW]).sum() + (c[1] <= 0.1) * np.abs(offset[HIP_ROLL]).sum()
    moves = np.hypot(v[0], v[1]) > 0.1 or abs(w[2]) > 0.1 or np.linalg.norm(c) > 0.01
    hands = any(robot.touch(f"{s}_hand", f"{s}_thigh") for s in ("left", "right"))
    load = loads(robot, after.acceleration, touch)
    terms = {
        "tracking_lin_vel": np.exp(-np.sum((c[:2] - own[:2]) ** 2) / 0.25),
        "tracking_ang_vel": 0.75 * np.exp(-((c[2] - (R.T @ w)[2]) ** 2) / 0.25),
        "ang_vel_xy": -0.15 * (wt[0] ** 2 + wt[1] ** 2),
        "orientation": -2.0 * np.sum((T[:, 2] - [0.073, 0, 1]) ** 2),
        "feet_air_time": 2.0 * np.sum(np.minimum((air - 0.2) * landing, 0.3)),
        "feet_slip": -0.25 * np.hypot(v[0], v[1]) * touch.sum(),
        "feet_phase": moves * np.exp(-np.sum((z - foot_height(old["phase"])) ** 2) / 0.01),
        "stand_still": -np.abs(offset).sum() * (np.linalg.norm(c) < 0.01),
        "termination": -100.0 * done,
        "collision": -0.1 * hands,
        "contact_force": -0.01 * np.maximum(load - 500.0, 0).sum(),
        "joint_deviation_knee": -0.1 * np.abs(offset[KNEE]).sum(),
        "joint_deviation_hip": -0.25 * hip,
        "dof_pos_limits": -out.sum(),
        "pose": -0.1 * np.sum(offset**2),
    }
    variables = {
        "air_time": air * ~touch,
        "last_contact": touch * 1.0,
        "phase": np.fmod(old["phase"] + 2 * np.pi * 0.02 * old["gait_rate"] + np.pi, 2 * np.pi)
        - np.pi,
        "command": c,
    }
    return terms, variables


def test_rewards_and_variables(walk):
    model, seen = walking.compiled("g1"), {}
    for before, action, _, after, reward, done, info in samples(walk):
        robot = walking.Robot(model, after.state.q, after.state.v, after.ctrl)
        terms, variables = playground_terms(before, action, after, done, robot)
        assert info["rewards"].keys() == terms.keys()
        for name, due in terms.items():
            seen[name] = max(seen.get(name, 0.0), abs(due))
            # the same state in both; the force of the floor has rounding of 1e-10 N
            np.testing.assert_allclose(info["rewards"][name], due, atol=1e-10, err_msg=name)
        np.testing.assert_allclose(reward, 0.02 * sum(terms.values()), atol=1e-10)
        for name, due in variables.items():
            np.testing.assert_allclose(after.variables[name], due, atol=1e-12, err_msg=name)
    assert min(seen.values()) > 0, f"terms that the states do not reach: {seen}"


def test_terminations(walk):
    model = walking.compiled("g1")
    feet = [model.geom(foot).id for foot in FEET]
    fell = met = False
    for *_, after, _, done, _ in samples(walk):
        robot = walking.Robot(model, after.state.q, after.state.v, after.ctrl)
        gap = mujoco.mj_geomDistance(model, robot.data, *feet, 1.0, None)
        fallen = robot.site("imu_in_torso")[1][2, 2] < 0
        assert done == (fallen or gap < 0)
        fell, met = fell or fallen, met or gap < 0
    assert fell and met


def test_observations(walk):
    model = walking.compiled("g1")
    for _, action, obs, after, *_ in samples(walk):
        robot = walking.Robot(model, after.state.q, after.state.v, after.ctrl)
        _, R, v, w = robot.site("imu_in_pelvis")
        q, qd = robot.joints
        phase = after.variables["phase"]
        state = [R.T @ v, R.T @ w, -R[2], after.variables["command"], q - HOME, qd, action]
        state += [np.cos(phase), np.sin(phase)]
        np.testing.assert_allclose(obs["policy"], np.concatenate(state), atol=1e-11)
        feet = [robot.site(foot)[2] for foot in FEET]
        hidden = [R.T @ w, obs["critic"][106:109], -R[2], R.T @ v, w, q - HOME, qd, q[:0]]
        hidden += [[after.state.q[2]], robot.forces, after.variables["last_contact"], *feet]
        hidden += [after.variables["air_time"]]
        np.testing.assert_allclose(obs["critic"], np.concatenate(state + hidden), atol=1e-10)


def test_reset(env):
    _, state = jax.vmap(env.reset)(jax.random.split(jax.random.key(3), 256))
    q, v = np.asarray(state.state.q), np.asarray(state.state.v)
    assert (abs(q[:, :2]) <= 0.5).all() and np.allclose(q[:, 2], 0.755)
    factor = q[:, 7:][:, HOME != 0] / HOME[HOME != 0]
    assert (factor >= 0.5).all() and (factor <= 1.5).all() and (q[:, 7:][:, HOME == 0] == 0).all()
    assert abs(factor.std() * np.sqrt(12) - 1) < 0.1
    assert (abs(v[:, :6]) <= 0.5).all() and (v[:, 6:] == 0).all()
    values = {name: np.asarray(x) for name, x in state.variables.items()}
    zero = (values["command"] == 0).all(1)
    assert 0.05 < zero.mean() < 0.17 and (abs(values["command"]) <= [1.0, 0.5, 1.0]).all()
    assert ((values["gait_rate"] >= 1.25) & (values["gait_rate"] <= 1.5)).all()
    assert np.allclose(values["phase"], [0, np.pi])
    assert ((values["push_steps"] >= 250) & (values["push_steps"] <= 500)).all()


def test_without_hand_contacts():
    task = rb.envs.tasks()["g1_joystick"](hand_contacts=False, pushes=False, randomise=True)
    geoms = task.model.geoms
    names = [{geoms.names[i] for i in pair} for pair in geoms.pairs]
    assert names == [{foot, "floor"} for foot in FEET] and geoms.pair_friction.shape == (2, 5)
    env = rb.envs.Environment(task)
    keys = jax.random.split(jax.random.key(0), 4)
    _, state = jax.vmap(env.reset)(keys)
    _, after, *_ = jax.vmap(env.step_once)(keys, state, jnp.zeros((4, 29)))
    for i in range(4):
        model, drawn = walking.compiled("g1"), jax.tree.map(lambda x, i=i: x[i], state.drawn)
        model.pair_friction[:2, :2] = drawn["floor_friction"]
        model.pair_margin[2:] = -10.0  # hands and thighs do not touch
        model.dof_frictionloss[:] *= drawn["friction_loss"]
        model.dof_armature[:] *= drawn["armature"]
        model.body_mass[1:] = model.body_mass[1:] * drawn["masses"] + drawn["load"]
        model.qpos0[:] += drawn["joint_zero"]
        mujoco.mj_setConst(model, mujoco.MjData(model))
        due = walking.Robot(model, state.state.q[i], state.state.v[i], after.ctrl[i]).steps(10)
        np.testing.assert_allclose(after.state.q[i], due.data.qpos, atol=1e-11)
        np.testing.assert_allclose(after.state.v[i], due.data.qvel, atol=1e-9)
