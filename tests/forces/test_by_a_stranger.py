"""A user's own force element: wind on a robot, run and differentiated like the package's own."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.tolerances import F64_TRANSFORM, relative_error

STEP, STEPS = 1e-6, 20


class Wind(rb.forces.Element):
    air: jax.Array  # (3,) m/s in the world
    drag: jax.Array  # N s^2/m^2
    on: str = eqx.field(static=True, default="trunk")

    def loads(self, context):
        body = context.body(self.on)
        flow = body.velocity - self.air
        return body.push(flow * (-self.drag * flow.norm(1e-6)))


SCENE = {"trunk": "quadruped", "frame": "quadrotor"}  # by the body that the wind blows on


def end(wind, kernel):
    """The robot's configuration after a while."""
    model = rb.load(SCENE[wind.on]).with_forces(wind)
    state = model.default_state()
    path = rb.rollout(model, state, steps=STEPS, save_every=STEPS, kernel=kernel)
    return jnp.concatenate([path.q[-1], path.v[-1]])


blown = jax.jit(end, static_argnames=("kernel",))
WIND = Wind(jnp.array([8.0, 2.0, 0.0]), jnp.array(0.4))


def test_wind_by_a_stranger():
    plain, thread = blown(WIND, kernel=False), blown(WIND, kernel=True)
    still = blown(Wind(jnp.zeros(3), jnp.array(0.0)), kernel=False)
    assert relative_error(thread, plain) < F64_TRANSFORM
    assert plain[0] > still[0] + 1e-3  # it is blown along x


@pytest.mark.slow
@pytest.mark.parametrize(
    ("on", "kernel"),
    [
        ("frame", False),
        pytest.param("trunk", False, marks=pytest.mark.slow),
        pytest.param("trunk", True, marks=pytest.mark.slow),
    ],
)
def test_gradients_by_its_numbers(on, kernel):
    rng, wind = np.random.default_rng(0), Wind(WIND.air, WIND.drag, on)
    ways = rng.normal(size=blown(wind, kernel=False).shape)
    slope = jax.jit(jax.grad(lambda x: ways @ end(x, kernel)))
    slopes = slope(wind)
    for name in ("air", "drag"):
        x, g = getattr(wind, name), getattr(slopes, name)
        along = rng.normal(size=x.shape)
        moved = [wind.replace(**{name: x + s * along}) for s in (-STEP, STEP)]
        ends = [ways @ blown(w, kernel=False) for w in moved]
        assert relative_error((g * along).sum(), (ends[1] - ends[0]) / (2 * STEP)) < 1e-6
