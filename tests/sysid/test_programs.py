"""Programs are kept: a fit like an earlier one compiles nothing."""

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.sysid import Channel, Derived, Grid, Recording, Setup, Unknown, identify
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation.programs import get_cached
from rbjax.sysid.simulation.simulation_error import SimulationError
from tests.compilations import compilations

MODEL = rb.load("pendulum")
MASS = {"mass": Unknown("bodies.mass", 0, positive=True)}
T = 0.01


def heavy(mass, damping=0.0):
    return MODEL.replace(
        bodies=MODEL.bodies.replace(mass=jnp.array([mass])),
        joints=MODEL.joints.replace(damping=jnp.array([damping])),
    )


def seen(mass, seed):
    ctrl = np.random.default_rng(seed).normal(size=(60, 1))
    start = rb.State(jnp.array([0.3]), jnp.array([0.0]))
    path = rb.rollout(heavy(mass), start, ctrl, T, integrator="rk4", kernel=False)
    t = np.arange(61) * T
    return Recording("run", {
        "q": Channel(t, path.q), "v": Channel(t, path.v), "ctrl": Channel(t[:-1], ctrl),
    })  # fmt: skip


def test_other_data_and_another_guess_compile_nothing():
    first = identify(heavy(1.0), seen(1.4, 0), MASS)
    data = seen(1.2, 1)
    with compilations() as compiled:
        again = identify(heavy(0.7), data, dict(MASS))
    assert not compiled
    programs = first.error.programs
    assert again.error.programs is programs
    np.testing.assert_allclose(first.values["mass"], 1.4, rtol=1e-8)
    np.testing.assert_allclose(again.values["mass"], 1.2, rtol=1e-8)


def made(setup, unknowns, grid):
    return object()


def test_what_is_one_program():
    """The sought number may differ, unless its unknown reads the set-up's own; names, grids and
    functions may not."""
    grid = Grid(T)

    def of(mass, members=MASS, grid=grid, damping=0.0):
        setup = Setup.of(heavy(mass, damping))
        return get_cached(made, setup, Unknowns.of("test", members, setup), grid)

    one = of(1.0)
    assert of(1.0) is one and of(2.0) is one
    assert of(1.0, grid=Grid(T, 2)) is not one and of(1.0, damping=0.2) is not one
    assert of(1.0, {"m": MASS["mass"]}) is not one
    assert of(1.0, {"mass": Unknown("bodies.mass", 0)}) is not one

    def factor(setup, p):
        bodies = setup.model.bodies
        return setup.replace(model=setup.model.replace(bodies=bodies.replace(mass=p * bodies.mass)))

    times = {"times": Derived((0.0,), factor)}
    assert of(1.0, times) is of(1.0, times) and of(1.0, times) is not of(2.0, times)
    indexed = {"mass": Unknown("bodies.mass", np.array([0]))}
    one = of(1.0, indexed)  # arrays are compared entry by entry
    assert of(2.0, {"mass": Unknown("bodies.mass", np.array([0]))}) is one
    assert of(1.0, {"mass": Unknown("bodies.mass", slice(0, 1))}) is not one


def test_statistics_evaluate_no_motion(monkeypatch):
    """Each evaluation of the Jacobian belongs to a step of the search: the covariance, also of
    coloured residuals, uses the last one."""
    data, asked = seen(1.2, 1), []
    t, q = data["q"].t, np.asarray(data["q"].values)
    wave = q + 1e-3 * np.sin(0.7 * np.arange(61))[:, None]  # an effect that the model lacks
    data = Recording("run", {"q": Channel(t, wave), "ctrl": data["ctrl"]})
    grid = Grid(T)
    identify(heavy(0.7), data, MASS, grid=grid, restarts=0)
    steps = SimulationError.triangle
    evaluate = SimulationError._seeded_slopes

    def triangle(self, x):
        asked.append("step")
        return steps(self, x)

    def seeded(self, x):
        before = self._last
        found = evaluate(self, x)
        if self._last is not before:
            asked.append("evaluation")
        return found

    monkeypatch.setattr(SimulationError, "triangle", triangle)
    monkeypatch.setattr(SimulationError, "_seeded_slopes", seeded)
    found = identify(heavy(0.8), data, MASS, grid=grid, restarts=0)
    assert not found.statistics.white and found.success
    assert asked.count("evaluation") <= asked.count("step")
