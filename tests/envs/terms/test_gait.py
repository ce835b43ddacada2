"""The gait clock against Playground's equations."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.envs import terms


def test_height_of_phase():
    # from the floor at -pi to the top at 0 and back, with zero slope at these three
    p = jnp.array([-np.pi, -np.pi / 2, 0.0, np.pi / 2, np.pi])
    np.testing.assert_allclose(
        terms.height_of_phase(p, 0.15), [0, 0.075, 0.15, 0.075, 0], atol=1e-15
    )
    slope = jax.vmap(jax.grad(lambda p: terms.height_of_phase(p[None], 0.15)[0]))
    np.testing.assert_allclose(slope(p[jnp.array([0, 2])] + 1e-9), [0, 0], atol=1e-8)


def test_a_clock_that_runs_backwards():
    phase, _ = terms.gait_clock(0.02, (0.0, np.pi))
    p = jnp.array([0.0, np.pi])
    for k in range(1, 200):
        p = phase.update(None, SimpleNamespace(variables={"phase": p, "gait_rate": -1.5}))
        due = np.array([0, np.pi]) - 2 * np.pi * 1.5 * 0.02 * k
        np.testing.assert_allclose(np.exp(1j * np.asarray(p)), np.exp(1j * due), atol=1e-12)
        assert (p >= -np.pi).all() and (p <= np.pi).all()


def test_the_clock_keeps_its_rate():
    phase, rate = terms.gait_clock(0.02, (0.0, np.pi))
    params = SimpleNamespace(values={"gait_rate": jnp.array([1.25, 1.5])})
    f = rate.start(jax.random.key(0), params)
    assert 1.25 <= f <= 1.5
    p = phase.start(None, params)
    for k in range(1, 200):
        p = phase.update(None, SimpleNamespace(variables={"phase": p, "gait_rate": f}))
        due = np.array([0, np.pi]) + 2 * np.pi * float(f) * 0.02 * k
        np.testing.assert_allclose(np.exp(1j * np.asarray(p)), np.exp(1j * due), atol=1e-12)
        assert (p >= -np.pi).all() and (p <= np.pi).all()
