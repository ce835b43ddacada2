"""Compensated summation keeps what plain additions lose, and changes nothing else."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import InputError
from rbjax.solvers import Compensated
from tests.robots import QUICK
from tests.solvers.scenes import SCENES, SOLVERS, flat

SLOW = [pytest.param(n, marks=pytest.mark.slow) for n in ("kvaerno4", "ros34pw2", "pece4")]


@pytest.mark.parametrize("name", ["rk4", pytest.param("gauss_legendre2", marks=pytest.mark.slow)])
def test_rounding_no_longer_adds_up(name: str) -> None:
    """cos t in single precision, 40,000 steps: plain additions lose 1.5e-5 (RK4), these 5e-7.

    That is the sum of RK4's weights, rounded: 3e-8 off one, in 20 rad.
    """

    def rate(t, y, args):
        return jnp.stack([y[1], -y[0]])

    def run(solver):
        out = diffrax.diffeqsolve(
            diffrax.ODETerm(rate), solver, 0.0, 20.0, jnp.float32(2.0**-11), jnp.float32([1, 0]),
            max_steps=None,
        )  # fmt: skip
        return out.ys[0]

    want = np.array([np.cos(20.0), -np.sin(20.0)])
    solver = SOLVERS[name].make()
    plain, kept = (
        np.abs(np.asarray(jax.jit(run, static_argnums=0)(s)) - want).max()
        for s in (solver, Compensated(solver))
    )
    assert kept <= 1e-6, (plain, kept)
    assert plain > 10 * kept


@pytest.mark.parametrize(
    "name", ["euler", pytest.param("adams_bashforth3", marks=pytest.mark.slow), *SLOW]
)
def test_is_the_solver_that_it_wraps(name: str) -> None:
    """Steps and dense output, to rounding."""
    scene = SCENES["ode"]

    def run(solver):
        out = diffrax.diffeqsolve(
            scene.term, solver, 0.0, 1.0, 0.05, scene.y0, scene.args,
            saveat=diffrax.SaveAt(steps=True, dense=True), max_steps=32,
        )  # fmt: skip
        between = out.evaluate(0.52), out.derivative(0.52), out.evaluate(0.5, 0.52)
        return out.ys[:20], between

    solver = SOLVERS[name].make()
    plain, kept = (
        jax.jit(run, static_argnums=0, compiler_options=QUICK)(s)
        for s in (solver, Compensated(solver))
    )
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(kept), strict=True):
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-13)
    assert Compensated(solver).order(scene.term) == solver.order(scene.term)


@pytest.mark.slow
def test_adapts_and_differentiates() -> None:
    scene = SCENES["second-order"]  # a pair of arrays

    def end(y0, adjoint):
        return flat(diffrax.diffeqsolve(
            scene.term, Compensated(rb.solvers.RK4()), 0.0, scene.end, None, y0, scene.args,
            stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8), adjoint=adjoint,
            max_steps=512,
        ).ys)  # fmt: skip

    forward, backward = diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()
    along = jax.tree.map(np.ones_like, scene.y0)

    @functools.partial(jax.jit, compiler_options=QUICK)
    def both(y0):
        y1, slope = jax.jvp(lambda y: end(y, forward), (y0,), (along,))
        _, pulled = jax.vjp(lambda y: end(y, backward), y0)
        return y1, slope, pulled(jnp.ones_like(y1))[0]

    y1, slope, gradient = both(scene.y0)
    assert np.abs(y1 - scene.exact).max() <= 1e-7
    assert float(slope.sum()) == pytest.approx(float(flat(gradient).sum()), rel=1e-11)


@pytest.mark.parametrize("name", ["bdf2", "newmark", "stoermer_verlet", "rkmk4"])
def test_refuses_what_does_more_than_add_rates(name: str) -> None:
    with pytest.raises(InputError, match=r"does not use only rates, expected a Runge-Kutta"):
        Compensated(SOLVERS[name].make())


def test_refuses_groups() -> None:
    scene = SCENES["lie"]
    with pytest.raises(InputError, match="moves its state on Product, expected a vector field"):
        diffrax.diffeqsolve(
            scene.term, Compensated(rb.solvers.RK4()), 0.0, 1.0, 0.1, scene.y0, scene.args
        )
