"""Panda and cube against MuJoCo C with the same file, and Playground's formulas in NumPy."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.envs.suite.mujoco_states import (
    after,
    at,
    batch,
    motion,
    mujoco_model,
    resets,
    same_model,
)

M = mujoco_model("panda_cube")
HOME = M.key("home").qpos
RESTING = HOME.copy()
RESTING[11] -= 1e-4  # at 0 the cube neither touches the floor nor does not
LIFT = HOME.copy()  # the cube between the finger tips, in the air
LIFT[:9] = [0, 0.6, 0, -2.0, 0, 2.6, -0.785, 0.02, 0.02]


def _grasp():
    """States of a cube that the fingers close on, and of a hand on the floor."""
    d = mujoco.MjData(M)
    d.qpos[:] = LIFT
    mujoco.mj_forward(M, d)
    hand = d.site("gripper")
    d.qpos[9:12] = hand.xpos
    mujoco.mju_mat2Quat(d.qpos[12:16], hand.xmat)
    d.ctrl[:] = [*LIFT[:7], 0]
    out = []
    for _ in range(8):
        mujoco.mj_step(M, d, 3)
        out.append((d.qpos.copy(), d.qvel.copy(), d.ctrl.copy()))
    low = RESTING.copy()
    low[:7] = [0, 1.0, 0, -2.05, 0, 3.0, -0.785]
    return [*out, *motion(M, 20, 6, 2, low)]


STATES = [*motion(M, 30, 10, 0, RESTING), *_grasp()]


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("panda_pick_cube")


def advanced(env, states, variables=None, action=0.0, seed=1):
    """A control step; the action 0 keeps the controls of the states."""
    state = batch(env, states)
    given = {name: jnp.asarray(x, env.dtype) for name, x in (variables or {}).items()}
    state = state.replace(variables=state.variables | given)
    keys = jax.random.split(jax.random.key(seed), len(states))
    action = jnp.broadcast_to(jnp.asarray(action, env.dtype), (len(states), 8))
    return jax.vmap(env.step)(keys, state, action)


def test_model_and_physics(env):
    """Four steps of implicitfast with contacts of the fingers and the cube, and a zero action."""
    same_model(env.task.model, M)
    assert env.dt == pytest.approx(0.02) and env.episode == 150
    found = advanced(env, STATES)[1].state
    pairs = set()
    for i, state in enumerate(STATES):
        q, v = after(M, state, 4)
        pairs |= {frozenset((M.geom(a).name, M.geom(b).name)) for a, b in at(M, state).contact.geom}
        # four steps of stiff contacts (impedance 0.99), each solved to 1e-12
        np.testing.assert_allclose(found.q[i], q, atol=1e-10)
        np.testing.assert_allclose(found.v[i], v, atol=1e-8)
    assert {frozenset(("cube", x)) for x in ("floor", "left_tip", "right_tip")} <= pairs
    assert {frozenset(("floor", x)) for x in ("hand", "left_tip", "right_tip")} <= pairs


def test_action_moves_the_targets_of_the_servos(env):
    """Within the ranges of the controls; an episode begins with those of the pose home."""
    action = np.array([1.0, -1, 0.5, 0, 0, 0, 0, 1])
    state = advanced(env, STATES, action=action)[1]
    due = np.stack([ctrl for _, _, ctrl in STATES]) + 0.04 * action
    np.testing.assert_allclose(state.ctrl, np.clip(due, *M.actuator_ctrlrange.T), atol=1e-15)
    assert (state.ctrl[:, 7] == M.actuator_ctrlrange[7, 1]).any()
    _, state = resets(env, 2048)
    np.testing.assert_allclose(state.ctrl, np.tile(M.key("home").ctrl, (2048, 1)), atol=1e-15)


def rotation(d, name):
    return d.body(name).xmat.reshape(3, 3)


def axis_angle(rng, count):
    axis = rng.normal(size=(count, 3))
    half = rng.uniform(0.1, 0.35, count)
    unit = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    return np.concatenate([np.cos(half)[:, None], np.sin(half)[:, None] * unit], 1)


def matrix(quaternion):
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quaternion)
    return out.reshape(3, 3)


@pytest.mark.parametrize("orientation", [False, True])
def test_observation_and_reward(orientation):
    """On random targets, near and far boxes; box_target counts once the gripper was at the box."""
    env, n = rb.envs.make("panda_pick_cube", orientation=orientation), len(STATES)
    rng = np.random.default_rng(5)
    target, quaternion = rng.uniform(-0.3, 0.8, (n, 3)), axis_angle(rng, n)
    before = np.arange(n) % 2 * 1.0
    own = {"target": target, "reached": before}
    if orientation:
        own["target_attitude"] = quaternion
    obs, found, reward, done, info = advanced(env, STATES, own)
    assert env.observation_size == 66 and env.action_size == 8
    reached = 0
    for i in np.flatnonzero(~np.asarray(done)):
        ctrl = np.clip(STATES[i][2], *M.actuator_ctrlrange.T)
        d = at(M, (found.state.q[i], found.state.v[i], ctrl))
        box, grip = d.body("cube").xpos, d.site("gripper").xpos
        goal = matrix(quaternion[i]) if orientation else np.eye(3)
        turned = (goal - rotation(d, "cube")).ravel()[:6]
        due = [
            *d.qpos, *d.qvel, *grip, *d.site("gripper").xmat[3:], *rotation(d, "cube").ravel()[3:],
            *(box - grip), *(target[i] - box), *turned, *(ctrl - d.qpos[:8]),
        ]  # fmt: skip
        np.testing.assert_allclose(obs[i], due, atol=1e-12)
        near = max(before[i], np.linalg.norm(box - grip) < 0.012)
        reached += near > before[i]
        error = 0.9 * np.linalg.norm(target[i] - box) + 0.1 * np.linalg.norm(turned)
        hits = [{M.geom(a).name, M.geom(b).name} for a, b in d.contact.geom]
        floor = any({"floor", x} in hits for x in ("hand", "left_tip", "right_tip"))
        parts = {
            "gripper_box": 4 * (1 - np.tanh(5 * np.linalg.norm(box - grip))),
            "box_target": 8 * (1 - np.tanh(5 * error)) * near,
            "no_floor_collision": 0.25 * (not floor),
            "robot_target": 0.3 * (1 - np.tanh(np.linalg.norm(d.qpos[:7] - HOME[:7]))),
        }
        for name, value in parts.items():
            np.testing.assert_allclose(info["rewards"][name][i], value, atol=1e-11)
        np.testing.assert_allclose(reward[i], sum(parts.values()), atol=1e-11)
    assert reached > 2
    assert 0 < np.mean(np.asarray(info["rewards"]["no_floor_collision"]) > 0) < 1


def test_starts(env):
    _, state = resets(env, 2048)
    q, target = np.asarray(state.state.q), np.asarray(state.variables["target"])
    np.testing.assert_allclose(q[:, :9], np.tile(HOME[:9], (2048, 1)), atol=1e-7)
    np.testing.assert_allclose(q[:, 11:], np.tile(HOME[11:], (2048, 1)), atol=1e-7)
    shifts = np.concatenate([q[:, 9:11], target], 1) - HOME[[9, 10, 9, 10, 11]]
    middle = np.array([0, 0, 0, 0, 0.3])
    half = np.array([0.2, 0.2, 0.2, 0.2, 0.1])
    assert (np.abs(shifts - middle) <= half + 1e-7).all()
    np.testing.assert_allclose(shifts.std(0), half / np.sqrt(3), rtol=0.05)
    assert (state.state.v == 0).all() and (state.variables["reached"] == 0).all()


def test_attitudes_of_the_target():
    _, state = resets(rb.envs.make("panda_pick_cube", orientation=True), 1024)
    x = np.asarray(state.variables["target_attitude"])
    angles = 2 * np.arccos(x[:, 0])
    np.testing.assert_allclose(np.linalg.norm(x, axis=1), 1, atol=1e-14)
    assert angles.max() <= np.pi / 4 and angles.max() > 0.95 * np.pi / 4
    np.testing.assert_allclose(angles.mean(), np.pi / 8, rtol=0.05)


def test_termination(env):
    """The cube beyond 1 m along an axis, or its center below the floor; the next one begins."""
    q = np.tile(RESTING, (len(STATES), 1))
    q[1, 9], q[2, 10], q[3, 11] = 1.01, -1.01, -0.2
    states = [(x, np.zeros(15), M.key("home").ctrl) for x in q]
    _, state, _, done, info = advanced(env, states)
    np.testing.assert_array_equal(done, np.isin(np.arange(len(STATES)), [1, 2, 3]))
    np.testing.assert_array_equal(info["terminated"], done)
    np.testing.assert_array_equal(state.step, 1 - done.astype(int))
    np.testing.assert_allclose(state.ctrl[1], M.key("home").ctrl, atol=1e-15)


def test_single_precision(env):
    """f32 rounds coordinates near 2 to 1e-7, and contacts of impedance 0.995 amplify it."""
    own = {"target": np.tile([0.6, 0.1, 0.3], (len(STATES), 1)), "reached": np.ones(len(STATES))}
    with jax.enable_x64(False):
        obs, state, reward, *_ = advanced(rb.envs.make("panda_pick_cube"), STATES, own)
        assert obs.dtype == reward.dtype == jnp.float32
    _, double, exact, done, _ = advanced(env, STATES, own)
    keep = ~np.asarray(done)
    np.testing.assert_allclose(state.state.q[keep], double.state.q[keep], atol=1e-4)
    np.testing.assert_allclose(reward[keep], exact[keep], atol=1e-3)


def test_a_hand_brings_the_cube_to_the_target(env):
    """By differential inverse kinematics: above the cube, down, close, to the target. The grasp
    holds by friction, and the reward of the target is 8 (1 - tanh(0.5 |E|)) at most."""
    model, frame, facing = env.task.model, rb.Frame(site="gripper"), np.eye(3)[[1, 0, 2]]
    facing[2, 2] = -1  # the hand points down, its fingers close along x
    pose, jacobian = (
        jax.jit(lambda q, f=f: f(model, q, frame)) for f in (rb.frame_pose, rb.jacobian)
    )
    step, target = jax.jit(env.step_once), np.array([0.5, -0.05, 0.25])
    _, state = env.reset(jax.random.key(0))
    q = state.state.q.at[9:12].set(jnp.array([0.55, 0.06, 0.03]))
    state = state.replace(
        state=state.state.replace(q=q), variables=state.variables | {"target": jnp.asarray(target)}
    )
    sag = np.zeros(3)  # of the servos under gravity
    for k in range(150):
        q, ctrl = np.array(state.state.q), np.asarray(state.ctrl)
        (_, p), cube = pose(q), q[9:12]
        above = np.array([0, 0, 0.1 * np.clip((48 - k) / 18, 0, 1)])
        goal = cube + above if k < 72 else p + np.clip(target - cube, -0.05, 0.05)
        sag += 0.1 * (goal - p) * (np.linalg.norm(goal - p) < 0.03)
        q[:7] = ctrl[:7]
        (R, p), J = pose(q), np.asarray(jacobian(q))[:, :7]
        turn = 0.25 * sum(np.cross(np.asarray(R)[:, i], facing[:, i]) for i in range(3))
        twist = np.concatenate([turn, np.clip(goal + sag - p, -0.02, 0.02)])
        dq = J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), twist)
        fingers = (0.04 if k < 60 else 0.0) - ctrl[7]
        action = np.clip(np.append(dq, fingers) / 0.04, -1, 1)
        _, state, _, done, info = step(jax.random.key(k), state, jnp.asarray(action))
        assert not done or k == 149
    np.testing.assert_allclose(state.state.q[9:12], target, atol=2e-3)
    assert info["rewards"]["box_target"] > 7.6 and state.variables["reached"] == 1
