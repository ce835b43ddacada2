"""Robots through `simulate` with these solvers: attitudes stay on the manifold."""

import functools

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


@functools.cache
def robot(name: str):
    """The model, and how far a path lies from where it is at TS to rounding."""
    model = rb.load(name)
    exact = rb.simulate(model, start(model), TS, stepsize_controller=FINE, solver=diffrax.Dopri8())

    @jax.jit
    def apart(path):
        gap = jax.vmap(lambda a, b: rb.difference(model, a, b))(exact.q, path.q)
        return gap, path.v - exact.v

    return model, apart


def error(scene: str, name: str, dt: float) -> float:
    model, apart = robot(scene)
    path = program(scene, name)(start(model), dt)
    for at in model.topology.quaternion_starts:
        lengths = np.linalg.norm(path.q[:, at : at + 4], axis=-1)
        np.testing.assert_allclose(lengths, 1, atol=4e-16)
    gap, slip = (np.asarray(x) for x in apart(path))
    return float(np.abs(gap).max() + np.abs(slip).max())  # jnp.max may drop a nan on the CPU


@functools.cache
def program(scene: str, name: str):
    """One that knows its robot, whatever the step."""
    model, _ = robot(scene)
    solver = SOLVERS[name].make()
    return jax.jit(lambda state, dt: rb.simulate(model, state, TS, solver=solver, dt=dt))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["rkmk4", pytest.param("generalized_alpha", marks=pytest.mark.slow)]
)
def test_a_top_turns_on_its_manifold(name: str) -> None:
    coarse, fine = (error("spinning_top", name, dt) for dt in (0.02, 0.01))
    assert abs(np.log2(coarse / fine) - SOLVERS[name].order) < 0.3, (coarse, fine)


QUICK = {"adams_bashforth3", "yoshida4"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow)
             for n in SOLVERS if n != "rigid_body_splitting"],
)  # fmt: skip
def test_every_solver_moves_a_robot(name: str) -> None:
    bound = {1: 0.5, 2: 2e-2}.get(SOLVERS[name].order, 2e-3)
    assert error("pendulum" if name in QUICK else "double_pendulum", name, 0.01) < bound


def test_the_splitting_of_rigid_bodies_names_its_term() -> None:
    model = rb.load("pendulum")
    with pytest.raises(rb.InputError, match="RigidBodySplitting solves only RigidBody"):
        rb.simulate(model, model.default_state(), TS, solver=rb.solvers.RigidBodySplitting())


@pytest.mark.parametrize(
    ("solver", "message"),
    [
        (rb.solvers.RK4, r"solver is the class RK4, expected a solver of diffrax: RK4\(\)"),
        (rb.solvers.newmark, r"solver is the function newmark, expected .*: newmark\(\)"),
        ("rk4", r"solver is 'rk4', expected .*: rb.solvers.all\(\)\['rk4'\]\.make\(\)"),
        (SOLVERS["rk4"], r"solver is Entry\(.*, expected .*: the entry's make\(\)"),
        (4, r"solver is 4, expected a solver of diffrax"),
        (rb.solvers.newmark(), r"GeneralizedAlpha estimates no error.* expected dt"),
    ],
)
def test_what_is_no_solver_or_has_no_steps_is_named(solver, message: str) -> None:
    model = rb.load("pendulum")
    with pytest.raises(rb.InputError, match=message):
        rb.simulate(model, model.default_state(), TS, solver=solver)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", [rb.solvers.rkmk(3), rb.solvers.Compensated(rb.solvers.RK4())], ids=("rkmk", "sum")
)
def test_whatever_estimates_its_error_chooses_its_steps(solver) -> None:
    model, apart = robot("pendulum")
    gap, _ = apart(rb.simulate(model, start(model), TS, solver=solver))
    assert np.abs(gap).max() < 1e-6


@pytest.mark.slow
def test_gradients_along_the_manifold() -> None:
    model = rb.load("spinning_top")
    state = start(model)

    @jax.jit
    def loss(v):
        path = rb.simulate(model, rb.State(state.q, v), TS, solver=rb.solvers.rkmk(3), dt=0.02)
        return (path.q[-1] ** 3).sum()

    gradient = jax.jit(jax.grad(loss))(state.v)
    d, h = jnp.array([0.3, -0.5, 0.8]), 1e-5
    difference = (loss(state.v + h * d) - loss(state.v - h * d)) / (2 * h)
    assert abs(gradient @ d - difference) < 1e-8 * max(1.0, abs(difference))
