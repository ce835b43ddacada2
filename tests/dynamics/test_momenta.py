"""Momenta and their rates against MuJoCo's mass matrix along a motion; velocities of momenta."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.algorithms.energy import (
    linearly_implicit_velocity,
    momentum_and_rate,
    velocity_of,
)
from rbjax.dynamics.algorithms.rnea import momentum
from tests.robots import at, mass_matrix, robot
from tests.tolerances import F64_IDENTITY, F64_PARITY, GRADIENT, relative_error

STEP = 6e-6  # of central differences: the cube root of the rounding unit
SLOW = pytest.mark.slow
CASES = [
    ("small", "unrolled"),
    ("small", "rolled"),
    pytest.param("quadruped", "limbs", marks=SLOW),
    pytest.param("free_body", "rolled", marks=SLOW),
    pytest.param("tree:4", "auto", marks=SLOW),
]


@pytest.mark.parametrize(("name", "driver"), CASES)
def test_momenta_and_their_rates(name, driver):
    """p' is the rate of MuJoCo's M(q) v where the forces are those that give v' = a."""
    model, m = (r := robot(name, driver)).model, r.reference
    (q,), (v,) = r.states(1)
    a, f = np.random.default_rng(3).normal(size=(2, model.nv))

    def momentum_after(t):
        moved = np.array(q)
        mujoco.mj_integratePos(m, moved, v + a * t / 2, t)
        return mass_matrix(m, at(m, moved, v)) @ (v + a * t)

    data = at(m, q, v)
    tau = mass_matrix(m, data) @ a + data.qfrc_bias
    want = (momentum_after(STEP) - momentum_after(-STEP)) / (2 * STEP)

    @jax.jit
    def found(q, v, tau, f):
        p, rate = momentum_and_rate(model, q, v, tau)
        last = model.nv - 1
        added = {(last, last): jnp.asarray(0.3)}
        return (
            p,
            rate,
            momentum(model, q, v),
            velocity_of(model, q, f),
            velocity_of(model, q, f, added),
            linearly_implicit_velocity(model, q, {last: 0.3})(f),
        )

    p, rate, alone, speed, *nearby = found(q, v, tau, f)
    assert relative_error(p, momentum_after(0.0)) < F64_PARITY
    assert relative_error(alone, momentum_after(0.0)) < F64_PARITY
    assert relative_error(rate, want) < GRADIENT
    M = mass_matrix(m, data)
    assert relative_error(speed, np.linalg.solve(M, f)) < F64_PARITY
    M[-1, -1] += 0.3
    for velocity in nearby:
        assert relative_error(velocity, np.linalg.solve(M, f)) < F64_PARITY


def test_derivatives_of_the_velocity_of_a_momentum():
    """First by configuration, momentum and masses, and second."""
    model = rb.load("double_pendulum")
    q, p = jnp.array([0.4, -0.7]), jnp.array([0.3, 0.2])
    mass = model.bodies.mass

    def ours(x):
        changed = model.replace(bodies=model.bodies.replace(mass=x[2]))
        return velocity_of(changed, x[0], x[1])

    def dense(x):
        changed = model.replace(bodies=model.bodies.replace(mass=x[2]))
        return jnp.linalg.solve(rb.mass_matrix(changed, x[0]), x[1])

    def all_of(f):
        bent = lambda x: jnp.sin(f(x)).sum()  # noqa: E731
        return jax.jacfwd(f), jax.jacrev(f), jax.jacfwd(jax.grad(bent))

    for got, want in zip(all_of(ours), all_of(dense), strict=True):
        a, b = (jax.jit(f)((q, p, mass)) for f in (got, want))
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            assert relative_error(x, y) < F64_IDENTITY
