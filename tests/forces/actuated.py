"""A robot with actuators in rbjax against MuJoCo C: forces, rates of the states, motions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from benchmarks.cases.random_trees import random_state
from rbjax.forces.acting import states
from rbjax.forces.context import Context
from tests.robots import load_quietly

Array = np.ndarray

# two limbs on a free trunk: a hinge and a slide, a ball and a hinge; a site on each body
LIMBS = """
<mujoco><compiler angle="radian"/>
<option timestep="0.002" integrator="Euler" gravity="0 0 -9">
  <flag contact="disable" constraint="disable" eulerdamp="disable"/></option>
<worldbody><site name="w" pos="0.3 0.2 0.5" euler="0.3 0.2 0.1"/>
<body pos="0 0 1"><freejoint name="f"/><geom size="0.1" pos="0.05 0 0"/>
  <site name="s0" pos="0.1 0 0.2" euler="1 2 3"/>
  <body pos="0.2 0 0"><joint name="h" axis="0 1 0" armature="0.1"/><geom size="0.1" pos="0.1 0 0"/>
    <site name="s1" pos="0.1 0.1 0.2" euler="3 2 3"/>
    <body pos="0.2 0 0"><joint name="s" type="slide" axis="0 1 1" armature="0.1"/>
      <geom size="0.1" pos="0.1 0 0.1"/><site name="s2" pos="0.1 -0.1 0.2" euler="3 2 1"/></body>
  </body>
  <body pos="0.2 0.2 0"><joint name="b" type="ball" armature="0.1"/><geom size="0.1" pos="0.1 0 0"/>
    <site name="s3" pos="0.1 0.3 0.2" euler="1 -2 3"/>
    <body pos="-0.2 0.2 0"><joint name="k" axis="1 0 0" armature="0.1"/>
      <geom size="0.1" pos="0 0.1 0"/><site name="s4" pos="-0.1 0.3 0.2" euler="1 -2 1"/></body>
  </body>
</body></worldbody>
<tendon><fixed name="band"><joint joint="h" coef="0.7"/><joint joint="s" coef="-1.3"/>
  <joint joint="k" coef="0.4"/></fixed>
  <spatial name="rope"><site site="s2"/><site site="s0"/><site site="s4"/><pulley divisor="2"/>
    <site site="s1"/><site site="w"/><pulley divisor="3"/><site site="s3"/><site site="s2"/>
  </spatial></tendon>
<actuator>{}</actuator>{}</mujoco>
"""


def limbs(*actuators: str, extra: str = "") -> mujoco.MjModel:
    """The two limbs with these actuators."""
    return mujoco.MjModel.from_xml_string(LIMBS.format("\n".join(actuators), extra))


@dataclass(frozen=True)
class Samples:
    """States (N, nq), (N, nv), (N, na) and controls (N, nu)."""

    q: Array
    v: Array
    x: Array
    u: Array

    @classmethod
    def of(cls, m: mujoco.MjModel, count: int, spread: float = 1.0) -> Samples:
        """Random ones, the states and controls beyond their ranges too."""
        rng = np.random.default_rng([31, m.nv])
        drawn = [random_state(m, k) for k in range(count)]
        x = rng.normal(size=(count, m.na)) * rng.choice([0.1, 0.6], (count, 1)) * spread
        u = rng.normal(size=(count, m.nu)) * spread
        return cls(np.stack([q for q, _ in drawn]), np.stack([v for _, v in drawn]), x, u)

    def state(self, model: rb.Model) -> rb.State:
        """As a batch of rbjax's."""
        x = jnp.asarray(self.x) if model.nx else None
        return rb.State(jnp.asarray(self.q), jnp.asarray(self.v), x)


def actuation(model: rb.Model, state: rb.State, u: Any) -> tuple[Any, ...]:
    """The actuators' forces on the joints, the states' rates, and the states after a step."""
    context = Context.of(model, 0.0, state, u)
    rate, after = states(model, context), states(model, context, model.timestep)
    passive = rb.applied_forces(model, state)
    nothing = jnp.zeros(0)
    tau = rb.applied_forces(model, state, u) - passive
    return tau, nothing if rate is None else rate, nothing if after is None else after


def ours(model: rb.Model, samples: Samples) -> tuple[Array, ...]:
    """`actuation` of all samples."""
    run = jax.jit(jax.vmap(lambda s, u: actuation(model, s, u)))
    return tuple(np.asarray(x) for x in run(samples.state(model), jnp.asarray(samples.u)))


def theirs(m: mujoco.MjModel, samples: Samples) -> tuple[Array, ...]:
    """The same of MuJoCo."""
    data, rows = mujoco.MjData(m), []
    for q, v, x, u in zip(samples.q, samples.v, samples.x, samples.u, strict=True):
        mujoco.mj_resetData(m, data)
        data.qpos, data.qvel, data.act, data.ctrl = q, v, x, u
        mujoco.mj_forward(m, data)
        row = [data.qfrc_actuator.copy(), data.act_dot.copy()]
        mujoco.mj_step(m, data)
        rows.append([*row, data.act.copy()])
    return tuple(np.stack(x) for x in zip(*rows, strict=True))


def errors(m: mujoco.MjModel, count: int = 100, driver: str = "auto") -> list[float]:
    """The largest errors of forces, rates and states after a step, relative to the largest entry
    of a sample, or to one."""
    samples = Samples.of(m, count)
    found = ours(load_quietly(m).replace(driver=driver), samples)
    return [_worst(a, b) for a, b in zip(found, theirs(m, samples), strict=True)]


def motion_errors(m: mujoco.MjModel, count: int, steps: int = 50) -> list[float]:
    """The largest errors of q, v and the states over a rollout."""
    model, samples = load_quietly(m), Samples.of(m, count, spread=0.3)
    u = jnp.broadcast_to(jnp.asarray(samples.u)[:, None], (count, steps, m.nu))
    run = jax.jit(lambda s, u: rb.rollout(model, s, u))
    path, data, rows = run(samples.state(model), u), mujoco.MjData(m), []
    for q, v, x, u in zip(samples.q, samples.v, samples.x, samples.u, strict=True):
        mujoco.mj_resetData(m, data)
        data.qpos, data.qvel, data.act, data.ctrl = q, v, x, u
        row = []
        for _ in range(steps):
            mujoco.mj_step(m, data)
            row.append((data.qpos.copy(), data.qvel.copy(), data.act.copy()))
        rows.append([np.stack(x) for x in zip(*row, strict=True)])
    want = [np.stack(x) for x in zip(*rows, strict=True)]
    x = path.x if model.nx else np.zeros((count, steps + 1, 0))
    found = [np.asarray(a)[:, 1:] for a in (path.q, path.v, x)]
    return [_worst(a, b) for a, b in zip(found, want, strict=True)]


def _worst(a: Array, b: Array) -> float:
    if a.shape != b.shape:
        raise ValueError(f"shapes differ: got {a.shape}, expected {b.shape}")
    a, b = a.reshape(len(a), -1), b.reshape(len(b), -1)
    size = np.maximum(1.0, np.abs(b).max(-1, initial=0.0))
    return float((np.abs(a - b).max(-1, initial=0.0) / size).max())
