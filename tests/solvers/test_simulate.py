"""Robots through `simulate` with these solvers: attitudes stay on the manifold."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.solvers.scenes import SOLVERS

FINE = diffrax.PIDController(rtol=1e-11, atol=1e-11)
TS = jnp.linspace(0.0, 0.3, 4)


def start(model):
    return model.random_state(jax.random.key(3))


def error(model, name: str, dt: float) -> float:
    state = start(model)
    exact = rb.simulate(model, state, TS, stepsize_controller=FINE, solver=diffrax.Dopri8())
    path = rb.simulate(model, state, TS, solver=SOLVERS[name].make(), dt0=dt)
    for at in model.topology.quaternion_starts:
        lengths = np.linalg.norm(path.q[:, at : at + 4], axis=-1)
        np.testing.assert_allclose(lengths, 1, atol=4e-16)
    gap = jax.vmap(lambda a, b: rb.difference(model, a, b))(exact.q, path.q)
    gap, slip = np.asarray(gap), np.asarray(path.v - exact.v)
    return float(np.abs(gap).max() + np.abs(slip).max())  # jnp.max may drop a nan on the CPU


@pytest.mark.parametrize(
    "name", ["rkmk4", pytest.param("generalized_alpha", marks=pytest.mark.slow)]
)
def test_a_top_turns_on_its_manifold(name: str) -> None:
    model = rb.load("spinning_top")
    coarse, fine = (error(model, name, dt) for dt in (0.02, 0.01))
    assert abs(np.log2(coarse / fine) - SOLVERS[name].order) < 0.3, (coarse, fine)


QUICK = {"adams_bashforth3", "yoshida4"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow)
             for n in SOLVERS if n != "rigid_body_splitting"],
)  # fmt: skip
def test_every_solver_moves_a_robot(name: str) -> None:
    model = rb.load("pendulum" if name in QUICK else "double_pendulum")
    bound = {1: 0.5, 2: 2e-2}.get(SOLVERS[name].order, 2e-3)
    assert error(model, name, 0.01) < bound


def test_the_splitting_of_rigid_bodies_names_its_term() -> None:
    model = rb.load("pendulum")
    with pytest.raises(rb.InputError, match="RigidBodySplitting solves RigidBody alone"):
        rb.simulate(model, model.default_state(), TS, solver=rb.solvers.RigidBodySplitting())


@pytest.mark.slow
def test_gradients_along_the_manifold() -> None:
    model = rb.load("spinning_top")
    state = start(model)

    @jax.jit
    def loss(v):
        path = rb.simulate(model, rb.State(state.q, v), TS, solver=rb.solvers.rkmk(3), dt0=0.02)
        return (path.q[-1] ** 3).sum()

    gradient = jax.jit(jax.grad(loss))(state.v)
    d, h = jnp.array([0.3, -0.5, 0.8]), 1e-5
    difference = (loss(state.v + h * d) - loss(state.v - h * d)) / (2 * h)
    assert abs(gradient @ d - difference) < 1e-8 * max(1.0, abs(difference))
