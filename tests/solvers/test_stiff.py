"""Stiffness: Prothero and Robinson's problem a million times faster than its solution moves."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rbjax as rb
from tests.solvers.scenes import SCENES, SOLVERS, program

TIMES = np.array([0.0, 1.0])
ON_IT = np.array([1.0, 1.0])  # cos 0
STIFF = np.array([-1e6, 0.0, 0.0])
UNBOUNDED = {"adams_moulton3", "adams_moulton4", "adams_moulton5"}  # implicit, not A-stable
IMPLICIT = [n for n in SOLVERS if SOLVERS[n].kind == "ode" and SOLVERS[n].implicit]
SLOW_IN_F32 = "lobatto_iiic3 bdf4".split()  # noqa: SIM905
QUICK = {"radau_iia3", "kvaerno3", "ros34pw2", "bdf2"}  # whose programs test_orders has


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


@pytest.mark.parametrize("name", ["rk4", "adams_bashforth5", "pece4"])
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


def locked(t: float) -> float:
    """The angle of the double pendulum's shoulder, from (1, 0.5), were its elbow rigid."""
    inertia = 2 * 0.084 + 0.5**2 + 1.5**2
    found = solve_ivp(
        lambda t, x: [x[1], -9.81 * (0.5 + 1.5) / inertia * np.sin(x[0])], (0.0, t), [1.0, 0.5],
        rtol=1e-10, atol=1e-10,
    )  # fmt: skip
    return float(found.y[0, -1])


#: name -> error with steps of 10 and of 50 ms: an elbow of 1e6 N m/rad swings every 0.5 ms
ROBOTS = {
    "radau_iia3": (1e-5, 1e-5),
    "bdf2": (1e-3, 2e-2),
    "gauss_legendre2": (1e-5, 1e-5),
    "ros34pw2": (1e-4, 1e-2),
    "sdirk2": (1e-3, 2e-2),
    "kvaerno3": (1e-4, 1e-2),
    "newmark": (1e-3, 2e-2),
    "generalized_alpha": (1e-3, 2e-2),
    "variational_midpoint": (1e-3, 2e-2),
}
#: with roots to find from a swing that is fast at the start; newmark and generalized_alpha lose it
STIRRED = {"radau_iia3", "bdf2", "gauss_legendre2", "variational_midpoint"}


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n == "radau_iia3" else pytest.mark.slow) for n in ROBOTS],
)
def test_a_stiff_robot_with_large_steps(name: str) -> None:
    """At rest in its spring, and deflected by 20 kN m: roots are found either way."""
    model = rb.load("double_pendulum")
    stiffness = jnp.array([0.0, 1e6])
    model = model.replace(joints=model.joints.replace(stiffness=stiffness))
    solver = SOLVERS[name].make()

    @jax.jit
    def run(elbow, dt):
        state = rb.State(jnp.array([1.0, elbow]), jnp.array([0.5, 0.0]))
        return rb.simulate(model, state, TIMES, solver=solver, dt=dt, throw=False)

    for dt, bound in zip((0.01, 0.05), ROBOTS[name], strict=True):
        path = run(0.0, dt)
        assert path.success
        assert abs(path.q[-1, 0] - locked(1.0)) < bound, dt
        if name in STIRRED:
            stirred = run(0.02, dt)
            assert stirred.success
            assert abs(stirred.q[-1, 0] - locked(1.0)) < 2e-2 + bound, dt


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["radau_iia3", *(pytest.param(n, marks=pytest.mark.slow) for n in SLOW_IN_F32)]
)
def test_robertson_in_single_precision(name: str) -> None:
    """A chord that diverges slowly is not taken for one that has settled into rounding."""

    def field(t, y, _):
        slow, fast, back = 0.04 * y[0], 3e7 * y[1] ** 2, 1e4 * y[1] * y[2]
        return jnp.stack([back - slow, slow - back - fast, fast])

    found = diffrax.diffeqsolve(
        diffrax.ODETerm(field), SOLVERS[name].make(), np.float32(0.0), np.float32(400.0), None,
        jnp.array([1.0, 0.0, 0.0], jnp.float32), max_steps=200, throw=False,
        stepsize_controller=diffrax.PIDController(rtol=1e-4, atol=1e-7),
    )  # fmt: skip
    assert found.result == diffrax.RESULTS.successful
    exact = solve_ivp(
        lambda t, y: np.asarray(field(t, y, None)), (0.0, 400.0), [1.0, 0.0, 0.0], method="Radau",
        rtol=1e-6, atol=1e-12,
    )  # fmt: skip
    np.testing.assert_allclose(found.ys[0], exact.y[:, -1], rtol=1e-3)
