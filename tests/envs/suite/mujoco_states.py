"""The scaffold of the tests of tasks: states of MuJoCo C, and transitions at them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb

ROBOTS = Path(rb.envs.__file__).parent / "robots"


def mujoco_model(name: str) -> mujoco.MjModel:
    """Our file in MuJoCo C, which solves its contacts to the last digit."""
    m = mujoco.MjModel.from_xml_path(str(ROBOTS / f"{name}.xml"))
    m.opt.tolerance, m.opt.iterations = 0, 200
    return m


def same_model(model: rb.Model, m: mujoco.MjModel) -> None:
    """Check that our model has the numbers of the file."""
    assert (model.nq, model.nv, model.nu) == (m.nq, m.nv, m.nu)
    np.testing.assert_allclose(model.bodies.mass, m.body_mass[1:], rtol=1e-15)
    np.testing.assert_allclose(model.timestep, m.opt.timestep)
    assert model.dropped == ()


def motion(m: mujoco.MjModel, steps: int, count: int, seed: int, q: Any = None) -> list[Any]:
    """States (q, v, ctrl) along a motion with random controls, every `steps` steps."""
    rng, d, out = np.random.default_rng(seed), mujoco.MjData(m), []
    d.qpos[:] = m.qpos0 if q is None else q
    low, high = m.actuator_ctrlrange.T
    for _ in range(count):
        d.ctrl[:] = rng.uniform(low, high)
        out.append((d.qpos.copy(), d.qvel.copy(), d.ctrl.copy()))
        mujoco.mj_step(m, d, steps)
    return out


def after(m: mujoco.MjModel, state: Any, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """The state after some steps with constant controls."""
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:], d.ctrl[:] = state
    mujoco.mj_step(m, d, steps)
    return d.qpos.copy(), d.qvel.copy()


def at(m: mujoco.MjModel, state: Any) -> mujoco.MjData:
    """The data of MuJoCo at a state."""
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:], d.ctrl[:] = state
    mujoco.mj_forward(m, d)
    return d


def sensor(m: mujoco.MjModel, d: mujoco.MjData, name: str) -> np.ndarray:
    """The measured values of a sensor."""
    return d.sensor(name).data.copy()


def body_com(m: mujoco.MjModel, d: mujoco.MjData, name: str) -> np.ndarray:
    """The center of mass of a body in the world."""
    return d.xipos[m.body(name).id].copy()


def batch(env: Any, states: list[Any], seed: int = 0) -> Any:
    """Episodes of an environment at given states."""
    _, state = jax.vmap(env.reset)(jax.random.split(jax.random.key(seed), len(states)))
    q, v, ctrl = (jnp.asarray(np.stack(x), env.dtype) for x in zip(*states, strict=True))
    return state.replace(state=state.state.replace(q=q, v=v), ctrl=ctrl)


def stepped(env: Any, states: list[Any], seed: int = 1) -> Any:
    """obs, state, reward, done, info of a control step from given states with their controls."""
    state = batch(env, states)
    keys = jax.random.split(jax.random.key(seed), len(states))
    return jax.vmap(env.step)(keys, state, state.ctrl)


def resets(env: Any, count: int, seed: int = 0) -> Any:
    """Observations and states of many new episodes."""
    return jax.vmap(env.reset)(jax.random.split(jax.random.key(seed), count))
