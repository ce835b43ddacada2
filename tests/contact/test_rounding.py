"""Newton's method in f32 ends when only rounding is left."""

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.contact.solver import newton
from rbjax.forces.inputs import Inputs
from rbjax.motion.field import Field, dynamics_of, free_motion

BATCH = 4096


def test_no_solve_takes_all_steps():
    # without the end, 5 of these 4,096 walkers take all 50 steps; with it 9 at most
    with jax.enable_x64(False):
        env = rb.envs.make("walker_walk")
        model = env.task.model
        field = Field(
            model, dynamics_of("test", model, free_motion, None, steps=True), model.timestep
        )

        def solve(state: rb.State, ctrl: jax.Array) -> tuple[jax.Array, jax.Array]:
            tau, f_ext, _ = field.applied(0.0, state, Inputs(ctrl))
            found = field.law.solve(field.precomputed, 0.0, state, tau, f_ext, None)
            return found.iterations, found.error

        def one(key: jax.Array) -> tuple[jax.Array, jax.Array]:
            begin, run = jax.random.split(key)
            obs, state = env.reset(begin)
            act = lambda obs, key: 0.3 * jax.random.normal(key, (6,))  # noqa: E731
            _, state, _ = env.unroll(run, obs, state, act, 40)
            return solve(state.state, state.ctrl)

        keys = jax.random.split(jax.random.key(0), BATCH)
        iterations, error = jax.jit(jax.vmap(one))(keys)
        assert int(iterations.max()) <= 20
        bound = newton.NEAR * newton.tolerance_of(jnp.float32)
        assert np.asarray(error).max() <= bound
