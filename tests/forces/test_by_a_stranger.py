"""A force element that somebody else writes: wind on a quadruped, run and differentiated as if it
were the package's own."""

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from tests.robots import QUICK
from tests.tolerances import F64_TRANSFORM, relative_error

STEP, STEPS = 1e-6, 20


class Wind(rb.forces.Element):
    air: jax.Array  # (3,) m/s in the world
    drag: jax.Array  # N s^2/m^2

    def loads(self, now):
        trunk = now.body("trunk")
        flow = trunk.velocity - self.air
        return trunk.push(flow * (-self.drag * flow.norm(1e-6)))


def blown(wind, kernel):
    """Where the quadruped is after a while."""
    model = rb.load("quadruped").with_forces(wind)
    state = model.default_state()
    path = rb.rollout(model, state, steps=STEPS, save_every=STEPS, kernel=kernel)
    return jnp.concatenate([path.q[-1], path.v[-1]])


def test_wind_by_a_stranger():
    wind = Wind(jnp.array([8.0, 2.0, 0.0]), jnp.array(0.4))
    plain, thread = blown(wind, False), blown(wind, True)
    still = blown(Wind(jnp.zeros(3), jnp.array(0.0)), False)
    assert relative_error(thread, plain) < F64_TRANSFORM
    assert plain[0] > still[0] + 1e-3  # it is blown along x

    ways = np.random.default_rng(0).normal(size=plain.shape)
    for kernel in (False, True):
        slopes = jax.jit(
            jax.grad(lambda wind, kernel=kernel: ways @ blown(wind, kernel)), compiler_options=QUICK
        )(wind)
        for name in ("air", "drag"):
            x = getattr(wind, name)
            along = jnp.asarray(np.random.default_rng(1).normal(size=x.shape))
            ends = [
                ways @ blown(wind.replace(**{name: x + s * along}), False) for s in (-STEP, STEP)
            ]
            expected = (ends[1] - ends[0]) / (2 * STEP)
            assert relative_error((getattr(slopes, name) * along).sum(), expected) < 1e-6
