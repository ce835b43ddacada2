"""A user's script whose types `mypy --strict` checks: the main job and a call of most rooms.

It is read and not run: tests of each room run its functions.
"""

from collections.abc import Callable
from pathlib import Path
from typing import assert_type

import jax
import jax.numpy as jnp

import rbjax as rb
from rbjax.planning import OccupancyGrid
from rbjax.sysid import Identified, Recording


def main() -> None:
    model = rb.load("cart_pole", contacts=False)
    state = model.random_state(jax.random.key(0))
    ctrls = jnp.zeros((200, model.nu))
    assert_type(model, rb.Model)
    assert_type(state, rb.State)

    run = rb.rollout(model, state, ctrls, 0.01)
    assert_type(run, rb.Trajectory)
    assert_type(run.q, jax.Array)
    assert_type(rb.step(model, state, ctrls[0], 0.01), rb.State)
    assert_type(rb.simulate(model, state, jnp.linspace(0.0, 1.0, 11)), rb.Trajectory)
    assert_type(rb.mass_matrix(model, state.q), jax.Array)
    assert_type(rb.forward_dynamics(model, state.q, state.v, jnp.zeros(model.nv)), jax.Array)
    assert_type(rb.forward_kinematics(model, state.q), rb.Poses)
    assert_type(rb.linearise(model, state, ctrls[0]), rb.Linear)
    R, p = rb.frame_pose(model, state.q, "pole")
    assert_type(R @ p, jax.Array)

    def loss(ctrls: jax.Array, model: rb.Model) -> jax.Array:
        return jnp.sum(rb.rollout(model, state, ctrls, 0.01).q[-1] ** 2)

    slope: Callable[[jax.Array, rb.Model], jax.Array] = jax.grad(loss)
    assert_type(slope(ctrls, model), jax.Array)
    assert_type(model.replace(gravity=2 * model.gravity), rb.Model)
    states = jax.vmap(model.random_state)(jax.random.split(jax.random.key(1), 64))
    batch = rb.rollout(model, states, None, 0.01, steps=100)

    @rb.threads
    def height(q: jax.Array) -> jax.Array:
        return rb.center_of_mass(model, q)[2]

    assert_type(jax.vmap(height)(batch.q[:, -1]), jax.Array)

    def friction_fit(recordings: list[Recording]) -> Identified:
        return rb.sysid.identify(model, recordings, {"damping": rb.sysid.Unknown("damping")})

    def errors(path: Path) -> rb.Model | None:
        try:
            return rb.load(path)
        except rb.ModelError as error:
            print(error)
            return None

    assert_type(rb.envs.make("cart_pole_balance"), rb.envs.Environment)
    regulator = rb.control.lqr(jnp.eye(2), jnp.ones((2, 1)), jnp.eye(2), jnp.eye(1))
    assert_type(regulator.K, jax.Array)
    assert_type(OccupancyGrid(jnp.zeros((40, 30), bool), jnp.asarray(0.1)).origin, jax.Array)
    assert_type(rb.stability.linear_analysis("rk4"), rb.stability.LinearAnalysis)
    assert_type(rb.plotting.animate(model, run, "swing.html"), Path)
    assert_type(rb.validation.compare("pendulum").success, bool)
