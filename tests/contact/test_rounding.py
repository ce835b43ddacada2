"""Newton's method in f32 ends when only rounding is left."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.contact.soft import detected
from rbjax.contact.solver import newton
from rbjax.forces.acting import applied
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


def test_an_error_that_stays_ends_the_iteration():
    # the forces of the first step are 1e3 times those of the solution
    given = json.loads((Path(__file__).parents[1] / "oracles/contact_rounding.json").read_text())
    with jax.enable_x64(False):
        model = rb.load(Path(rb.envs.__file__).parent / "robots/g1.xml")
        q, v, ctrl = (jnp.asarray(given[key], jnp.float32) for key in ("q", "v", "ctrl"))
        tau, f_ext, _ = applied(model, 0.0, rb.State(q, v), Inputs(ctrl))

        @jax.jit
        @rb.threads
        def steps(tolerance: jax.Array) -> tuple[jax.Array, jax.Array]:
            return newton.solve(detected(model, q, v, tau, f_ext), tolerance=tolerance)[1:3]

        taken, left = steps(jnp.float32(0))
        assert int(taken) == newton.ITERATIONS and float(left) > 0
        # without the end, all steps
        taken, error = steps(2 * left / (newton.NEAR + newton.FAR))
    assert int(taken) <= 12 and abs(float(error / left) - 1) <= 0.05
