"""Stiffness: Prothero and Robinson's problem a million times faster than its solution moves."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.solvers.scenes import SCENES, SOLVERS, program

ON_IT = np.array([1.0, 1.0])  # cos 0
STIFF = np.array([-1e6, 0.0, 0.0])
UNBOUNDED = {"adams_moulton3", "adams_moulton4", "adams_moulton5"}  # implicit, not A-stable
IMPLICIT = [n for n in SOLVERS if SOLVERS[n].kind == "ode" and SOLVERS[n].implicit]
QUICK = {"trapezoid", "gauss_legendre3", "radau_iia3", "sdirk2", "ros34pw2", "bdf2"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in IMPLICIT]
)
def test_smooth_solution_with_large_steps(name: str) -> None:
    y, ok = program(name)(40.0, 2.0, ON_IT, STIFF)
    error = np.abs(np.asarray(y) - np.cos(2.0)).max()
    if name in UNBOUNDED:
        assert not error < 1.0, error
    else:
        assert ok
        assert error < 5e-3, error


@pytest.mark.parametrize("name", ["rk4", "adams_bashforth2", "pece3"])
def test_explicit_methods_blow_up(name: str) -> None:
    y, _ = program(name)(40.0, 2.0, ON_IT, STIFF)
    assert not np.abs(np.asarray(y)).max() < 1e6


@pytest.mark.parametrize(
    ("name", "most"),
    [("radau_iia3", 500),
     pytest.param("bdf3", 3000, marks=pytest.mark.slow),
     pytest.param("kvaerno5", 600, marks=pytest.mark.slow),
     pytest.param("ros34pw2", 3000, marks=pytest.mark.slow)],
)  # fmt: skip
def test_van_der_pol(name: str, most: int) -> None:
    """mu = 1e4, over the first jump, in Hairer and Wanner's form: few steps."""
    mu = 1e-4

    def field(t, y, _):
        x, v = y
        return jnp.stack([v, ((1 - x * x) * v - x) / mu])

    @jax.jit
    def run(tolerance):
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(field), SOLVERS[name].make(), 0.0, 1.0, 1e-6, jnp.array([2.0, -0.66]),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance, factormax=2),
            max_steps=None, throw=False,
        )  # fmt: skip
        return found.ys[0], found.result == diffrax.RESULTS.successful, found.stats["num_steps"]

    y, ok, steps = run(1e-6)
    finer, _, _ = run(1e-8)
    assert ok
    assert int(steps) < most
    assert np.abs(y - finer).max() < 1e-3 * max(1.0, np.abs(finer).max())


def test_scene_is_what_it_says() -> None:
    """cos t solves it, whatever the rate."""
    term = SCENES["ode"].term
    rate = term.vf(0.7, jnp.cos(jnp.array([0.7])), STIFF)
    np.testing.assert_allclose(rate, -np.sin(0.7), atol=1e-9)
