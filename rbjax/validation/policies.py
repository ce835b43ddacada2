"""A policy in MuJoCo C: episodes of a task whose physics are MuJoCo's.

The controls go to MuJoCo, and its states come back. Observations, rewards and terminations are
those of the task, and random numbers those of `rb.envs.learning.evaluate` with the same key. So the
difference of the returns is that of the physics.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from rbjax.arguments import instance, integer, random_key
from rbjax.dynamics.arguments import check_takes
from rbjax.envs.batch_step import batch_keys
from rbjax.envs.environment import Environment
from rbjax.envs.learning.evaluation import Episodes
from rbjax.errors import InputError
from rbjax.model import State


def evaluate_in_mujoco(
    env: Environment,
    policy: Callable,
    mj_model: mujoco.MjModel,
    key: jax.Array,
    episodes: int = 64,
    *,
    steps: int | None = None,
    threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> Episodes:
    """Run whole episodes of a task under a policy, with the physics of MuJoCo C.

    Use it to check that a policy does not depend on the details of one simulator. Compare the
    result with `rb.envs.learning.evaluate` and the same key.

    Args:
        env: an environment without randomisation of the model.
        policy: function (obs, key) that returns an action (na,); the key is None.
        mj_model: MuJoCo's model of the same robot. Its timestep must be that of the task.
        key: of `jax.random`.
        episodes: number of episodes, simulated at the same time.
        steps: control steps, at most those of the task's episode; None for all of them.
        threads: threads of MuJoCo.
        progress: function (done, total), called after each control step; or None.

    Returns:
        `Episodes`: returns, lengths, and whether they were terminated.

    Raises:
        InputError: another robot or timestep, actuators with states, or a task that randomises its
            model.

    Source: MuJoCo documentation, *Python bindings*, rollout.

    Example:
        >>> import jax, jax.numpy as jnp, mujoco
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> mj_model = mujoco.MjModel.from_xml_string(rb.write_mjcf(env.task.model))
        >>> found = rb.validation.evaluate_in_mujoco(
        ...     env, lambda obs, key: jnp.zeros(1), mj_model, jax.random.key(0), 2, steps=3)
        >>> found.lengths.tolist()
        [3, 3]
    """
    instance("evaluate_in_mujoco", "env", env, Environment, "an rb.envs.Environment")
    random_key("evaluate_in_mujoco", key)
    instance("evaluate_in_mujoco", "mj_model", mj_model, mujoco.MjModel, "a mujoco.MjModel")
    check_takes("evaluate_in_mujoco", "policy", policy, "obs", "key")
    integer("evaluate_in_mujoco", "episodes", episodes, least=1)
    integer("evaluate_in_mujoco", "threads", threads, least=1)
    total = env.episode if steps is None else steps
    integer("evaluate_in_mujoco", "steps", total, least=1, most=env.episode)
    _check_same(env, mj_model)
    step, params, count = env.control_step, env.default_params, env.task.decimation
    one, two = jax.random.split(key)
    obs, state = jax.vmap(env.reset)(jax.random.split(one, episodes))

    @jax.jit
    def prepare(state: Any, obs: Any, key: jax.Array) -> tuple:
        action = jax.vmap(lambda o: policy(o, None))(obs)
        own = jax.random.key_data(batch_keys(key, episodes)[1]), state, action
        return action, *jax.vmap(lambda *own: step.before_physics(own, params))(*own)

    @jax.jit
    def finish(*own: Any) -> tuple:
        after = jax.vmap(lambda *own: step.after_physics(own, params, resets=False))
        obs, state, reward, done, info = after(*own)
        return obs, state, reward, done, info["terminated"]

    found, running = Episodes.empty(episodes, env.dtype)
    data = [mujoco.MjData(mj_model) for _ in range(threads)]
    keys = jax.random.split(two, env.episode)
    for i in range(total):
        action, last, ctrl, rest = prepare(state, obs, keys[i])
        motion, rate = _advance(mj_model, data, last.state, np.asarray(ctrl, float), count)
        kept = last.state.replace(
            q=jnp.asarray(motion[0], env.dtype), v=jnp.asarray(motion[1], env.dtype)
        )
        moved = kept, jnp.asarray(rate, env.dtype)
        obs, state, reward, done, terminated = finish(rest, last, action, ctrl, moved)
        found, running = found.include(running, reward, done, terminated)
        if progress is not None:
            progress(i + 1, total)
        if not running.any():
            break
    return found


def _advance(
    mj_model: mujoco.MjModel, data: list, state: State, ctrl: np.ndarray, count: int
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return q and v after `count` steps of MuJoCo, and the acceleration of the last step."""
    nq, nv = mj_model.nq, mj_model.nv
    batch = len(ctrl)
    full = np.zeros((batch, mujoco.mj_stateSize(mj_model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    full[:, 1 : 1 + nq] = np.nan_to_num(np.asarray(state.q))
    full[:, 1 + nq : 1 + nq + nv] = np.nan_to_num(np.asarray(state.v))
    held = np.repeat(np.nan_to_num(ctrl)[:, None], count, 1)
    path, _ = rollout.rollout(mj_model, data, full, held)
    v = path[:, :, 1 + nq : 1 + nq + nv]
    before = v[:, -2] if count > 1 else full[:, 1 + nq : 1 + nq + nv]
    return (path[:, -1, 1 : 1 + nq], v[:, -1]), (v[:, -1] - before) / mj_model.opt.timestep


def _check_same(env: Environment, mj_model: mujoco.MjModel) -> None:
    where, model = "evaluate_in_mujoco", env.task.model
    if env.task.randomise:
        raise InputError(
            f"{where}: task {env.task.name!r} randomises its model, expected a task without "
            "randomisation: MuJoCo's model stays the same"
        )
    got = mj_model.nq, mj_model.nv, mj_model.nu
    due = model.nq, model.nv, model.nu
    if got != due:
        raise InputError(f"{where}: mj_model has (nq, nv, nu) = {got}, expected {due}")
    joints = [mj_model.joint(j).name for j in range(mj_model.njnt)]
    if all(joints) and joints != list(model.joint_names):
        raise InputError(
            f"{where}: mj_model has the joints {joints}, expected {list(model.joint_names)}"
        )
    if mj_model.na:
        raise InputError(
            f"{where}: mj_model has {mj_model.na} states of actuators, expected none: they are not "
            "passed on from one control step to the next"
        )
    step = env.dt / env.task.decimation
    if abs(mj_model.opt.timestep - step) > 1e-6 * step:
        raise InputError(
            f"{where}: mj_model.opt.timestep is {mj_model.opt.timestep}, expected {step:.6g}, the "
            "physics step of the task; set mj_model.opt.timestep"
        )
