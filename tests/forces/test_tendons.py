"""Lengths, velocities and Jacobians of tendons against MuJoCo C."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.forces.context import Context
from tests.forces.against_mujoco import DRIVERS, SEEDS, energy_slope, error_of, slopes, states
from tests.oracles.random_tendons import random_tendons
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, GRADIENT

Array = np.ndarray


def theirs(m: mujoco.MjModel, q: Array, v: Array) -> tuple[Array, ...]:
    """Lengths, velocities and Jacobians of all tendons at states."""
    data, out = mujoco.MjData(m), []
    for row in zip(q, v, strict=True):
        data.qpos, data.qvel = row
        mujoco.mj_forward(m, data)
        J = np.zeros((m.ntendon, m.nv))
        pattern = (m.ten_J_rownnz, m.ten_J_rowadr, m.ten_J_colind.ravel())
        mujoco.mju_sparse2dense(J, data.ten_J.ravel(), *pattern)
        out.append((data.ten_length.copy(), data.ten_velocity.copy(), J))
    return tuple(np.stack(x) for x in zip(*out, strict=True))


def ours(model: rb.Model, q: Array, v: Array) -> tuple[Array, ...]:
    @jax.jit
    @jax.vmap
    def f(q, v):
        context = Context.of(model, 0.0, rb.State(q, v), None)
        reaches = [rb.forces.tendon_reach(context, name) for name in model.tendon_names]
        speeds = jnp.stack([jnp.asarray(x.speed(context), q.dtype) for x in reaches])
        return rb.tendon_lengths(model, q), speeds, rb.tendon_jacobian(model, q)

    return tuple(map(np.asarray, f(q, v)))


def errors(model: rb.Model, m: mujoco.MjModel, count: int = 100) -> list[float]:
    q, v, _ = states(m, count)
    pairs = zip(ours(model, q, v), theirs(m, q, v), strict=True)
    return [float(np.abs(a - b).max()) for a, b in pairs]


@pytest.mark.parametrize("seed", SEEDS)
def test_random_trees(seed: int) -> None:
    m = random_tendons(seed).compile()
    assert max(errors(load_quietly(m), m)) < F64_PARITY


@pytest.mark.parametrize("driver", DRIVERS)
def test_every_driver(driver: str) -> None:
    m = random_tendons(3).compile()
    assert max(errors(load_quietly(m).replace(driver=driver), m, 20)) < F64_PARITY


@pytest.mark.parametrize("seed", SEEDS)
def test_paths_on_the_inside_of_a_geom(seed: int) -> None:
    """MuJoCo stops its search of the path at an angle of 1e-6, which is second order in the length.
    Our Jacobian is the exact gradient of the length."""
    m = random_tendons(seed, inside=True).compile()
    model = load_quietly(m)
    length, speed, J = errors(model, m)
    assert length < F64_PARITY and max(speed, J) < 1e-4
    q = jnp.asarray(states(m, 3)[0])

    @jax.jit
    @jax.vmap
    def both(q):
        def moved(dq):
            return rb.tendon_lengths(model, rb.integrate(model, q, dq))

        return jax.jacfwd(moved)(jnp.zeros(model.nv)), rb.tendon_jacobian(model, q)

    np.testing.assert_allclose(*both(q), atol=F64_PARITY)


def test_forces() -> None:
    """Springs with a slack, dampers and polynomials on fixed and wrapping tendons."""
    spec, rng = random_tendons(1), np.random.default_rng(2)
    for k, tendon in enumerate(spec.tendons):
        tendon.stiffness[:] = rng.uniform(1, 9, 3) * [1, k % 2, k % 3 == 0]
        tendon.damping[:] = rng.uniform(0, 3, 3) * [k != 4, k % 2, 1]
        tendon.springlength[:] = [0.2, 0.2 + 0.3 * (k % 2)]
    m = spec.compile()
    model = load_quietly(m)
    assert not [x for x in model.dropped if "tendon" in x]
    assert error_of(model, m) < F64_PARITY
    q, v, _ = states(m, 1)

    def f(at):
        tendons, q, v = at
        return rb.applied_forces(model.replace(tendons=tendons), rb.State(q, v))

    assert slopes(f, (model.tendons, q[0], v[0])) < GRADIENT
    force, slope = energy_slope(model.replace(tendons=model.tendons), q[0])
    np.testing.assert_allclose(force, slope, atol=1e-10)
