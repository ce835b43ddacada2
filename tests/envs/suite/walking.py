"""Rewards and observations of walking robots by NumPy and MuJoCo, for tests.

Written from the equations of MuJoCo Playground's tasks, on `mujoco.MjData` after `mj_forward`.
"""

from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

#: robots of `transitions`
COUNT = 8


def path(name: str) -> Path:
    """The file of a robot."""
    return Path(str(resources.files("rbjax.envs"))) / "robots" / f"{name}.xml"


def compiled(name: str) -> mujoco.MjModel:
    """A robot with a solver that runs to rounding."""
    model = mujoco.MjModel.from_xml_path(str(path(name)))
    model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, 200, 100
    model.opt.ls_tolerance = 1e-10
    return model


class Robot:
    """A state of a robot: positions, velocities and contacts by name."""

    def __init__(self, model: mujoco.MjModel, q, v, ctrl):
        self.model, self.data = model, mujoco.MjData(model)
        self.data.qpos[:], self.data.qvel[:], self.data.ctrl[:] = q, v, ctrl
        mujoco.mj_forward(model, self.data)

    def steps(self, count: int) -> "Robot":
        for _ in range(count):
            mujoco.mj_step(self.model, self.data)
        return Robot(self.model, self.data.qpos, self.data.qvel, self.data.ctrl)

    def site(self, name):
        """Position, rotation, and velocities in world axes."""
        i = self.model.site(name).id
        six = np.zeros(6)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_SITE, i, six, 0)
        R = self.data.site_xmat[i].reshape(3, 3)
        return self.data.site_xpos[i], R, six[3:], six[:3]

    def touch(self, one, other):
        names = {one, other}
        return any(
            {self.model.geom(g).name for g in contact.geom} == names and contact.dist < 0
            for contact in self.data.contact
        )

    @property
    def joints(self):
        return self.data.qpos[7:], self.data.qvel[6:]

    @property
    def forces(self):
        return self.data.actuator_force


def quiet(env: Any) -> tuple[Any, Any]:
    """The parameters without noise, and the first states of `COUNT` robots."""
    params = env.default_params.replace(noise=jnp.zeros(()))
    keys = jax.random.split(jax.random.key(0), COUNT)
    return params, jax.vmap(env.reset, (0, None))(keys, params)[1]


def transitions(
    env: Any, params: Any, state: Any, steps: int, acts: Callable[[int], bool]
) -> list[Any]:
    """Steps of robots: state before, action, observation, state after, reward, done, info. The
    actions are random in the steps k with `acts(k)`, else zero."""

    @jax.jit
    def step(keys, state, action):
        return jax.vmap(env.step_once, (0, 0, 0, None))(keys, state, action, params)

    rng, path = np.random.default_rng(1), []
    for k in range(steps):
        action = jnp.asarray(rng.uniform(-1, 1, (COUNT, env.action_size))) * acts(k)
        keys = jax.random.split(jax.random.key(k), COUNT)
        obs, after, reward, done, info = step(keys, state, action)
        path.append(jax.tree.map(np.asarray, (state, action, obs, after, reward, done, info)))
        state = after
    return path


def samples(walk: list[Any]) -> Iterator[Any]:
    """The transitions of each robot."""
    for transition in walk:
        for i in range(COUNT):
            yield jax.tree.map(lambda x, i=i: x[i], transition)
