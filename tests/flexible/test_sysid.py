"""Identification of a beam from a swing, and derivatives of a swing by its parameters."""

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.sysid import Channel, Recording, Unknown, identify
from tests.flexible.beams import with_mass

EI, RATIO, NOISE, T = 0.8, 0.02, 2e-3, 0.005
GRAVITY = '<mujoco><option gravity="0 -9.81 0"/></mujoco>'


def cantilever(EI, ratio, length=0.5) -> rb.Model:
    """A planar beam along x with 0.1 kg at its tip; gravity along -y."""
    rod = rb.flexible.beam(
        length, jnp.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]) * EI, {"k_z": 1}, mass=0.2, damping=ratio
    )
    return with_mass(rb.load(GRAVITY).with_beam("rod", rod), "rod")


def recording(seed: int) -> Recording:
    """One second of a swing from a bent shape; the strains are read with noise."""
    rng = np.random.default_rng(seed)
    start = rb.State(jnp.array([1.0 + 0.3 * seed, 0.5]), jnp.zeros(2))
    path = rb.rollout(cantilever(EI, RATIO), start, None, T, steps=200, integrator="rk4")
    q = np.asarray(path.q) + NOISE * rng.normal(size=path.q.shape)
    return Recording(f"swing {seed}", {"q": Channel(np.arange(201) * T, q)})


def test_stiffness_and_damping_from_a_swing_with_noise() -> None:
    """The true values are within four standard deviations, which are small."""
    unknowns = {
        "EI": Unknown("forces.0.stiffness", 2, positive=True),
        "viscosity": Unknown("forces.0.viscosity", 2, positive=True),
    }
    found = identify(cantilever(0.5, 0.01), [recording(0), recording(1)], unknowns)
    assert found.success
    np.testing.assert_allclose(found.rms["q"], [NOISE, NOISE], rtol=0.15)
    for name, truth in (("EI", EI), ("viscosity", EI * RATIO)):
        interval = found.estimates.interval(name)
        assert abs(interval.value - truth) < 4 * interval.sigma
        assert interval.sigma < 2e-3 * truth


def test_derivatives_of_a_swing_by_stiffness_damping_and_length() -> None:
    """The gradient of the tip's height after 0.1 s against central differences."""

    def height(p):
        model = cantilever(*p)
        state = rb.State(jnp.array([1.0, 0.5]), jnp.zeros(2))
        path = rb.rollout(model, state, None, T, steps=20, integrator="rk4", save_every=20)
        return rb.frame_pose(model, path.q[-1], "rod")[1][1]

    p, h = jnp.array([EI, RATIO, 0.5]), 1e-5
    both = jax.jit(jax.value_and_grad(height))
    slopes = both(p)[1]
    ends = [[both(p.at[k].add(s * h))[0] for s in (1, -1)] for k in range(3)]
    differences = np.array([(a - b) / (2 * h) for a, b in ends])
    # differences of second order: 1e-10 of the third derivatives, and rounding / h
    np.testing.assert_allclose(slopes, differences, atol=1e-8 * np.abs(differences).max())
