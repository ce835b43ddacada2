"""Motions of beams in strain coordinates, as entries of a comparison.

The flying beam has no stiff waves and takes steps of DOP853, of order 8 (Hairer, Norsett & Wanner,
*Solving Ordinary Differential Equations I*, II.10). Shear waves of the spin-up beam have 1e5 rad/s,
so its steps are those of the implicit variational midpoint rule.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.cases.beams import FLYING_LOAD, flying_beam
from benchmarks.flexible.beam_scenes import FLYING_TIMES, SPIN_TIMES, Prepared

HEAVY = 1e12  # armature, kg m^2, of a hub whose motion the beam does not change
HUB = f"""<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="hub"><joint name="spin" axis="0 0 1" armature="{HEAVY}"/>
    <geom type="sphere" size="0.1" mass="1"/></body></worldbody></mujoco>"""


def fly(n: int) -> Prepared:
    """The flying beam in n / 8 links of eight coordinates, with a step of 0.16 / n s."""
    links, dt = max(n // 8, 1), 0.16 / n
    model = flying_beam(500.0, links, {"k_z": 3, "e_x": 1, "g_y": 1})
    load = jnp.zeros((model.nb, 6)).at[-1].set(jnp.array(FLYING_LOAD))
    every = round(0.5 / dt)

    @jax.jit
    def tips() -> jax.Array:
        def run(state: rb.State, seconds: float, **given: jax.Array) -> rb.Trajectory:
            return rb.rollout(
                model, state, None, dt, steps=round(seconds / dt), save_every=every,
                integrator="dop853", **given,
            )  # fmt: skip

        loaded = run(model.default_state(), 2.5, wrenches=load)
        free = run(rb.State(loaded.q[-1], loaded.v[-1]), 5.0)
        q = jnp.concatenate([loaded.q, free.q[1:]])
        return _tips(model, q)[:, :2] - jnp.array([6.0, 0.0])

    return model.nv, lambda: np.asarray(tips())[[round(2 * t) for t in FLYING_TIMES]]


def spin_up(n: int) -> Prepared:
    """The spin-up manoeuvre with one link of eleven coordinates, with a step of 0.08 / n s."""
    dt = 0.08 / n
    beam = rb.flexible.beam(
        10.0, [0, 0, 1.4e4, 2.8e7, 1e7, 0], {"k_z": 4, "e_x": 2, "g_y": 2},
        mass=1.2, inertia=[6e-4, 0, 6e-4],
    )  # fmt: skip
    model = rb.load(HUB).with_beam("rod", beam, "hub")

    times = np.arange(round(15.0 / dt) + 1) * dt
    speed = 0.4 * (times - 7.5 / np.pi * np.sin(2 * np.pi * times / 15))
    torques = np.zeros((len(times) - 1, model.nv))
    torques[:, 0] = HEAVY * np.diff(speed) / dt
    every = round(2.5 / dt)

    @jax.jit
    def tips() -> jax.Array:
        path = rb.rollout(
            model, model.default_state(), None, dt, steps=round(15.0 / dt), save_every=every,
            integrator="variational_midpoint", tau=jnp.asarray(torques),
        )  # fmt: skip
        return _tips(model, path.q.at[:, 0].set(0.0))[:, :2] - jnp.array([10.0, 0.0])

    return model.nv, lambda: np.asarray(tips())[[round(t / 2.5) for t in SPIN_TIMES]]


def _tips(model: rb.Model, q: jax.Array) -> jax.Array:
    tip: Callable = lambda q: rb.frame_pose(model, q, model.body_names[-1])[1]  # noqa: E731
    return jax.vmap(tip)(q)
