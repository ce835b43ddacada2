"""Adaptive steps reach their tolerance; a solver without an error estimate says so."""

import diffrax
import jax
import numpy as np
import pytest

from tests.solvers.scenes import SOLVERS, flat, scene

TOLERANCE = 1e-6
QUICK = "rk4 radau_iia3 ros34pw2 pece4 rkmk5".split()  # noqa: SIM905
NAMES = [
    pytest.param(n, marks=() if n in QUICK else pytest.mark.slow)
    for n in SOLVERS
    if SOLVERS[n].adaptive
]


def adaptive(name: str, solver):
    s = scene(name)
    # growth held down for the zero-stability of multistep methods
    controller = diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE, factormax=1.8)

    @jax.jit
    def run():
        found = diffrax.diffeqsolve(
            s.term, solver, 0.0, s.end, None, s.y0, s.args, stepsize_controller=controller,
            throw=False, max_steps=None,
        )  # fmt: skip
        return flat(found.ys), found.result == diffrax.RESULTS.successful, found.stats["num_steps"]

    y, ok, steps = run()
    assert ok
    return np.abs(np.asarray(y) - s.exact).max(), int(steps)


@pytest.mark.parametrize("name", NAMES)
def test_tolerance_is_reached(name: str) -> None:
    error, steps = adaptive(name, SOLVERS[name].make())
    assert error < TOLERANCE * max(100, steps), (error, steps)  # the controller's is of one step
    # an estimate that sees nothing takes a handful of steps, one that shrinks wrongly, millions
    least, most = (5, 400) if SOLVERS[name].order > 2 else (20, 20_000)
    assert least <= steps < most, (error, steps)


@pytest.mark.parametrize(
    "name", [pytest.param("generalized_alpha", marks=pytest.mark.slow), "yoshida4"]
)
def test_step_doubling_serves_those_without_an_estimate(name: str) -> None:
    error, steps = adaptive(name, diffrax.HalfSolver(SOLVERS[name].make()))
    assert error < 100 * TOLERANCE
    assert steps > 5


@pytest.mark.parametrize("name", [n for n in SOLVERS if not SOLVERS[n].adaptive][:9:4])
def test_without_an_estimate_adaptive_steps_are_refused(name: str) -> None:
    with pytest.raises(RuntimeError, match="does not provide error estimates"):
        adaptive(name, SOLVERS[name].make())
